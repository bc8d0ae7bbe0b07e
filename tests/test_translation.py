"""The translation, axis by axis, against enumeration."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import in_ball, largest_consensus, mean_of, tls_by_enumeration, tls_cost

from teaser_jax.stages.translation import estimate_translation, translation_of_points

pytestmark = pytest.mark.usefixtures("x64")

N = 30
TRUTH = np.array([0.3, -2.0, 1.0])


@partial(jax.jit, static_argnames="criterion")
def estimate(offsets, noise_bound, mask, cbar2=1.0, criterion="tls"):
    return estimate_translation(
        offsets, noise_bound, mask, cbar2=jnp.asarray(cbar2, offsets.dtype), criterion=criterion
    )


def offsets_of(seed: int, wrong: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    bounds = rng.uniform(0.05, 0.2, N)
    offsets = TRUTH + bounds[:, None] * in_ball(rng, N, 1.0)
    offsets[rng.permutation(N) < wrong * N] = in_ball(rng, int(np.ceil(wrong * N)), 5.0)
    return offsets, bounds, rng.uniform(size=N) < 0.9


def test_each_axis_is_a_global_optimum():
    for seed in range(10):
        offsets, bounds, mask = offsets_of(seed)
        for cbar2 in (1.0, 4.0):
            found, members = estimate(offsets, bounds, mask, cbar2)
            for axis in range(3):
                data = offsets[mask, axis], bounds[mask], cbar2
                assert tls_cost(float(found[axis]), *data) <= tls_by_enumeration(*data) * (1 + 1e-9)
                agree = np.abs(offsets[:, axis] - float(found[axis])) <= np.sqrt(cbar2) * bounds
                np.testing.assert_array_equal(members[:, axis], agree & mask)
        np.testing.assert_allclose(found, TRUTH, atol=0.2)


def test_consensus_takes_the_most_points():
    offsets, bounds, mask = offsets_of(3)
    _, members = estimate(offsets, bounds, mask, criterion="consensus")
    sizes = [largest_consensus(offsets[mask, k], bounds[mask], 1.0) for k in range(3)]
    np.testing.assert_array_equal(members.sum(axis=0), sizes)


def test_shifting_the_offsets_shifts_the_answer():
    offsets, bounds, mask = offsets_of(4)
    plain, members = estimate(offsets, bounds, mask)
    moved, same = estimate(offsets + np.array([1.0, 2.0, 3.0]), bounds, mask)
    np.testing.assert_allclose(moved, plain + np.array([1.0, 2.0, 3.0]), atol=1e-12)
    np.testing.assert_array_equal(same, members)


def test_nobody_to_vote_is_zero():
    offsets, bounds, mask = offsets_of(5)
    found, members = estimate(offsets, bounds, mask & False)
    assert np.all(np.asarray(found) == 0)
    assert not np.any(members)


def test_float32_votes_in_float64():
    offsets, bounds, mask = offsets_of(6)
    offsets, bounds = offsets.astype(np.float32), bounds.astype(np.float32)
    wide, expected = estimate(offsets.astype(float), bounds.astype(float), mask)
    with jax.enable_x64(False):
        found, members = estimate(offsets, bounds, mask)
    assert found.dtype == jnp.float32
    np.testing.assert_allclose(found, wide, rtol=1e-6)
    np.testing.assert_array_equal(members, expected)


def test_read_out_is_the_weighted_mean_of_each_axis():
    offsets, bounds, mask = offsets_of(7)
    found, members = estimate(offsets, bounds, mask)
    read = translation_of_points(*map(jnp.asarray, (offsets, bounds, np.ones(N))), members)
    np.testing.assert_allclose(read, found, rtol=1e-12)
    confidence = np.random.default_rng(0).uniform(0.1, 1, N)
    read = translation_of_points(*map(jnp.asarray, (offsets, bounds, confidence)), members)
    for k in range(3):
        expected = mean_of(np.asarray(members[:, k]), offsets[:, k], bounds / np.sqrt(confidence))
        assert float(read[k]) == pytest.approx(expected, rel=1e-12)


def test_an_axis_without_points_reads_as_zero_with_finite_gradient():
    offsets, bounds, _ = offsets_of(8)
    members = jnp.ones((N, 3), bool).at[:, 1].set(False)
    read = lambda x, b: translation_of_points(x, b, jnp.ones(N), members)
    assert read(jnp.asarray(offsets), jnp.asarray(bounds))[1] == 0
    slopes = jax.jit(jax.jacrev(read, argnums=(0, 1)))(offsets, bounds)
    assert all(np.all(np.isfinite(s)) for s in slopes)
    assert np.all(np.asarray(slopes[0])[1] == 0)


def test_gradient_of_the_read_out_is_the_central_difference():
    offsets, bounds, mask = offsets_of(9)
    _, members = estimate(offsets, bounds, mask)
    read = jax.jit(lambda *x: jnp.sum(translation_of_points(*x, members) * jnp.array([1.0, 2.0, 3.0])))
    point = (offsets, bounds, np.full(N, 0.7))
    direction = tuple(np.random.default_rng(1).normal(size=x.shape) for x in point)
    ahead, behind = (
        read(*(x + s * 1e-6 * d for x, d in zip(point, direction, strict=True))) for s in (1, -1)
    )
    gradient = jax.jit(jax.grad(read, argnums=(0, 1, 2)))(*point)
    slope = sum(np.sum(g * d) for g, d in zip(gradient, direction, strict=True))
    assert slope == pytest.approx(float(ahead - behind) / 2e-6, abs=1e-6)
