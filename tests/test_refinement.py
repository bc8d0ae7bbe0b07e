"""The joint fit against Umeyama's formula in numpy, and the descent by its laws."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import joint_residuals, pose_error, random_matches

import teaser_jax as tj
from teaser_jax.stages.refinement import NARROW, fit_similarity, refine, squared_residuals, truncated_cost

pytestmark = pytest.mark.usefixtures("x64")

N = 32
ONE = np.float64(1)


@jax.jit
def fit(src, dst, weights, scale=None):
    return fit_similarity(src, dst, weights, scale).pose


@partial(jax.jit, static_argnames="iterations")
def descend(pose, src, dst, bounds, mask, scale=ONE, iterations=50):
    scale = None if scale is None else jnp.asarray(scale)
    return refine(pose, src, dst, bounds, mask, scale=scale, cbar2=jnp.asarray(ONE), iterations=iterations)


def umeyama(src, dst, weights, scale=None) -> tj.Pose:
    """The weighted similarity fit in numpy, by LAPACK's SVD."""
    a, b = (x - np.average(x, axis=0, weights=weights) for x in (src, dst))
    h = np.einsum("n,ni,nj->ij", weights, b, a)
    left, _, right = np.linalg.svd(h)
    rotation = left @ np.diag([1, 1, np.linalg.det(left) * np.linalg.det(right)]) @ right
    if scale is None:
        scale = np.sum(rotation * h) / np.sum(weights[:, None] * a**2)
    centre = [np.average(x, axis=0, weights=weights) for x in (src, dst)]
    return tj.Pose(rotation, centre[1] - scale * rotation @ centre[0], np.float64(scale))


@pytest.mark.parametrize("known", [True, False])
def test_the_fit_is_umeyamas(known):
    for seed in range(10):
        matches = random_matches(seed, N, wrong=0.2 * (seed % 3), scale=1.7)
        weights = np.random.default_rng(seed).uniform(size=N) * (np.arange(N) % 5 > 0)
        scale = np.float64(1.7) if known else None
        found = fit(matches.src, matches.dst, weights, scale)
        assert pose_error(found, umeyama(matches.src, matches.dst, weights, scale)) < 1e-12


@pytest.mark.parametrize("flat", [False, True])
def test_exact_data_give_the_exact_pose(flat):
    matches = random_matches(0, N, wrong=0, scale=0.3)
    src = matches.src * [1, 1, 0] if flat else matches.src
    found = fit(src, matches.truth.apply(src), np.ones(N))
    assert pose_error(found, matches.truth) < 1e-13


def test_a_mirror_image_gives_the_best_proper_rotation():
    src = random_matches(1, N).src
    mirrored = src * [1, 1, -1]
    found = fit(src, mirrored, np.ones(N))
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert pose_error(found, umeyama(src, mirrored, np.ones(N))) < 1e-12


def test_no_other_pose_nearby_fits_better():
    matches = random_matches(2, N, wrong=0.3, scale=1.2)
    weights = np.random.default_rng(2).uniform(size=N)
    best = jax.tree.map(np.asarray, fit(matches.src, matches.dst, weights))
    cost = lambda pose: np.sum(weights[:, None] * (matches.dst - pose.apply(matches.src)) ** 2)
    rng = np.random.default_rng(3)
    for _ in range(50):
        vector = 1e-3 * rng.normal(size=7)
        turn = np.asarray(jax.scipy.linalg.expm(jnp.asarray(np.cross(np.eye(3), vector[:3]))))
        small = tj.Pose(turn, vector[3:6], 1 + vector[6])
        assert cost(small @ best) > cost(best)


@pytest.mark.parametrize("known", [True, False])
def test_degenerate_input_gives_a_finite_fit(known):
    matches = random_matches(3, N)
    scale = ONE if known else None
    value_and_slope = jax.jit(jax.value_and_grad(lambda s, d, w: jnp.sum(fit(s, d, w, scale).matrix)))
    point, nothing = np.ones((N, 3)), np.zeros(N)
    for src, dst, weights in (
        (matches.src, matches.dst, nothing),
        (point, matches.dst, nothing + 1),
        (matches.src, point, nothing + 1),
        (point, point, nothing + 1),
        (np.outer(np.arange(N), [1.0, 2, 3]), matches.dst, nothing + 1),
    ):
        value, slope = value_and_slope(src, dst, weights)
        assert np.isfinite(value)
        assert np.all(np.isfinite(slope))
    assert fit(matches.src, matches.dst, nothing, scale).scale == 1
    assert fit(point, matches.dst, nothing + 1, scale).scale == 1


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_derivatives_agree_with_central_differences(known):
    matches = random_matches(4, N, wrong=0.2, scale=1.4)
    scale = np.float64(1.4)
    read = jax.jit(lambda s, d, w, x: fit_similarity(s, d, w, x if known else None).pose.matrix)
    point = (matches.src, matches.dst, np.random.default_rng(4).uniform(0.5, 1, N), scale)
    direction = tuple(np.random.default_rng(5).normal(size=np.shape(x)) for x in point)
    ahead, behind = (
        read(*(x + s * 1e-6 * d for x, d in zip(point, direction, strict=True))) for s in (1, -1)
    )
    central = (ahead - behind) / 2e-6
    forward = jax.jit(lambda p, d: jax.jvp(read, p, d)[1])(point, direction)
    np.testing.assert_allclose(forward, central, atol=1e-7)
    jacobians = jax.jit(jax.jacrev(read, argnums=(0, 1, 2, 3)))(*point)
    reverse = sum(np.tensordot(j, d, axes=np.ndim(d)) for j, d in zip(jacobians, direction, strict=True))
    np.testing.assert_allclose(reverse, forward, atol=1e-10)


def test_residuals_are_in_units_of_the_bounds():
    matches = random_matches(5, N)
    bounds = np.random.default_rng(5).uniform(0.05, 0.5, N)
    pose = jax.tree.map(jnp.asarray, matches.truth)
    r2 = squared_residuals(pose, *map(jnp.asarray, (matches.src, matches.dst, bounds)))
    expected = joint_residuals(matches.truth, matches.src, matches.dst, bounds) ** 2
    np.testing.assert_allclose(r2, expected, rtol=1e-9, atol=1e-12)
    mask = np.arange(N) % 3 > 0
    cost = truncated_cost(r2, jnp.asarray(mask), jnp.asarray(4.0))
    assert float(cost) == pytest.approx(np.sum(np.minimum(expected, 4)[mask]), rel=1e-9)


def cost_of(inliers, matches, bounds, mask, scale) -> float:
    weights = np.where(inliers, bounds**-2.0, 0)
    pose = fit(matches.src, matches.dst, weights, scale)
    return np.sum(np.minimum(joint_residuals(pose, matches.src, matches.dst, bounds) ** 2, 1)[mask])


@pytest.mark.long
@pytest.mark.parametrize("scale", [np.float64(1.3), None], ids=["known", "unknown"])
def test_the_descent_never_rises_and_ends_at_a_fixed_point(scale):
    moved = 0
    for seed in range(10):
        matches = random_matches(seed, N, wrong=0.3, noise_bound=0.2, scale=1.3)
        rng = np.random.default_rng(seed)
        bounds, mask = matches.noise_bound * rng.uniform(1, 1.5, N), rng.uniform(size=N) < 0.9
        nudge = tj.Pose(np.eye(3), 0.1 * rng.normal(size=3), ONE)
        start = nudge @ matches.truth
        data = start, matches.src, matches.dst, bounds, mask, scale
        costs = [np.sum(np.minimum(joint_residuals(start, matches.src, matches.dst, bounds) ** 2, 1)[mask])]
        costs += [cost_of(descend(*data, iterations=k)[0], matches, bounds, mask, scale) for k in (1, 2, 4)]
        inliers, settled = descend(*data)
        costs += [cost_of(inliers, matches, bounds, mask, scale)]
        assert np.all(np.diff(costs) <= 1e-9)
        moved += costs[-1] < costs[0] - 1e-3
        assert bool(settled)
        weights = np.where(inliers, bounds**-2.0, 0)
        pose = fit(matches.src, matches.dst, weights, scale)
        agree = mask & (joint_residuals(pose, matches.src, matches.dst, bounds) <= 1)
        np.testing.assert_array_equal(inliers, agree)
    assert moved >= 8


def test_the_iteration_cap_is_reported():
    matches = random_matches(0, N, wrong=0.0, noise_bound=0.3)
    start = tj.Pose(matches.truth.rotation, matches.truth.translation + 0.25, ONE)
    data = start, matches.src, matches.dst, np.full(N, 0.3), np.ones(N, bool)
    assert not bool(descend(*data, iterations=1)[1])
    assert bool(descend(*data)[1])


def test_a_hopeless_start_stays_put():
    matches = random_matches(1, N)
    far = tj.Pose(np.eye(3), np.full(3, 100.0), ONE)
    inliers, settled = descend(far, matches.src, matches.dst, np.full(N, 0.05), np.ones(N, bool))
    assert not np.any(inliers)
    assert bool(settled)


def test_the_lower_of_two_ends_counts():
    """Bounds of half the noise make many ends; each start alone is followed in numpy."""
    differ = 0
    for seed in range(12):
        matches = random_matches(seed, N, wrong=0.3, noise_bound=0.3)
        bounds, mask = np.full(N, 0.25), np.ones(N, bool)
        rng = np.random.default_rng(seed)
        start = tj.Pose(np.eye(3), 0.05 * rng.normal(size=3), ONE) @ matches.truth
        residuals = joint_residuals(start, matches.src, matches.dst, bounds)
        ends = []
        for inliers in (residuals <= 1, residuals <= NARROW):
            for _ in range(50):
                if inliers.sum() < 3:  # which fix no rotation
                    break
                pose = umeyama(matches.src, matches.dst, np.where(inliers, 1.0, 1e-300), ONE)
                found = joint_residuals(pose, matches.src, matches.dst, bounds)
                inliers = found <= 1
            ends.append(np.sum(np.minimum(found**2, 1)) if inliers.sum() >= 3 else np.inf)
        inliers, settled = descend(start, matches.src, matches.dst, bounds, mask)
        assert bool(settled)
        assert min(ends) < np.inf
        assert cost_of(inliers, matches, bounds, mask, ONE) == pytest.approx(min(ends), rel=1e-9)
        differ += max(ends) > min(ends) + 1e-6
    assert differ >= 4
