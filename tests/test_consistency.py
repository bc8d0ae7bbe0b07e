"""The consistency graph against exact arithmetic: no true edge is ever lost."""

from __future__ import annotations

from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import edges_in_integers, length_gaps, random_matches, random_rotation, unpack

from teaser_jax.stages.consistency import consistency_graph, lengths_agree, rounding_margin

N = 64
graph_of = jax.jit(
    lambda src, dst, bounds, mask, scale, cbar2, pairs=None: consistency_graph(
        src, dst, bounds, mask, scale=scale, cbar2=cbar2, pairs=pairs
    )
)


def edges(src, dst, bounds, *, mask=None, scale=1.0, cbar2=1.0, pairs=None, dtype=np.float64) -> np.ndarray:
    """The graph as a dense matrix, computed in ``dtype``, and its shape checked."""
    n = len(src)
    mask = np.ones(n, bool) if mask is None else mask
    with jax.enable_x64(dtype == np.float64):
        arrays = (np.asarray(x, dtype) for x in (src, dst, np.broadcast_to(bounds, n)))
        packed = graph_of(*arrays, mask, dtype(scale), dtype(cbar2), pairs)
    dense = unpack(packed, n)
    np.testing.assert_array_equal(dense, dense.T)
    assert not dense.diagonal().any()
    assert not dense[~mask].any()
    assert np.all(unpack(packed, 32 * packed.shape[1])[:, n:] == 0)
    return dense


def margin_of(src, dst, scale, dtype) -> float:
    with jax.enable_x64(dtype == np.float64):
        arrays = (jnp.asarray(x, dtype) for x in (src, dst))
        return float(rounding_margin(*arrays, jnp.ones(len(src), bool), jnp.asarray(scale, dtype)))


def check_against_exact(src, dst, bound, *, dtype=np.float64, scale=1.0, cbar2=1.0) -> None:
    """No edge of the exact graph is lost; extra ones lie within twice the stated margin."""
    found = edges(src, dst, bound, dtype=dtype, scale=scale, cbar2=cbar2)
    gap, bounds = length_gaps(src, dst, scale), np.asarray(np.broadcast_to(bound, len(src)), np.longdouble)
    limit = np.sqrt(np.longdouble(cbar2)) * (bounds[:, None] + bounds)
    off = ~np.eye(len(src), dtype=bool)
    lost = (gap <= limit) & off & ~found
    assert not lost.any(), f"{lost.sum() // 2} edges lost, the clearest by {(limit - gap)[lost].max():.1e}"
    extra = found & (gap > limit + 2 * margin_of(src, dst, scale, dtype))
    assert not extra.any(), f"{extra.sum() // 2} edges too many, by up to {(gap - limit)[extra].max():.1e}"


@pytest.mark.long
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("scale", [1.0, 0.3, 4.0])
@pytest.mark.parametrize("bound", [1e-4, 0.05, 1.0])
def test_random_matches(dtype, scale, bound):
    matches = random_matches(0, N, scale=scale, noise_bound=bound)
    check_against_exact(matches.src, matches.dst, bound, dtype=dtype, scale=scale)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_bounds_differ_and_cbar_widens(dtype):
    matches = random_matches(1, N)
    bounds = 10 ** np.random.default_rng(0).uniform(-4, 0, N)
    check_against_exact(matches.src, matches.dst, bounds.astype(dtype), dtype=dtype)
    check_against_exact(matches.src, matches.dst, bounds.astype(dtype), dtype=dtype, cbar2=4.0)
    wide = edges(matches.src, matches.dst, 2 * bounds)
    np.testing.assert_array_equal(edges(matches.src, matches.dst, bounds, cbar2=4.0), wide)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
@pytest.mark.parametrize("unit", [1.0, 0.1, 1 / 3])
@pytest.mark.parametrize("tolerance", [2, 4])
def test_gridded_data_full_of_ties(dtype, unit, tolerance):
    rng = np.random.default_rng(tolerance)
    src, dst = rng.integers(-6, 7, (2, N, 3))
    dst[:20] = src[:20] @ np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]]) + 3  # a quarter turn: right matches
    src[20:50, 1:] = dst[20:50, :2] = 0  # on lines all lengths are integers
    exact = edges_in_integers(src, dst, tolerance)
    gap = length_gaps(src, dst)
    assert np.sum(gap == tolerance) > 50  # ties there are
    found = edges(unit * src, unit * dst, unit * tolerance / 2, dtype=dtype)
    assert not np.any(exact & ~found)
    # Where lengths are integers, a missed limit is missed by far: no edge is added either.
    margin = 2 * margin_of(unit * src, unit * dst, 1.0, dtype) / unit
    np.testing.assert_array_equal(found & (gap > tolerance + margin), False)


@pytest.mark.parametrize("offset", [0.0, 10.0, 1000.0])
def test_float32_far_from_the_origin_loses_no_edge(offset):
    rng = np.random.default_rng(2)
    matches = random_matches(2, N, wrong=0.3, noise_bound=0.1)
    src, dst = matches.src + offset, matches.dst + rng.normal(size=3) * offset
    gap = length_gaps(src, dst)  # of what was measured, before it was rounded to float32
    found = edges(src, dst, 0.1, dtype=np.float32)
    off = ~np.eye(N, dtype=bool)
    assert not np.any((gap <= 0.2) & off & ~found)
    assert not np.any(found & (gap > 0.2 + 2 * margin_of(src, dst, 1.0, np.float32)))


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_nearly_coincident_source_points_at_the_limit(dtype):
    # |a| tiny, |b| = d + |a|: the form without square roots loses all its digits there.
    rng = np.random.default_rng(3)
    for gap in 10.0 ** np.arange(-9 if dtype == np.float64 else -6, -2):
        src, dst = rng.uniform(-1, 1, (2, N, 3))
        for points, length in (
            (src, gap),
            (dst, (0.1 + gap) * (1 - 10 ** rng.uniform(-15, -6, (N // 2, 1)))),
        ):
            direction = rng.normal(size=(N // 2, 3))
            points[1::2] = points[::2] + length * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        src, dst = src.astype(dtype), dst.astype(dtype)
        check_against_exact(src, dst, dtype(0.05), dtype=dtype)
        check_against_exact(dst, src, dtype(0.05), dtype=dtype)


def test_coincident_points_follow_the_same_rule():
    src = np.zeros((N, 3))
    dst = np.random.default_rng(4).uniform(-0.1, 0.1, (N, 3))
    check_against_exact(src, dst, 0.05)
    check_against_exact(dst, src, 0.05)
    assert edges(src, src, 0.05).sum() == N * (N - 1)


def test_lengths_agree_is_the_rule_with_square_roots():
    rng = np.random.default_rng(5)
    a, b = 10 ** rng.uniform(-3, 1, (2, 4000))
    b[::2] = a[::2] * rng.uniform(0.8, 1.2, 2000)
    limit = 10 ** rng.uniform(-3, 1, 4000)
    clear = np.abs(np.abs(a - b) - limit) > 1e-9
    with jax.enable_x64(True):
        found = np.asarray(lengths_agree(jnp.asarray(a**2), jnp.asarray(b**2), jnp.asarray(limit)))
    np.testing.assert_array_equal(found[clear], (np.abs(a - b) <= limit)[clear])
    assert 0.1 < found.mean() < 0.9


def test_right_matches_form_a_clique():
    # Theorem 6.
    for seed in range(5):
        matches = random_matches(seed, N, scale=1.5)
        inside = edges(matches.src, matches.dst, matches.noise_bound, scale=1.5)[
            np.ix_(matches.inliers, matches.inliers)
        ]
        assert np.all(inside | np.eye(len(inside), dtype=bool))


def test_rigid_motion_and_order_change_nothing():
    matches = random_matches(6, N)
    plain = edges(matches.src, matches.dst, 0.05)
    turned = edges(matches.src @ random_rotation(np.random.default_rng(0)).T + 2, matches.dst - 5, 0.05)
    np.testing.assert_array_equal(turned, plain)
    order = np.random.default_rng(1).permutation(N)
    np.testing.assert_array_equal(
        edges(matches.src[order], matches.dst[order], 0.05), plain[np.ix_(order, order)]
    )


def test_masked_rows_are_isolated_and_change_nothing():
    matches = random_matches(7, N)
    mask = np.random.default_rng(0).uniform(size=N) < 0.7
    plain = edges(matches.src, matches.dst, 0.05)
    src = np.where(mask[:, None], matches.src, 1e6)  # must not widen the margin
    masked = edges(src, matches.dst, 0.05, mask=mask)
    np.testing.assert_array_equal(masked, plain & mask[:, None] & mask)


# --- given pairs ----------------------------------------------------------------------------------


def test_pairs_not_tested_count_as_consistent():
    matches = random_matches(8, N)
    complete = edges(matches.src, matches.dst, 0.05)
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, N, (300, 2))  # in both orders, with repeats and loops
    tested = np.zeros((N, N), bool)
    tested[pairs[:, 0], pairs[:, 1]] = tested[pairs[:, 1], pairs[:, 0]] = True
    found = edges(matches.src, matches.dst, 0.05, pairs=pairs)
    np.testing.assert_array_equal(found, np.where(tested, complete, ~np.eye(N, dtype=bool)))
    assert (tested & ~found).sum() > 100


def test_repeats_and_direction_of_pairs_do_not_matter():
    matches = random_matches(9, N)
    pairs = np.random.default_rng(1).integers(0, N, (150, 2))
    once = edges(matches.src, matches.dst, 0.05, pairs=np.concatenate([pairs, pairs]))
    np.testing.assert_array_equal(
        edges(matches.src, matches.dst, 0.05, pairs=np.concatenate([pairs[:, ::-1], pairs])), once
    )


def test_all_pairs_given_are_the_complete_graph():
    matches = random_matches(10, N)
    pairs = np.array(list(combinations(range(N), 2)))
    mask = np.random.default_rng(2).uniform(size=N) < 0.9
    np.testing.assert_array_equal(
        edges(matches.src, matches.dst, 0.05, pairs=pairs, mask=mask),
        edges(matches.src, matches.dst, 0.05, mask=mask),
    )
