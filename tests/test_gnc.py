"""GNC against its formulas written out, and its answers against the truth."""

from __future__ import annotations

from functools import partial
from itertools import combinations
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import in_ball, pack, random_matches, random_rotation, unpack

from teaser_jax import so3
from teaser_jax.stages.pairs import ring_pairs
from teaser_jax.stages.rotation.gnc import Gnc, gnc_rotation
from teaser_jax.stages.rotation.tims import complete_tims, correlation, correlation_of_pairs, listed_tims

pytestmark = pytest.mark.usefixtures("x64")

K = 40


class Measured(NamedTuple):
    """TIMs of one rotation, some of them wrong."""

    src: np.ndarray
    dst: np.ndarray
    bounds: np.ndarray
    truth: np.ndarray
    right: np.ndarray


def random_tims(seed: int, wrong: float, bound: float = 0.05) -> Measured:
    rng = np.random.default_rng(seed)
    src, truth = rng.normal(size=(K, 3)), random_rotation(rng)
    bounds = bound * rng.uniform(1, 2, K)
    dst = src @ truth.T + bounds[:, None] * in_ball(rng, K, 0.7)
    right = rng.permutation(K) >= round(wrong * K)
    lost = (~right).sum()
    dst[~right] = in_ball(rng, lost, 4.0)
    return Measured(src, dst, bounds, truth, right)


@partial(jax.jit, static_argnames="iterations")
def estimate(src, dst, bounds, mask=None, cbar2=1.0, factor=1.4, iterations=100):
    mask = jnp.ones(src.shape[0], bool) if mask is None else mask
    tims = listed_tims(src, dst, bounds, mask)
    return gnc_rotation(tims, Gnc(factor, iterations=iterations), cbar2=cbar2, dtype=src.dtype)


def wahba(weights, src, dst) -> np.ndarray:
    """The weighted fit by LAPACK."""
    left, _, right = np.linalg.svd(np.einsum("k,ki,kj->ij", weights, dst, src))
    return left @ np.diag([1, 1, np.linalg.det(left) * np.linalg.det(right)]) @ right


def gnc_weight(r2: np.ndarray, mu: float, cbar2: float) -> np.ndarray:
    """The piecewise formula, in squared residuals."""
    between = np.sqrt(cbar2 * mu * (mu + 1)) / np.sqrt(np.maximum(r2, 1e-300)) - mu
    return np.where(r2 <= mu / (mu + 1) * cbar2, 1.0, np.where(r2 >= (mu + 1) / mu * cbar2, 0.0, between))


def gnc_by_the_book(data: Measured, cbar2: float, factor: float, iterations: int):
    """The rotation, its members and how many TIMs carry it, in plain numpy."""
    inverse2 = data.bounds**-2.0
    residuals = lambda r: np.sum((data.dst - data.src @ r.T) ** 2, axis=1) * inverse2
    rotation = wahba(inverse2, data.src, data.dst)
    largest, last = residuals(rotation).max(), np.inf
    if 2 * largest - cbar2 <= 0:
        return rotation, residuals(rotation) <= cbar2, len(inverse2)
    mu = cbar2 / (2 * largest - cbar2)
    for _ in range(iterations):
        r2 = residuals(rotation)
        weights = gnc_weight(r2, mu, cbar2)
        cost = np.sum(weights * r2)
        rotation = wahba(weights * inverse2, data.src, data.dst)
        if np.all((weights == 0) | (weights == 1)) or abs(cost - last) <= 1e-6 * max(cost, cbar2):
            break
        last, mu = cost, mu * factor
    return rotation, residuals(rotation) <= cbar2, np.sum(weights > 0)


@pytest.mark.long
@pytest.mark.parametrize("iterations", [1, 2, 5, 100])
def test_every_round_follows_the_formulas(iterations):
    lost = 0
    for seed in range(10):
        for wrong in (0.1, 0.5, 0.8):
            data = random_tims(seed, wrong)
            expected, members, support = gnc_by_the_book(data, 1.0, 1.4, iterations)
            if support < 4:  # GNC went astray, and one or two TIMs leave the rotation open
                lost += 1
                continue
            found = estimate(*data[:3], iterations=iterations)
            np.testing.assert_allclose(found.rotation, expected, atol=1e-8)
            np.testing.assert_array_equal(found.members, members)
    assert lost < 10


@pytest.mark.parametrize(("cbar2", "factor"), [(4.0, 1.4), (0.5, 2.0)])
def test_truncation_and_factor_enter_as_in_the_formulas(cbar2, factor):
    for seed in range(5):
        data = random_tims(seed, 0.4)
        expected, members, _ = gnc_by_the_book(data, cbar2, factor, 100)
        found = estimate(*data[:3], cbar2=cbar2, factor=factor)
        np.testing.assert_allclose(found.rotation, expected, atol=1e-8)
        np.testing.assert_array_equal(found.members, members)


def test_truncation_is_a_unit_of_the_bounds():
    data = random_tims(1, 0.4)
    wide = estimate(data.src, data.dst, 2 * data.bounds)
    same = estimate(*data[:3], cbar2=4.0)
    np.testing.assert_allclose(wide.rotation, same.rotation, atol=1e-12)
    np.testing.assert_array_equal(wide.members, same.members)


@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_right_tims_are_found_and_the_rotation_with_them(wrong):
    for seed in range(10):
        data = random_tims(seed, wrong)
        found = estimate(*data[:3])
        assert bool(found.converged)
        assert so3.rotation_angle(np.asarray(found.rotation) @ data.truth.T) < 0.05
        assert np.mean(np.asarray(found.members)[data.right]) > 0.9
        assert not np.any(np.asarray(found.members)[~data.right])


def test_if_all_agree_the_first_fit_is_final():
    data = random_tims(0, 0.0, bound=0.02)
    found = estimate(data.src, data.dst, 3 * data.bounds, iterations=1)
    assert bool(found.converged)
    assert np.all(found.members)
    np.testing.assert_allclose(found.rotation, wahba(data.bounds**-2.0, data.src, data.dst), atol=1e-13)


def test_iteration_cap_is_reported():
    assert not bool(estimate(*random_tims(0, 0.5)[:3], iterations=2).converged)


def test_masked_tims_change_nothing():
    data = random_tims(2, 0.4)
    mask = np.arange(K) % 4 > 0
    spoiled = np.where(mask[:, None], data.dst, 1e9)
    found = estimate(data.src, spoiled, np.where(mask, data.bounds, 0.0), mask)
    few = estimate(data.src[mask], data.dst[mask], data.bounds[mask])
    np.testing.assert_allclose(found.rotation, few.rotation, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(found.members)[mask], few.members)
    assert not np.any(np.asarray(found.members)[~mask])


def test_no_tim_at_all_is_the_identity_and_finite():
    data = random_tims(2, 0.4)
    found = estimate(*data[:3], np.zeros(K, bool))
    np.testing.assert_allclose(found.rotation, np.eye(3), atol=1e-15)
    assert not np.any(found.members)


def test_turning_the_target_turns_the_answer():
    data, turn = random_tims(3, 0.4), random_rotation(np.random.default_rng(0))
    plain, turned = estimate(*data[:3]), estimate(data.src, data.dst @ turn.T, data.bounds)
    np.testing.assert_allclose(turned.rotation, turn @ plain.rotation, atol=1e-10)
    np.testing.assert_array_equal(turned.members, plain.members)


@pytest.mark.long
def test_float32_with_tolerances_of_its_own():
    with jax.enable_x64(False):
        for seed in range(5):
            data = random_tims(seed, 0.4)
            found = estimate(*(x.astype(np.float32) for x in data[:3]))
            assert found.rotation.dtype == jnp.float32
            expected, *_ = gnc_by_the_book(data, 1.0, 1.4, 100)
            np.testing.assert_allclose(found.rotation, expected, atol=1e-4)


# --- graphs of TIMs -------------------------------------------------------------------------------


def test_the_complete_graph_is_the_list_of_all_pairs():
    matches = random_matches(0, 33, wrong=0.3)
    mask = np.random.default_rng(0).uniform(size=33) < 0.8
    bounds = 0.05 * np.random.default_rng(1).uniform(1, 2, 33)
    pairs = np.array(list(combinations(range(33), 2)))
    i, j = pairs.T

    def both(rotation):
        weigh = lambda r2: 1 / (1 + r2)
        complete = complete_tims(*map(jnp.asarray, (matches.src, matches.dst, bounds, mask)))
        listed = listed_tims(
            *map(jnp.asarray, (matches.src[j] - matches.src[i], matches.dst[j] - matches.dst[i])),
            *map(jnp.asarray, (bounds[i] + bounds[j], mask[i] & mask[j])),
        )
        return [
            (t.measure(rotation, weigh), t.largest(rotation), t.members(rotation, weigh))
            for t in (complete, listed)
        ]

    (complete, complete_largest, rows), (listed, largest, members) = jax.jit(both)(matches.truth.rotation)
    # The complete graph meets every pair from both ends.
    np.testing.assert_allclose(complete.correlation, 2 * listed.correlation, rtol=1e-12)
    np.testing.assert_allclose(complete.cost, 2 * listed.cost, rtol=1e-12)
    np.testing.assert_allclose(complete_largest, largest, rtol=1e-12)
    assert complete.soft == 2 * listed.soft > 0
    dense = unpack(rows, 33)
    np.testing.assert_array_equal(dense, dense.T)
    np.testing.assert_array_equal(dense[i, j], members)
    assert not dense[~mask].any()


def test_correlation_of_packed_pairs_is_the_dense_sum():
    matches = random_matches(1, 33)
    rng = np.random.default_rng(2)
    chosen = np.triu(rng.uniform(size=(33, 33)) < 0.4, 1)
    chosen |= chosen.T
    bounds, confidence = rng.uniform(0.1, 0.2, 33), rng.uniform(0.1, 1, 33)
    found = jax.jit(correlation_of_pairs)(matches.src, matches.dst, bounds, confidence, pack(chosen))
    i, j = np.nonzero(chosen)
    weights = confidence[i] * confidence[j] / (bounds[i] + bounds[j]) ** 2
    a, b = matches.src[j] - matches.src[i], matches.dst[j] - matches.dst[i]
    np.testing.assert_allclose(found, np.einsum("k,ki,kj->ij", weights, b, a), rtol=1e-12)
    np.testing.assert_allclose(correlation(*map(jnp.asarray, (weights, a, b))), found, rtol=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("members", [[], [4], [1, 6], [0, 2, 3], [5, 6, 7], range(8)], ids=str)
def test_the_chain_is_a_closed_ring_in_the_users_order(members):
    clique = np.isin(np.arange(8), list(members))
    pairs = np.asarray(ring_pairs(jnp.asarray(clique)))
    np.testing.assert_array_equal(pairs[:, 0], np.arange(8))
    members = np.flatnonzero(clique)
    np.testing.assert_array_equal(pairs[members, 1], np.roll(members, -1))
    np.testing.assert_array_equal(pairs[~clique, 1], np.flatnonzero(~clique))
