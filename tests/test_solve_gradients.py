"""Derivatives of the whole method, and gradients past rows and items that cannot be used."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import (
    Matches,
    assert_finite,
    both_ways,
    derivatives,
    inputs_of,
    nothing_of,
    problem_of,
    random_matches,
    solve,
    solve_stack,
)

import teaser_jax as tj

N = 32
CASCADE = tj.Settings(clique="networkx", refine=False)


def matches_of(seed: int, n: int = N, *, wrong: float = 0.4) -> Matches:
    return random_matches(seed, n, wrong=wrong, scale=1.3)


@jax.jit
def derivatives_of_refit(problem, selection, direction, cotangent):
    return both_ways(lambda p: tj.refit(p, selection), problem, direction, cotangent)


@jax.jit
def slopes_of_stack(inputs, problems):
    """For each problem of a stack the gradient of the sum of its pose."""
    total = lambda inputs, problem: jnp.sum(tj.solve(replace(problem, **inputs)).pose.matrix)
    return jax.vmap(jax.grad(total))(inputs, problems)


@pytest.mark.long
@pytest.mark.parametrize(
    ("scale", "settings"),
    [(1.3, tj.Settings()), (None, CASCADE), (1.3, replace(CASCADE, tim_graph="complete"))],
    ids=["known", "cascade", "complete cascade"],
)
def test_forward_reverse_and_central_differences_agree(scale, settings, x64):
    # The differences re-run the solver. So does the derivative with refinement; that of the cascade is
    # taken of the read-out, which is its pose.
    rng = np.random.default_rng(0)
    problem = problem_of(matches_of(11), scale=scale, confidence=rng.uniform(0.5, 1, N))
    plain, cotangent = solve(problem, settings), rng.normal(size=(4, 4))
    for name, value in inputs_of(problem).items():
        direction = nothing_of(problem)
        direction[name] = rng.normal(size=np.shape(value)) * (0.1 if name == "noise_bound" else 1)
        if settings.refine:
            forward, gradient = derivatives(problem, settings, direction, cotangent)
        else:
            forward, gradient = derivatives_of_refit(problem, plain.selection, direction, cotangent)
        ahead, behind = (
            solve(replace(problem, **{name: value + sign * 1e-6 * direction[name]}), settings)
            for sign in (1, -1)
        )
        for moved in (ahead, behind):
            np.testing.assert_array_equal(moved.inliers, plain.inliers)
        central = (ahead.pose.matrix - behind.pose.matrix) / 2e-6
        np.testing.assert_allclose(forward, central, atol=1e-6, err_msg=name)
        np.testing.assert_allclose(
            np.sum(gradient[name] * direction[name]), np.sum(cotangent * forward), atol=1e-9
        )
        assert np.any(np.abs(forward) > 1e-6), name


@pytest.mark.long
def test_dead_rows_have_no_gradient_and_spoil_none(x64):
    settings, cotangent = tj.Settings(), np.random.default_rng(1).normal(size=(4, 4))
    problem = problem_of(matches_of(12), scale=1.3)
    nothing = nothing_of(problem)
    dead = np.arange(N) < 6
    clean = replace(problem, mask=problem.mask & ~dead)
    spoiled = replace(
        problem,
        src=problem.src.at[0].set(jnp.nan).at[1, 2].set(jnp.inf),
        dst=problem.dst.at[2].set(jnp.nan),
        noise_bound=problem.noise_bound.at[3].set(jnp.nan).at[4].set(0.0),
        confidence=problem.confidence.at[5].set(jnp.nan),
    )
    _, expected = derivatives(clean, settings, nothing, cotangent)
    _, found = derivatives(spoiled, settings, nothing, cotangent)
    for name in ("src", "dst", "noise_bound", "confidence"):
        assert np.all(np.isfinite(found[name])), name
        np.testing.assert_array_equal(np.asarray(found[name])[dead], 0)
        np.testing.assert_allclose(found[name], expected[name], atol=1e-12)
    assert int(solve(spoiled).excluded) == 5
    assert_finite(solve(spoiled))


@pytest.mark.long
def test_a_hopeless_item_leaves_its_neighbours_untouched(x64):
    good = problem_of(matches_of(13), scale=None)
    poisoned = [
        replace(good, src=jnp.full((N, 3), jnp.nan)),
        replace(good, mask=jnp.zeros(N, bool)),
        problem_of(matches_of(14, wrong=1.0), scale=None),
    ]
    answers, slopes = [], []
    for others in ([good, good, good], poisoned):
        batch = tj.stack_problems([good, *others])
        answers.append(solve_stack(batch))
        slopes.append(jax.device_get(slopes_of_stack(inputs_of(batch), batch)))
        assert_finite(answers[-1])
        assert_finite(slopes[-1])
    first, second = (jax.tree.map(lambda x: x[0], answer) for answer in answers)
    jax.tree.map(np.testing.assert_array_equal, second, first)
    for name in slopes[0]:
        np.testing.assert_array_equal(slopes[1][name][0], slopes[0][name][0], err_msg=name)
    assert not np.any(answers[1].ok[1:])
    expected = [tj.Status.TOO_FEW_POINTS, tj.Status.TOO_FEW_POINTS, tj.Status.NO_CONSENSUS]
    np.testing.assert_array_equal(answers[1].status[1:], expected)


@pytest.mark.long
def test_ambiguous_poses_have_gradient_zero_and_no_ok(x64):
    rng = np.random.default_rng(0)
    line = rng.uniform(-1, 1, (N, 1)) * [1.0, 2.0, 2.0]
    spot = np.ones((N, 3))
    two = np.where(np.arange(N)[:, None] % 2, [0.0, 0, 0], [1.0, 1, 1])
    problems = [
        replace(problem_of(matches_of(15), scale=None), src=jnp.asarray(x), dst=jnp.asarray(1.3 * x))
        for x in (line, spot, two)
    ]
    batch = tj.stack_problems([*problems, problem_of(matches_of(15), scale=None)])
    for name, slope in slopes_of_stack(inputs_of(batch), batch).items():
        np.testing.assert_array_equal(slope[:3], 0, err_msg=name)
        assert np.any(slope[3] != 0), name
    np.testing.assert_array_equal(solve_stack(batch).ok, [False, False, False, True])


@pytest.mark.long
def test_single_precision_follows_double():
    matches, cotangent = matches_of(11), np.random.default_rng(0).normal(size=(4, 4))

    def gradient():
        problem = problem_of(matches, scale=1.3)
        weights = cotangent.astype(problem.src.dtype)
        return derivatives(problem, tj.Settings(), nothing_of(problem), weights)[1]

    with jax.enable_x64(True):
        exact = gradient()
    for name, found in gradient().items():
        assert found.dtype == jnp.float32
        size = np.max(np.abs(exact[name]))
        np.testing.assert_allclose(found, exact[name], atol=1e-3 * size, err_msg=name)


@pytest.mark.long
def test_descent_through_the_solver_finds_what_distorts_its_input():
    # One axis of the source is stretched; the true poses are known, half of the matches are wrong.
    drawn = [random_matches(k, N, wrong=0.5, noise=0.2) for k in range(6)]
    stretch = np.array([1.0, 1.06, 1.0])
    seen = jnp.asarray(np.stack([d.src / stretch for d in drawn]), jnp.float32)
    dst = jnp.asarray(np.stack([d.dst for d in drawn]), jnp.float32)
    truth = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), jnp.float32), *[d.truth for d in drawn])
    traces = []

    def loss(guess):
        traces.append(1)

        def one(src, dst, truth):
            problem = tj.make_problem(src * guess[None], dst, noise_bound=0.15)
            pose = tj.solve(problem, tj.Settings(clique="greedy")).pose
            return tj.learn.point_loss(pose, truth, src * guess[None])

        return jnp.mean(jax.vmap(one)(seen, dst, truth))

    def step(guess, rate):
        value, slope = jax.value_and_grad(loss)(guess)
        return guess - rate * slope, value

    # The whole descent is one program: the solver in it is traced once and compiled once.
    rates = 0.1 * jnp.linspace(1, 0.1, 60)
    found, values = jax.jit(lambda start: jax.lax.scan(step, start, rates))(jnp.ones(3))
    assert len(traces) == 1
    assert values[-1] < 0.6 * values[0]
    assert values[1] < values[0]
    np.testing.assert_allclose(found, stretch, atol=0.02)
