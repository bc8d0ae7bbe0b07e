"""The softened problem: a fixed point, its derivative three ways, and what becomes of hopeless input."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax
from oracles import assert_finite, derivatives, nothing_of, problem_of, random_matches, solve

import teaser_jax as tj
from teaser_jax.stages.refinement import fit_similarity, squared_residuals
from teaser_jax.stages.rotation.gnc import gnc_cost, gnc_weights

N = 32
soften = jax.jit(lambda problem, gnc_mu: tj.soft_solve(problem, gnc_mu=gnc_mu))


def blurred(seed: int, *, scale=None) -> tj.Problem:
    """A problem in which residuals of right matches spread over the threshold."""
    rng = np.random.default_rng(seed)
    matches = random_matches(seed, N, wrong=0.4, scale=1.3)
    problem = problem_of(matches, scale=scale, confidence=rng.uniform(0.5, 1, N))
    return replace(problem, dst=problem.dst + 0.02 * rng.normal(size=(N, 3)))


def moved(problem: tj.Problem, gnc_mu: float, name: str, step) -> tuple[tj.Problem, float]:
    if name == "gnc_mu":
        return problem, np.asarray(gnc_mu + step)
    return replace(problem, **{name: np.asarray(getattr(problem, name) + step)}), gnc_mu


@jax.jit
def both_ways(problem, gnc_mu, direction, cotangent):
    """Derivatives of pose and weights along a direction, and the gradient of their combination."""
    names = [name for name in direction if name != "gnc_mu"]

    def run(inputs):
        known = {name: inputs[name] for name in names}
        found = tj.soft_solve(replace(problem, **known), gnc_mu=inputs["gnc_mu"])
        return found.pose.matrix, found.weights

    inputs = {**{name: getattr(problem, name) for name in names}, "gnc_mu": gnc_mu}
    _, along = jax.linearize(run, inputs)  # one program for both: most of a test's time is XLA's
    return along(direction), jax.linear_transpose(along, inputs)(cotangent)[0]


NAMES = ("src", "dst", "noise_bound", "confidence", "cbar2")


def inputs_and(problem, gnc_mu) -> dict:
    """Everything that the pose and the weights have derivatives in."""
    names = [*NAMES] + ["scale"] * (problem.scale is not None)
    # One type of each number: another would be another program.
    known = {**{name: getattr(problem, name) for name in names}, "gnc_mu": gnc_mu}
    return {name: np.asarray(x, problem.src.dtype) for name, x in known.items()}


def slope_of_pose(problem, cotangent) -> np.ndarray:
    """The gradient, in the targets, of a combination of the pose's numbers."""
    still = jax.tree.map(np.zeros_like, inputs_and(problem, 1.0))
    return both_ways(problem, np.float64(1), still, (cotangent, np.zeros(N)))[1]["dst"]


@pytest.mark.long
@pytest.mark.parametrize(
    "scale", [pytest.param(1.3, id="known"), pytest.param(None, id="unknown", marks=pytest.mark.slow)]
)
def test_forward_reverse_and_central_differences_agree(scale, x64):
    rng = np.random.default_rng(0)
    problem, mu = blurred(11, scale=scale), np.float64(1)
    inputs = inputs_and(problem, mu)
    problem = replace(problem, **{name: x for name, x in inputs.items() if name != "gnc_mu"})
    found = soften(problem, mu)
    assert found.ok
    assert np.sum((found.weights > 0.01) & (found.weights < 0.99)) >= 3
    cotangent = rng.normal(size=(4, 4)), rng.normal(size=N)
    for name, value in inputs.items():
        direction = {key: np.zeros_like(x) for key, x in inputs.items()}
        direction[name] = np.asarray(rng.normal(size=value.shape) * (0.1 if name == "noise_bound" else 1))
        forward, gradient = both_ways(problem, mu, direction, cotangent)
        ahead, behind = (soften(*moved(problem, mu, name, sign * 1e-6 * direction[name])) for sign in (1, -1))
        central = [
            (a - b) / 2e-6
            for a, b in ((ahead.pose.matrix, behind.pose.matrix), (ahead.weights, behind.weights))
        ]
        for mine, theirs in zip(forward, central, strict=True):
            size = max(1.0, float(np.max(np.abs(theirs))))
            np.testing.assert_allclose(mine, theirs, atol=1e-6 * size, err_msg=name)
        combined = sum(np.sum(c * f) for c, f in zip(cotangent, forward, strict=True))
        np.testing.assert_allclose(np.sum(gradient[name] * direction[name]), combined, rtol=1e-9, atol=1e-9)


@pytest.mark.long
def test_unrolling_the_iteration_gives_the_same_gradient(x64):
    problem = blurred(12, scale=1.3)
    found = soften(problem, np.float64(1))
    start, bound = found.pose, problem.noise_bound * found.solution.selection.widening
    cotangent = np.random.default_rng(0).normal(size=(4, 4))

    def unrolled(dst):
        def step(_, pose):
            r2 = squared_residuals(pose, problem.src, dst, bound)
            w = problem.confidence / bound**2 * gnc_weights(r2, 1.0, problem.cbar2)
            return fit_similarity(problem.src, dst, w, problem.scale).pose

        return jnp.sum(cotangent * lax.fori_loop(0, 60, step, start).matrix)

    implicit = slope_of_pose(problem, cotangent)
    np.testing.assert_allclose(implicit, jax.jit(jax.grad(unrolled))(problem.dst), atol=1e-8)


def _pose(problem: tj.Problem) -> tj.Pose:
    return tj.soft_solve(problem).pose


@pytest.mark.long
def test_matches_near_the_threshold_have_a_gradient_that_solve_lacks(x64):
    problem = blurred(11, scale=1.3)
    found = soften(problem, np.float64(1))
    half = (found.weights > 0.05) & (found.weights < 0.95)
    out = half & ~found.solution.inliers
    assert out.any()
    soft = slope_of_pose(problem, np.ones((4, 4)))
    _, hard = derivatives(problem, tj.Settings(), nothing_of(problem), np.ones((4, 4)))
    assert np.all(np.linalg.norm(soft, axis=1)[out] > 1e-6)
    np.testing.assert_array_equal(hard["dst"][out], 0)


@pytest.mark.long
def test_a_stiff_control_gives_the_answer_of_solve(x64):
    problem = problem_of(random_matches(13, N, wrong=0.4), scale=None)
    stiff = soften(problem, np.float64(1e6))
    np.testing.assert_allclose(stiff.pose.matrix, solve(problem).pose.matrix, atol=1e-9)
    np.testing.assert_allclose(stiff.weights, stiff.solution.inliers, atol=1e-6)
    assert stiff.cost == pytest.approx(float(stiff.solution.cost), rel=1e-6)


@pytest.mark.long
def test_the_cost_is_stationary_and_least(x64):
    problem = blurred(14, scale=None)
    found = soften(problem, np.float64(1))
    bound = problem.noise_bound * found.solution.selection.widening

    @jax.jit
    def cost(pose):
        r2 = squared_residuals(pose, problem.src, problem.dst, bound)
        return jnp.sum(problem.confidence * gnc_cost(r2, 1.0, problem.cbar2))

    rng = np.random.default_rng(0)
    assert float(cost(found.pose)) == pytest.approx(float(found.cost))
    for _ in range(20):
        turn = tj.so3.rotation_from_quat(np.append(1e-3 * rng.normal(size=3), 1.0))
        shift, scale = found.pose.translation + 1e-3 * rng.normal(size=3), found.pose.scale * 1.0005
        assert cost(tj.Pose(found.pose.rotation @ turn, shift, scale)) > found.cost


def test_weights_are_the_slope_of_the_cost(x64):
    r2 = np.linspace(0, 4, 1001)
    slopes = [jax.jit(jax.vmap(jax.grad(f), (0, None, None))) for f in (gnc_cost, gnc_weights)]
    weights = jax.jit(gnc_weights)
    for mu in (0.1, 1.0, 30.0):
        slope = np.asarray(slopes[0](r2, mu, 1.0))
        kinks = np.minimum(np.abs(r2 - mu / (mu + 1)), np.abs(r2 - (mu + 1) / mu)) < 1e-9
        np.testing.assert_allclose(slope[~kinks], np.asarray(weights(r2, mu, 1.0))[~kinks], atol=1e-9)
        assert np.all(np.isfinite(slopes[1](r2, mu, 1.0)))


@pytest.mark.long
def test_hopeless_items_are_finite_say_so_and_spoil_none(x64):
    good = blurred(15, scale=None)
    line = np.zeros((N, 3))
    line[:, 0] = np.linspace(0, 1, N)
    hopeless = [
        replace(good, src=jnp.full((N, 3), jnp.nan)),
        replace(good, mask=jnp.zeros(N, bool)),
        replace(good, src=jnp.asarray(line), dst=jnp.asarray(line)),
        replace(good, src=jnp.zeros((N, 3)), dst=jnp.zeros((N, 3))),
        problem_of(random_matches(14, N, wrong=1.0), scale=None),
    ]

    def total(src, problem):
        found = tj.soft_solve(replace(problem, src=src))
        return jnp.sum(found.pose.matrix), found

    gradient = jax.jit(jax.vmap(jax.value_and_grad(total, has_aux=True)))
    slopes = []
    for others in ([good] * len(hopeless), hopeless):
        batch = tj.stack_problems([good, *others])
        (_, found), slope = gradient(batch.src, batch)
        assert_finite(found)
        slopes.append(np.asarray(slope))
        assert np.all(np.isfinite(slopes[-1]))
    np.testing.assert_array_equal(slopes[1][0], slopes[0][0])
    assert not np.any(found.ok[1:])
    np.testing.assert_array_equal(slopes[1][1:5], 0)


@pytest.mark.long
@pytest.mark.parametrize("mu", [0.0, -1.0, np.nan, np.inf])
def test_a_control_that_makes_no_sense_is_no_success(mu, x64):
    found = soften(blurred(11), np.float64(mu))
    assert_finite(found)
    assert found.status == tj.Status.NOT_CONVERGED


def test_impossible_controls_are_refused_outside_jit(unchecked):
    problem = blurred(11)
    for mu in (0.0, -1.0, np.nan, np.inf, np.ones(2), "a", None, 10**400):
        with pytest.raises(ValueError, match="gnc_mu (is|has|holds).*(number|None)"):
            tj.soft_solve(problem, gnc_mu=mu)
    for iterations in (-1, 1.5, True):
        with pytest.raises(ValueError, match="expected a whole number"):
            tj.soft_solve(problem, iterations=iterations)


@pytest.mark.long
def test_a_wrong_match_may_be_as_far_away_as_it_likes():
    """The middle about which poses vary took part in wrong matches: DEGENERATE, where ``solve`` is OK."""
    drawn = tj.synthetic.random_problem(0, n=100, outlier_rate=0.5)
    src = drawn.src.copy()
    src[np.flatnonzero(~drawn.inliers)[0]] = 4000.0
    problem = tj.make_problem(src, drawn.dst, noise_bound=drawn.noise_bound)
    found = jax.jit(tj.soft_solve)(problem)
    assert found.solution.status == tj.Status.OK
    assert found.status == tj.Status.OK
    assert tj.metrics.errors(jax.device_get(found.pose), drawn.truth).rotation_deg < 3


@pytest.mark.slow
def test_single_precision_follows_double():
    problem = blurred(11, scale=1.3)
    with jax.enable_x64(True):
        wide = blurred(11, scale=1.3)
        exact = jax.jit(jax.grad(lambda dst: jnp.sum(_pose(replace(wide, dst=dst)).matrix)))(wide.dst)
    found = jax.jit(jax.grad(lambda dst: jnp.sum(_pose(replace(problem, dst=dst)).matrix)))(problem.dst)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, exact, atol=1e-3 * np.max(np.abs(exact)))
    assert soften(problem, np.float64(1)).ok


@pytest.mark.slow
def test_memory_does_not_grow_with_the_iterations():
    problem = blurred(11, scale=1.3)

    def temporaries(iterations):
        total = lambda dst: jnp.sum(
            tj.soft_solve(replace(problem, dst=dst), iterations=iterations).pose.matrix
        )
        return jax.jit(jax.grad(total)).lower(problem.dst).compile().memory_analysis().temp_size_in_bytes

    assert temporaries(500) == temporaries(5)


@pytest.mark.slow
def test_second_derivatives_too(x64):
    problem = blurred(11, scale=1.3)
    of = lambda scale: tj.soft_solve(replace(problem, scale=scale)).pose.translation[0]
    slope = jax.jit(jax.grad(of))
    central = (slope(1.3 + 1e-5) - slope(1.3 - 1e-5)) / 2e-5
    np.testing.assert_allclose(jax.jit(jax.grad(jax.grad(of)))(1.3), central, rtol=1e-5)
