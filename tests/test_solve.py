"""The whole method inside jit: one answer however it is run, and laws that any answer obeys."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from oracles import (
    STACK,
    Matches,
    assert_finite,
    joint_residuals,
    pose_error,
    problem_of,
    random_matches,
    random_pose,
    refit,
    solve,
    solve_stack,
)

import teaser_jax as tj
from teaser_jax.problem import pad_problem

N = 32

VARIANTS = {
    "default": tj.Settings(),
    "greedy, consensus": tj.Settings(clique="greedy", vote="consensus"),
    "networkx, cascade": tj.Settings(clique="networkx", refine=False),
    "complete cascade": tj.Settings(tim_graph="complete", refine=False),
}

both_scales = pytest.mark.parametrize("scale", [1.3, None], ids=["known", "unknown"])


def matches_of(seed: int, n: int = N, *, wrong: float = 0.4, noise: float = 1.0) -> Matches:
    return random_matches(seed, n, wrong=wrong, noise=noise, scale=1.3)


def item(batch, index: int):
    return jax.tree.map(lambda x: x[index], batch)


def assert_same(a: tj.Solution, b: tj.Solution, *, rows: int | None = None, tolerance: float = 1e-12) -> None:
    """The same sets, status and bounds; poses to the tolerance."""
    for x, y in ((a.inliers, b.inliers), (a.selection.clique, b.selection.clique)):
        np.testing.assert_array_equal(x[:rows], y[:rows])
    np.testing.assert_array_equal(a.selection.translation[:rows], b.selection.translation[:rows])
    for name in ("status", "clique_size", "clique_upper_bound", "clique_is_maximum", "excluded"):
        assert getattr(a, name) == getattr(b, name), name
    assert pose_error(a.pose, b.pose) <= tolerance
    np.testing.assert_allclose(a.cost, b.cost, atol=1e-9)


# --- one answer however it is run -----------------------------------------------------------------


@pytest.mark.long
@both_scales
def test_right_matches_are_found(scale, x64):
    for seed in range(10):
        matches = matches_of(seed)
        solution = solve(problem_of(matches, scale=scale))
        assert bool(solution.ok)
        assert pose_error(solution.pose, matches.truth) < 0.1
        assert not np.any(solution.inliers & ~matches.inliers)
        assert np.mean(np.asarray(solution.inliers)[matches.inliers]) > 0.7
        bound = matches.noise_bound * float(solution.selection.widening)
        agree = joint_residuals(solution.pose, matches.src, matches.dst, bound) <= 1
        np.testing.assert_array_equal(solution.inliers, agree)
        assert int(solution.clique_size) >= matches.inliers.sum()
        assert bool(solution.clique_is_maximum)
        assert bool(solution.selection.refined)


@pytest.mark.long
def test_a_batch_equals_a_loop(x64):
    problems = [problem_of(matches_of(seed), scale=None) for seed in range(STACK)]
    batch = solve_stack(tj.stack_problems(problems))
    for k, problem in enumerate(problems):
        assert_same(item(batch, k), solve(problem))


@pytest.mark.long
def test_padding_changes_nothing(x64):
    short = [problem_of(matches_of(seed, 20), scale=None) for seed in range(3)]
    alone = [solve(problem) for problem in short]
    batch = solve_stack(tj.stack_problems([*short, problem_of(matches_of(3), scale=None)]))
    for k, problem in enumerate(short):
        for padded in (item(batch, k), solve(pad_problem(problem, N))):
            assert_same(padded, alone[k], rows=20)
            assert not np.any(padded.inliers[20:])
            assert not np.any(padded.selection.clique[20:])


@pytest.mark.long
def test_inside_scan(x64):
    problems = tj.stack_problems([problem_of(matches_of(seed)) for seed in range(4)])
    along = jax.jit(lambda x: lax.scan(lambda carry, problem: (carry, tj.solve(problem)), 0, x)[1])(problems)
    for k in range(4):
        assert_same(item(along, k), solve(item(problems, k)))


@pytest.mark.long
@both_scales
def test_the_pose_is_the_read_out_of_the_selection(scale, x64):
    problem = problem_of(matches_of(1), scale=scale, confidence=np.linspace(0.1, 1, N))
    solution = solve(problem)
    assert pose_error(refit(problem, solution.selection), solution.pose) <= 1e-12
    jax.tree.map(np.testing.assert_array_equal, jax.jit(tj.select)(problem), solution.selection)


# --- laws -----------------------------------------------------------------------------------------


@both_scales
def test_moving_the_target_moves_the_answer(scale, x64):
    for seed in range(3):
        matches, motion = matches_of(seed), random_pose(np.random.default_rng(seed + 50))
        plain = solve(problem_of(matches, scale=scale))
        moved = solve(problem_of(matches._replace(dst=motion.apply(matches.dst)), scale=scale))
        np.testing.assert_array_equal(moved.inliers, plain.inliers)
        np.testing.assert_array_equal(moved.selection.clique, plain.selection.clique)
        assert pose_error(moved.pose, motion @ jax.tree.map(np.asarray, plain.pose)) < 1e-11


@both_scales
def test_moving_the_source_moves_the_answer_back(scale, x64):
    for seed in range(3):
        matches, motion = matches_of(seed), random_pose(np.random.default_rng(seed + 60))
        plain = solve(problem_of(matches, scale=scale))
        moved = solve(problem_of(matches._replace(src=motion.apply(matches.src)), scale=scale))
        np.testing.assert_array_equal(moved.inliers, plain.inliers)
        assert pose_error(moved.pose, jax.tree.map(np.asarray, plain.pose) @ motion.inverse()) < 1e-11


@both_scales
@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(scale, unit, x64):
    matches = matches_of(2)
    plain = solve(problem_of(matches, scale=scale))
    larger = Matches(unit * matches.src, unit * matches.dst, unit * matches.noise_bound, None, None)
    found = solve(problem_of(larger, scale=scale))
    np.testing.assert_array_equal(found.inliers, plain.inliers)
    np.testing.assert_allclose(found.pose.rotation, plain.pose.rotation, atol=1e-12)
    np.testing.assert_allclose(found.pose.translation, unit * plain.pose.translation, rtol=1e-10)
    np.testing.assert_allclose(found.pose.scale, plain.pose.scale, rtol=1e-12)
    np.testing.assert_allclose(found.cost, plain.cost, rtol=1e-8)


def test_enlarging_the_target_enlarges_the_scale(x64):
    matches = matches_of(3)
    plain = solve(problem_of(matches, scale=None))
    larger = solve(
        problem_of(matches._replace(dst=7 * matches.dst), scale=None, noise_bound=7 * matches.noise_bound)
    )
    np.testing.assert_array_equal(larger.inliers, plain.inliers)
    np.testing.assert_allclose(larger.pose.scale, 7 * plain.pose.scale, rtol=1e-12)
    known = solve(
        problem_of(matches._replace(dst=7 * matches.dst), scale=7 * 1.3, noise_bound=7 * matches.noise_bound)
    )
    assert float(known.pose.scale) == 7 * 1.3
    np.testing.assert_array_equal(known.inliers, solve(problem_of(matches, scale=1.3)).inliers)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scale", "variant", "noise"),
    [(1.3, "default", 0.6), (None, "default", 0.6), (None, "complete cascade", 1.0)],
    ids=["known", "unknown", "complete"],
)
def test_the_order_of_rows_does_not_matter(scale, variant, noise, x64):
    # The chain of TIMs depends on the order. Where right matches reach up to their bound, the descent may
    # then end in another minimum beside; the complete graph has no order.
    settings = VARIANTS[variant]
    for seed in range(4):
        matches = matches_of(seed, noise=noise)
        order = np.random.default_rng(seed).permutation(N)
        mixed = matches._replace(src=matches.src[order], dst=matches.dst[order])
        plain, found = (solve(problem_of(x, scale=scale), settings) for x in (matches, mixed))
        np.testing.assert_array_equal(found.inliers, plain.inliers[order])
        np.testing.assert_array_equal(found.selection.clique, plain.selection.clique[order])
        assert pose_error(found.pose, plain.pose) < 1e-12


@both_scales
def test_masked_rows_do_not_exist(scale, x64):
    matches, mask = matches_of(5), np.random.default_rng(0).uniform(size=N) < 0.7
    masked = solve(problem_of(matches, scale=scale, mask=mask))
    weightless = solve(problem_of(matches, scale=scale, confidence=mask * 1.0))
    assert_same(weightless, masked, tolerance=0)
    spoiled = matches._replace(src=np.where(mask[:, None], matches.src, np.nan))
    assert_same(solve(problem_of(spoiled, scale=scale, mask=mask)), masked, tolerance=0)
    assert not np.any(masked.inliers & ~mask)
    first = matches._replace(src=np.concatenate([matches.src[mask], matches.src[~mask]]),
                             dst=np.concatenate([matches.dst[mask], matches.dst[~mask]]))  # fmt: skip
    moved = solve(problem_of(first, scale=scale, mask=np.arange(N) < mask.sum()))
    np.testing.assert_array_equal(moved.inliers[: mask.sum()], masked.inliers[mask])


@both_scales
def test_confidence_weighs_the_fit_and_nothing_else(scale, x64):
    for seed in range(5):
        matches, confidence = matches_of(seed), 10 ** np.random.default_rng(seed).uniform(-3, 0, N)
        plain, weighted, doubled = (
            solve(problem_of(matches, scale=scale, confidence=c)) for c in (None, confidence, 2 * confidence)
        )
        jax.tree.map(np.testing.assert_array_equal, weighted.selection, plain.selection)
        assert 1e-6 < pose_error(weighted.pose, plain.pose) < 0.1
        assert_same(doubled, weighted)


@both_scales
def test_bounds_of_their_own_for_every_match(scale, x64):
    # Two matches are off by ten times what the others may be, and say so.
    matches = matches_of(7)
    bounds, right = np.full(N, matches.noise_bound), np.flatnonzero(matches.inliers)[:2]
    dst = matches.dst.copy()
    dst[right] += [[0.3, 0, 0], [0, -0.3, 0]]
    bounds[right] = 0.5
    solution = solve(problem_of(matches._replace(dst=dst), scale=scale, noise_bound=bounds))
    assert bool(solution.ok)
    assert np.all(np.asarray(solution.inliers)[right])
    strict = solve(problem_of(matches._replace(dst=dst), scale=scale))
    assert not np.any(np.asarray(strict.inliers)[right])
    assert pose_error(solution.pose, matches.truth) < 0.1


@both_scales
def test_truncation_is_in_units_of_the_bounds(scale, x64):
    matches = matches_of(8)
    plain = solve(problem_of(matches, scale=scale))
    halved = solve(problem_of(matches, scale=scale, noise_bound=matches.noise_bound / 2, cbar2=4.0))
    np.testing.assert_array_equal(halved.inliers, plain.inliers)
    assert pose_error(halved.pose, plain.pose) < 1e-12
    np.testing.assert_allclose(halved.cost, 4 * plain.cost, rtol=1e-9)
    wide = solve(problem_of(matches, scale=scale, cbar2=4.0))
    assert np.all(np.asarray(wide.inliers)[matches.inliers])


@pytest.mark.long
def test_the_refined_cost_is_never_above_that_of_the_cascade(x64):
    for seed in range(10):
        problem = problem_of(random_matches(seed, N, wrong=0.4, noise_bound=0.2, scale=1.3), scale=None)
        refined, cascade = solve(problem), solve(problem, VARIANTS["networkx, cascade"])
        assert float(refined.cost) <= float(cascade.cost) + 1e-9


# --- given pairs ----------------------------------------------------------------------------------


@pytest.mark.long
def test_a_chain_of_pairs_on_good_matches_keeps_them_all(x64):
    matches = random_matches(9, 100, wrong=0, noise=0.8, scale=1.3)
    problem = problem_of(matches, scale=None, pairs=[(i, i + 1) for i in range(99)])
    solution = solve(problem)
    assert int(solution.inliers.sum()) == 100
    assert int(solution.clique_size) == 100
    assert int(solution.clique_upper_bound) >= 100
    assert bool(solution.ok)
    assert pose_error(solution.pose, matches.truth) < 0.05


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("variant", VARIANTS)
def test_every_setting_finds_the_right_matches(variant, x64):
    settings = VARIANTS[variant]
    for seed in range(3):
        matches = matches_of(seed)
        problem = problem_of(matches, scale=None)
        solution = solve(problem, settings)
        assert bool(solution.ok)
        assert pose_error(solution.pose, matches.truth) < 0.2
        assert not np.any(solution.inliers & ~matches.inliers)
        size, bound = int(solution.clique_size), int(solution.clique_upper_bound)
        assert bound >= matches.inliers.sum()
        assert bool(solution.clique_is_maximum) == (size == bound)
        assert bool(solution.selection.refined) == (settings.refine is not None)
        assert pose_error(refit(problem, solution.selection), solution.pose) <= 1e-12
        if not settings.refine:
            axes = np.asarray(solution.selection.translation)
            np.testing.assert_array_equal(solution.inliers, axes.all(axis=1) & solution.selection.clique)


@pytest.mark.long
def test_without_pruning_nothing_is_proved_and_eager_equals_jit(x64):
    matches, settings = matches_of(0, wrong=0.1), tj.Settings(clique="none")
    problem = problem_of(matches, scale=1.3)
    solution = solve(problem, settings)
    assert int(solution.clique_size) == N
    assert not bool(solution.clique_is_maximum)
    assert pose_error(solution.pose, matches.truth) < 0.1
    # One method after the other: what JAX keeps of the first must not be run for the second.
    greedy, every = (jax.device_get(tj.solve(problem, tj.Settings(clique=x))) for x in ("greedy", "none"))
    assert int(greedy.selection.clique.sum()) < N
    assert_same(every, solution)


# --- dtypes ---------------------------------------------------------------------------------------


@pytest.mark.long
@both_scales
def test_float32_stays_float32_and_jax_stays_as_it_was(scale):
    before = jax.config.jax_enable_x64
    assert not before
    for seed in range(3):
        matches = matches_of(seed)
        solution = solve(problem_of(matches, scale=scale))
        assert {x.dtype for x in jax.tree.leaves(solution.pose)} == {jnp.dtype("float32")}
        assert solution.cost.dtype == jnp.float32
        assert solution.status.dtype == solution.clique_size.dtype == jnp.int32
        with jax.enable_x64(True):
            exact = solve(problem_of(matches, scale=scale))
            np.testing.assert_array_equal(solution.inliers, exact.inliers)
            assert pose_error(solution.pose, exact.pose) < 1e-5
    assert jax.config.jax_enable_x64 == before
    assert jnp.ones(()).dtype == jnp.float32


def test_a_float32_problem_stays_float32_with_x64_on(x64):
    matches = matches_of(0)
    narrow = matches._replace(src=matches.src.astype(np.float32), dst=matches.dst.astype(np.float32))
    problem = problem_of(narrow, scale=None)
    assert {x.dtype for x in jax.tree.leaves(jax.eval_shape(tj.solve, problem).pose)} == {
        jnp.dtype("float32")
    }


@pytest.mark.long
@pytest.mark.parametrize("wide", [False, True], ids=["x64 off", "x64 on"])
@pytest.mark.parametrize(
    ("scale", "variant"), [(1.3, "default"), (None, "default"), (None, "complete cascade")]
)
def test_no_dtype_is_promoted_by_accident(scale, variant, wide):
    with jax.enable_x64(wide), jax.numpy_dtype_promotion("strict"):
        problem = problem_of(matches_of(0), scale=scale)
        solution = jax.eval_shape(lambda p: tj.solve(p, VARIANTS[variant]), problem)
    expected = jnp.dtype("float64" if wide else "float32")
    assert {x.dtype for x in jax.tree.leaves(solution.pose)} == {expected}
    assert {x.dtype for x in jax.tree.leaves(solution)} <= {
        expected,
        *map(jnp.dtype, ("bool", "int32", "uint32")),
    }


# --- the smallest and the senseless ---------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 2, 3])
def test_the_smallest_problems_end_finite(n, x64):
    problem = problem_of(matches_of(15, n, wrong=0), scale=1.3)
    # Padded, so that the program is one that stands already.
    solution = solve(pad_problem(problem, N))
    assert_finite(solution)
    assert (int(solution.status) == tj.Status.TOO_FEW_POINTS) == (n < 3)


@pytest.mark.parametrize("bad", [np.nan, np.inf, 0.0, -1.0])
@pytest.mark.parametrize("name", ["scale", "cbar2"])
def test_a_traced_scale_or_truncation_that_makes_no_sense_ends_finite(name, bad, x64):
    problem = problem_of(matches_of(1), scale=1.3)
    solution = solve(replace(problem, **{name: jnp.asarray(bad, problem.src.dtype)}))
    assert_finite(solution)
    assert int(solution.status) == tj.Status.TOO_FEW_POINTS


@pytest.mark.long
def test_a_solution_is_shown_in_a_line_or_two(x64):
    problem = problem_of(matches_of(1), scale=None)
    assert "OK" in repr(solve(problem))
    assert f"inliers of shape ({STACK}, {N})" in repr(solve_stack(tj.stack_problems([problem] * STACK)))
