"""Bounds are wider by what the fit is uncertain of, and a bound as documented costs no accuracy."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import in_ball, random_pose

import teaser_jax as tj
from teaser_jax.stages.refinement import squared_residuals
from teaser_jax.stages.widening import FEWEST, PIVOTS, SHARE, bound_widening


def draw(seed: int, right: int, wrong: int, gaussian: bool, scale: float):
    """Matches whose bound is exactly the largest error of a right one."""
    rng = np.random.default_rng(seed)
    n = right + wrong
    src, truth = rng.uniform(-0.5, 0.5, (n, 3)), random_pose(rng, scale)
    error = 0.007 * rng.normal(size=(n, 3)) if gaussian else in_ball(rng, n, 0.02)
    dst = truth.apply(src) + error
    dst[right:] = dst.mean(axis=0) + rng.uniform(-scale, scale, (wrong, 3))
    return src, dst, truth, float(np.linalg.norm(error[:right], axis=1).max())


def angle(pose: tj.Pose, truth: tj.Pose) -> float:
    return float(np.degrees(tj.so3.rotation_angle(np.asarray(pose.rotation).T @ truth.rotation)))


@pytest.mark.long
@pytest.mark.parametrize("gaussian", [False, True], ids=["uniform", "gaussian"])
@pytest.mark.parametrize(("scale", "known"), [(1.0, True), (1.3, False)], ids=["known", "unknown"])
@pytest.mark.parametrize(("right", "limit"), [(12, 1.1), (24, 1.05)])
def test_a_bound_as_documented_costs_no_accuracy(right, limit, gaussian, scale, known):
    """Right matches at the bound used to fall out and to drag the fit: 1.3 to 1.7 times the error."""
    given, everything, truths = [], [], []
    for seed in range(50):
        src, dst, truth, largest = draw(seed, right, 32 - right, gaussian, scale)
        known_as = dict(noise_bound=largest, scale=scale if known else None)
        given.append(tj.host_problem(src, dst, **known_as))
        only = tj.host_problem(src, dst, **{**known_as, "noise_bound": 10.0}, mask=np.arange(32) < right)
        everything.append(only)
        truths.append(truth)
    none = tj.Settings(clique="none")
    ours, best = (
        [angle(s.pose, t) for s, t in zip(tj.solve_batch(p, settings=how), truths, strict=True)]
        for p, how in ((given, tj.Settings()), (everything, none))
    )
    assert np.median(ours) <= limit * np.median(best)


def test_the_widening_is_that_of_the_formula(x64):
    src, dst, _, bound = draw(0, 30, 70, False, 1.0)
    lengths = [np.linalg.norm(x[:PIVOTS, None] - x[None], axis=2) for x in (src, dst)]
    most = np.sum(np.abs(lengths[1] - lengths[0]) <= 2 * bound, axis=1).max()
    bounds, mask = np.full(100, bound), np.ones(100, bool)
    widen = jax.jit(partial(bound_widening, scale=jnp.asarray(1.0), cbar2=jnp.asarray(1.0)))
    found = float(widen(src, dst, bounds, mask))
    assert found == pytest.approx(1 + SHARE / np.sqrt(most))
    assert float(widen(src, dst, bounds, ~mask)) == 1 + SHARE / np.sqrt(FEWEST)
    every = np.stack(np.triu_indices(100, 1), axis=1).astype(np.int32)
    lengths = [np.linalg.norm(x[every[:, 0]] - x[every[:, 1]], axis=1) for x in (src, dst)]
    share = np.mean(np.abs(lengths[1] - lengths[0]) <= 2 * bound)
    found = float(widen(src, dst, bounds, mask, pairs=every))
    assert found == pytest.approx(1 + SHARE / np.sqrt(100 * np.sqrt(share)))


@pytest.mark.long
def test_all_that_is_said_of_an_answer_rests_on_the_widened_bounds(x64):
    for seed in range(5):
        src, dst, _, bound = draw(seed, 16, 16, False, 1.0)
        result = tj.register(src, dst, noise_bound=bound)
        s, wide = result.solution, float(result.solution.selection.widening)
        assert 1 < wide < 1.6
        assert f"bounds are {wide:.3g} times those given" in str(result)
        r2 = np.asarray(squared_residuals(s.pose, src, dst, np.full(32, wide * bound)))
        np.testing.assert_array_equal(result.inliers, r2 <= 1)
        assert float(s.cost) == pytest.approx(np.minimum(r2, 1).sum())
        assert result.inliers.sum() <= s.clique_upper_bound
        assert float(result.certificate.explained_gap) >= -1e-12
        plain = tj.register(src, dst, noise_bound=bound, settings=tj.Settings(refine=False))
        assert plain.solution.selection.widening == 1
