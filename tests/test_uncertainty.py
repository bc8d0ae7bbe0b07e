"""The covariance of a pose: against Monte Carlo, between conventions, and where there is none."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import problem_of, random_matches, solve
from scipy.stats import chi2

import teaser_jax as tj
from teaser_jax.uncertainty import pose_difference

N, RUNS, SIGMA = 32, 300, 0.01
GREEDY = tj.Settings(clique="greedy")
CONVENTIONS = ("right", "gtsam", "g2o", "ros")
# One program for all: each by itself takes as long to compile.
in_all_conventions = jax.jit(
    lambda problem, solution: [tj.covariance(problem, solution, SIGMA, convention=c) for c in CONVENTIONS]
)


def error_between(answer: tj.Pose, truth: tj.Pose, convention: str, unknown: bool) -> jax.Array:
    """The coordinates as the docstring defines them, with the logarithm of the rotation in full."""
    between = answer.rotation.T @ truth.rotation
    skew = jnp.stack(
        [between[2, 1] - between[1, 2], between[0, 2] - between[2, 0], between[1, 0] - between[0, 1]]
    )
    sine = jnp.linalg.norm(skew) / 2
    w = skew / 2 * jnp.arctan2(sine, (jnp.trace(between) - 1) / 2) / sine
    shift = truth.translation - answer.translation
    v = answer.rotation.T @ shift
    found = {
        "right": (w, v), "gtsam": (w, v), "g2o": (v, w / 2), "ros": (shift, answer.rotation @ w)
    }[convention]  # fmt: skip
    last = [jnp.log(truth.scale / answer.scale)[None]] if unknown else []
    return jnp.concatenate([*found, *last])


@pytest.mark.long
@pytest.mark.parametrize(
    ("scale", "refine"),
    [
        pytest.param(1.5, True, id="known"),
        pytest.param(None, True, id="unknown", marks=pytest.mark.slow),
        pytest.param(1.5, False, id="cascade", marks=pytest.mark.slow),
    ],
)
def test_errors_are_as_large_as_the_covariance_says(scale, refine, x64):
    # Normalised errors squared follow chi^2: their mean over the runs must lie within its 95 % band. The
    # noise differs from match to match, and the weights are not the best ones.
    matches = random_matches(3, N, wrong=0.3, noise=0.0, scale=1.5)
    rng = np.random.default_rng(0)
    sigma = SIGMA * rng.uniform(0.3, 1, N)
    base = problem_of(matches, scale=scale, confidence=rng.uniform(0.5, 1, N))
    settings = replace(GREEDY, refine=refine)
    conventions = CONVENTIONS if scale and refine else CONVENTIONS[:1]  # each takes seconds to compile

    def run(key):
        noise = sigma[:, None] * jax.random.normal(key, (N, 3)) * matches.inliers[:, None].astype(float)
        problem = replace(base, dst=base.dst + noise)
        solution = tj.solve(problem, settings)
        squares, apart = [], []
        for convention in conventions:
            found = tj.covariance(problem, solution, sigma, convention=convention)
            error = error_between(solution.pose, matches.truth, convention, scale is None)
            squares.append(error @ found.information @ error)
            mine = pose_difference(
                solution.pose, matches.truth, convention=convention, with_scale=scale is None
            )
            apart.append(jnp.max(jnp.abs(mine - error)))
        return jnp.stack(squares), solution.ok, jnp.stack(apart)

    squares, ok, apart = jax.jit(jax.vmap(run))(jax.random.split(jax.random.key(0), RUNS))
    assert np.all(ok)
    np.testing.assert_allclose(apart, 0, atol=1e-12)
    d = 6 if scale else 7
    low, high = chi2.ppf([0.025, 0.975], d * RUNS) / RUNS
    for mean in np.mean(squares, axis=0):
        assert low < mean < high
    for other in np.asarray(squares).T[1:]:
        np.testing.assert_allclose(other, squares[:, 0], rtol=0.05)


@pytest.mark.long
def test_covariance_and_information_are_inverse_and_symmetric(x64):
    problem = problem_of(random_matches(4, N, wrong=0.3), scale=None)
    several = in_all_conventions(problem, solve(problem))
    assert [found.convention for found in several] == list(CONVENTIONS)
    for found in several:
        np.testing.assert_allclose(found.covariance @ found.information, np.eye(7), atol=1e-8)
        np.testing.assert_allclose(found.covariance, found.covariance.T, atol=1e-18)
        np.testing.assert_array_less(0, np.linalg.eigvalsh(found.covariance))


@pytest.mark.long
def test_least_squares_has_the_covariance_of_its_normal_equations(x64):
    matches = random_matches(5, N, wrong=0.0, noise=0.1)
    problem = problem_of(matches)
    solution = solve(problem)
    found, rotation = tj.covariance(problem, solution, SIGMA), solution.pose.rotation
    rows = [np.hstack([-rotation @ np.asarray(tj.so3.hat(a)), rotation]) for a in matches.src]
    information = sum(row.T @ row for row in rows) / SIGMA**2
    np.testing.assert_allclose(found.information, information, rtol=0.02, atol=1e-3 * information.max())


@pytest.mark.long
def test_the_deviation_can_be_estimated():
    matches = random_matches(6, 400, wrong=0.2, noise=0.0, noise_bound=0.06)
    rng = np.random.default_rng(0)
    dst = matches.dst + SIGMA * rng.normal(size=(400, 3))
    result = tj.register(matches.src, dst, noise_bound=0.06)
    told = tj.covariance(result.problem, result.solution, SIGMA)
    guessed = tj.covariance(result.problem, result.solution)
    assert told.covariance.dtype == np.float64  # register's problems are numpy in float64
    np.testing.assert_allclose(guessed.covariance, told.covariance, rtol=0.1)


@pytest.mark.long
def test_an_answer_that_failed_knows_nothing(x64):
    problem = problem_of(random_matches(14, N, wrong=1.0))
    found = tj.covariance(problem, solve(problem), SIGMA)
    np.testing.assert_array_equal(found.information, 0)
    assert np.all(np.isinf(np.diag(found.covariance)))


@pytest.mark.long
def test_no_noise_is_exact(x64):
    problem = problem_of(random_matches(7, N, wrong=0.3))
    found = tj.covariance(problem, solve(problem), 0.0)
    np.testing.assert_array_equal(found.covariance, 0)
    assert np.all(np.isinf(np.diag(found.information)))


@pytest.mark.long
def test_bad_arguments_are_told_apart(unchecked):
    matches = random_matches(8, N)
    result = tj.register(matches.src, matches.dst, noise_bound=0.05)
    for sigma, words in (
        (-1.0, "below 0"),
        (np.nan, "below 0"),
        (np.ones(3), "shape"),
        ({}, "sigma"),
        (10**400, "sigma"),
    ):
        with pytest.raises(ValueError, match=words):
            tj.covariance(result.problem, result.solution, sigma)
    with pytest.raises(ValueError, match="expected one of 'right', 'ros'"):
        tj.covariance(result.problem, result.solution, SIGMA, convention="left")
    with pytest.raises(ValueError, match="expected one of 'right', 'ros'"):
        pose_difference(result.pose, result.pose, convention="left")


@pytest.mark.long
def test_the_difference_of_equal_poses_is_zero_and_has_a_finite_gradient(x64):
    pose = jax.tree.map(jnp.asarray, random_matches(0).truth)
    np.testing.assert_allclose(pose_difference(pose, pose), 0, atol=1e-15)
    slope = jax.jit(jax.grad(lambda p: jnp.sum(pose_difference(p, pose, with_scale=True))))(pose)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(slope))


@pytest.mark.parametrize("angle", [1e-9, 1.0, np.pi - 1e-9, np.pi])
def test_every_turn_is_seen_in_full(angle, x64):
    pose = jax.tree.map(jnp.asarray, random_matches(0).truth)
    turn = tj.so3.rotation_from_quat(jnp.asarray([np.sin(angle / 2), 0, 0, np.cos(angle / 2)]))
    found = pose_difference(pose, replace(pose, rotation=pose.rotation @ turn))
    assert np.linalg.norm(found[:3]) == pytest.approx(angle, abs=1e-12)


@pytest.mark.long
def test_a_stack_and_a_solution_of_another_problem_are_refused():
    matches, others = random_matches(8, N), random_matches(8, N + 1)
    result, other = (tj.register(m.src, m.dst, noise_bound=0.05) for m in (matches, others))
    with pytest.raises(ValueError, match="a problem and its own solution"):
        tj.covariance(result.problem, other.solution)


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, None])
@pytest.mark.parametrize("offset", [100.0, 1000.0])
def test_far_origins_keep_a_finite_information(scale, offset):
    """A turn about a far origin is nearly a shift: float32 took that for errors that are exactly zero."""
    drawn = tj.synthetic.random_problem(0, n=N, outlier_rate=0.3)
    here = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, scale=scale)
    far = tj.make_problem(drawn.src + offset, drawn.dst, noise_bound=drawn.noise_bound, scale=scale)
    found = tj.covariance(far, solve(far, GREEDY), 0.01)
    problem = tj.host_problem(drawn.src + offset, drawn.dst, noise_bound=drawn.noise_bound, scale=scale)
    moved = tj.register(drawn.src + offset, drawn.dst, noise_bound=drawn.noise_bound, scale=scale)
    exact = tj.covariance(problem, moved.solution, 0.01)
    assert np.isfinite(found.information).all()
    np.testing.assert_allclose(found.covariance[:3, :3], exact.covariance[:3, :3], rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(np.diagonal(found.information), np.diagonal(exact.information), rtol=5e-3)
    # The rotation's own part does not depend on where the origin is.
    near = tj.covariance(
        tj.host_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, scale=scale), here.solution, 0.01
    )
    np.testing.assert_allclose(exact.covariance[:3, :3], near.covariance[:3, :3], rtol=1e-6, atol=1e-12)


def test_other_records_are_told_apart(unchecked):
    drawn = tj.synthetic.random_problem(0, n=32, outlier_rate=0.3)
    result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    problem = tj.host_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    with pytest.raises(ValueError, match="convention=... has its name"):
        tj.covariance(problem, result.solution, "gtsam")
    with pytest.raises(ValueError, match="give solution.selection"):
        tj.refit(problem, result.solution)
    with pytest.raises(ValueError, match="expected Settings"):
        tj.solve(problem, "greedy")
    with pytest.raises(ValueError, match="make one with make_problem"):
        tj.solve(drawn.src)
    with pytest.raises(ValueError, match="made with a known scale"):
        tj.refit(replace(problem, scale=None), result.solution.selection)
    with pytest.raises(ValueError, match="received Problem"):
        tj.stack_problems(problem)
    with pytest.raises(ValueError, match="problem 1 of the list"):
        tj.stack_problems([problem, replace(problem, dst=problem.dst[:5])])
    with pytest.raises(ValueError, match="inside jit use make_problem"):
        jax.jit(lambda x: tj.host_problem(x, x, noise_bound=1.0))(drawn.src)
    pose = jax.tree.map(lambda x: np.stack([x, x]), result.pose)
    with pytest.raises(ValueError, match="use jax.vmap for stacks"):
        pose_difference(pose, pose)
