"""The scale vote over pairs of matches, against enumeration on the dense list of TRIMs."""

from __future__ import annotations

from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import Matches, largest_consensus, random_matches, tls_by_enumeration, tls_cost, unpack

from teaser_jax.stages.scale import estimate_scale, scale_of_pairs

pytestmark = pytest.mark.usefixtures("x64")


EVERY = (0.0, np.inf)


@partial(jax.jit, static_argnames="criterion")
def estimate(src, dst, noise_bound, mask, cbar2=1.0, pairs=None, scale_range=EVERY, criterion="tls"):
    cbar2 = jnp.asarray(cbar2, src.dtype)
    return estimate_scale(
        src, dst, noise_bound, mask, cbar2=cbar2, pairs=pairs, scale_range=scale_range, criterion=criterion
    )


read_out = jax.jit(scale_of_pairs)


def inputs(matches: Matches, seed: int = 0):
    n = len(matches.src)
    bounds = matches.noise_bound * np.random.default_rng(seed).uniform(1, 3, n)
    return matches.src, matches.dst, bounds, np.ones(n, bool)


def all_pairs(n: int) -> np.ndarray:
    return np.array(list(combinations(range(n), 2)))


def trims_of(src, dst, bounds, pairs):
    """The plain formula of eq. (TRIM)."""
    i, j = np.asarray(pairs).T
    a, b = np.linalg.norm(src[j] - src[i], axis=1), np.linalg.norm(dst[j] - dst[i], axis=1)
    return b / a, (bounds[i] + bounds[j]) / a


@pytest.mark.long
@pytest.mark.parametrize("n", [11, 12])
@pytest.mark.parametrize("wrong", [0.0, 0.5])
def test_every_unordered_pair_votes_once(n, wrong):
    for seed in range(5):
        src, dst, bounds, mask = inputs(random_matches(seed, n, wrong=wrong, scale=1.7))
        values, alpha = trims_of(src, dst, bounds, all_pairs(n))
        scale, chosen = estimate(src, dst, bounds, mask)
        best = tls_by_enumeration(values, alpha, 1.0)
        assert tls_cost(float(scale), values, alpha, 1.0) == pytest.approx(best, rel=1e-9)
        dense = unpack(chosen, n)
        np.testing.assert_array_equal(dense, dense.T)
        i, j = all_pairs(n).T
        np.testing.assert_array_equal(dense[i, j], np.abs(values - float(scale)) <= alpha)
        assert not dense.diagonal().any()


def test_consensus_takes_the_most_pairs():
    n = 12
    src, dst, bounds, mask = inputs(random_matches(3, n, wrong=0.4, scale=1.7))
    values, alpha = trims_of(src, dst, bounds, all_pairs(n))
    _, chosen = estimate(src, dst, bounds, mask, criterion="consensus")
    assert unpack(chosen, n).sum() == 2 * largest_consensus(values, alpha, 1.0)


def test_the_true_scale_lies_within_the_bounds_of_the_estimate():
    for seed in range(5):
        matches = random_matches(seed, 12, wrong=0.25, scale=2.5)
        assert abs(float(estimate(*inputs(matches))[0]) - 2.5) < 0.1


def test_all_pairs_given_are_the_complete_graph():
    n = 12
    data = inputs(random_matches(1, n, scale=1.4))
    complete, bits = estimate(*data)
    for pairs in (all_pairs(n), all_pairs(n)[:, ::-1]):
        given, members = estimate(*data, pairs=pairs)
        assert float(given) == pytest.approx(float(complete), rel=1e-13)
        np.testing.assert_array_equal(members, unpack(bits, n)[pairs[:, 0], pairs[:, 1]])


def test_pairs_repeated_all_alike_change_nothing_and_loops_do_not_vote():
    n = 12
    data = inputs(random_matches(1, n, scale=1.4))
    pairs = all_pairs(n)
    once, members = estimate(*data, pairs=pairs)
    twice, both = estimate(*data, pairs=np.concatenate([pairs, pairs[:, ::-1]]))
    assert float(twice) == pytest.approx(float(once), rel=1e-13)
    np.testing.assert_array_equal(both, np.tile(members, 2))
    loops = np.stack([np.arange(len(pairs)) % n] * 2, axis=1)
    looped, some = estimate(*data, pairs=np.concatenate([pairs, loops]))
    assert float(looped) == pytest.approx(float(once), rel=1e-13)
    assert not np.any(some[len(pairs) :])


def test_masked_rows_do_not_vote():
    src, dst, bounds, _ = inputs(random_matches(2, 12, scale=1.4))
    keep = np.arange(12) != 7
    dst[7] = 1e3
    fewer, few_bits = estimate(src[keep], dst[keep], bounds[keep], np.ones(11, bool))
    masked, bits = estimate(src, dst, bounds, keep)
    assert float(masked) == pytest.approx(float(fewer), rel=1e-13)
    dense = unpack(bits, 12)
    np.testing.assert_array_equal(dense[np.ix_(keep, keep)], unpack(few_bits, 11))
    assert not dense[7].any()
    assert not dense[:, 7].any()


def test_scale_range_limits_the_search():
    data = inputs(random_matches(4, 12, wrong=0, scale=2.0))
    assert abs(float(estimate(*data)[0]) - 2) < 0.1
    low, _ = estimate(*data, scale_range=(0.5, 1.5))
    assert low == 0 or 0.5 <= low <= 1.5
    assert float(estimate(*data, scale_range=(1.5, 2.5))[0]) == pytest.approx(float(estimate(*data)[0]))


@pytest.mark.parametrize("n", [11, 12])
def test_coincident_points_leave_the_others_their_vote(n):
    src, dst, bounds, mask = inputs(random_matches(5, n, wrong=0, scale=1.5))
    src[4] = src[3]
    scale, chosen = estimate(src, dst, bounds, mask)
    assert abs(float(scale) - 1.5) < 0.1
    assert not unpack(chosen, n)[3, 4]


def test_nothing_to_vote_with_is_zero():
    src, dst, bounds, mask = inputs(random_matches(5, 12))
    for args in ((np.ones_like(src), dst, bounds, mask), (src, dst, bounds, mask & False)):
        scale, chosen = estimate(*args)
        assert scale == 0
        assert not np.any(chosen)


def test_larger_clouds_and_bounds_scale_the_answer():
    src, dst, bounds, mask = inputs(random_matches(6, 12, wrong=0.25, scale=1.2))
    scale, chosen = estimate(src, dst, bounds, mask)
    for factor in (1e-3, 1e3):
        larger, same = estimate(src, factor * dst, factor * bounds, mask)
        assert float(larger) == pytest.approx(factor * float(scale), rel=1e-12)
        np.testing.assert_array_equal(same, chosen)


# --- the smooth read-out --------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("given", [False, True])
def test_read_out_is_the_weighted_mean_of_the_chosen(given):
    n = 12
    src, dst, bounds, mask = inputs(random_matches(7, n, wrong=0.3, scale=1.3))
    pairs = all_pairs(n)
    scale, chosen = estimate(src, dst, bounds, mask, pairs=pairs if given else None)
    ones = np.ones(n)
    read = read_out(src, dst, bounds, ones, chosen, pairs=pairs if given else None)
    assert float(read) == pytest.approx(float(scale), rel=1e-12)
    confidence = np.random.default_rng(0).uniform(0.1, 1, n)
    values, alpha = trims_of(src, dst, bounds, pairs)
    members = np.abs(values - float(scale)) <= alpha
    weight = confidence[pairs[:, 0]] * confidence[pairs[:, 1]] * members / alpha**2
    read = scale_of_pairs(
        *map(jnp.asarray, (src, dst, bounds, confidence)), chosen, pairs=jnp.asarray(pairs) if given else None
    )
    assert float(read) == pytest.approx(np.sum(weight * values) / np.sum(weight), rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("given", [False, True])
def test_gradient_of_the_read_out_is_the_central_difference(given):
    n = 12
    src, dst, bounds, mask = inputs(random_matches(8, n, wrong=0.3, scale=1.3))
    pairs = jnp.asarray(all_pairs(n)) if given else None
    _, chosen = estimate(src, dst, bounds, mask, pairs=pairs)
    read = jax.jit(lambda *x: scale_of_pairs(*x, chosen, pairs=pairs))
    point = tuple(map(jnp.asarray, (src, dst, bounds, np.full(n, 0.7))))
    rng = np.random.default_rng(1)
    direction = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in point)
    step = lambda sign: read(*(x + sign * 1e-6 * d for x, d in zip(point, direction, strict=True)))
    gradient = jax.jit(jax.grad(read, argnums=(0, 1, 2, 3)))(*point)
    slope = sum(float(jnp.sum(g * d)) for g, d in zip(gradient, direction, strict=True))
    assert slope == pytest.approx(float(step(1) - step(-1)) / 2e-6, abs=1e-7)


@pytest.mark.long
def test_no_choice_reads_as_zero_with_finite_gradient():
    src, dst, bounds, _ = map(jnp.asarray, inputs(random_matches(8, 12)))
    nothing = jnp.zeros((12, 1), jnp.uint32)
    value, slope = jax.value_and_grad(lambda s: scale_of_pairs(s, dst, bounds, jnp.ones(12), nothing))(src)
    assert value == 0
    assert np.all(np.asarray(slope) == 0)


# --- float32 ------------------------------------------------------------------------------------


def test_float32_points_vote_in_float64():
    data = [
        x.astype(np.float32) if x.dtype.kind == "f" else x for x in inputs(random_matches(9, 12, scale=1.8))
    ]
    wide, _ = estimate(*(x.astype(float) if x.dtype.kind == "f" else x for x in data))
    with jax.enable_x64(False):
        narrow, _ = estimate(*data)
        assert narrow.dtype == jnp.float32
        assert not jax.config.jax_enable_x64
    assert float(narrow) == pytest.approx(float(wide), rel=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("jitter", [0.0, 1e-3])
@pytest.mark.parametrize("hub", [20, 60])
def test_many_to_one_matches_do_not_vote_the_scale_to_zero(jitter, hub):
    rng = np.random.default_rng(0)
    src = rng.normal(size=(20 + hub, 3))
    dst = 1.7 * src
    dst[20:] = dst[0] + jitter * rng.normal(size=(hub, 3))
    scale, chosen = estimate(src, dst, np.full(20 + hub, 0.01), np.ones(20 + hub, bool))
    assert float(scale) == pytest.approx(1.7, rel=1e-2)
    assert not unpack(chosen, 20 + hub)[20:, 20:].any()
