"""Invariant measurements against the incidence matrix (Theorem 4) and dense loops."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import networkx as nx
import numpy as np
import pytest
from oracles import random_matches, random_rotation

from teaser_jax.ground import arrays, bits
from teaser_jax.stages import pairs as pairs_room

pytestmark = pytest.mark.usefixtures("x64")

# One program each instead of one an operation.
tims, trims, tim_bounds = (jax.jit(f) for f in (pairs_room.tims, pairs_room.trims, pairs_room.tim_bounds))

SIZES = [1, 5, 31, 32, 33, 70]


def oriented_edges(graph: nx.Graph) -> np.ndarray:
    return np.array(list(graph.edges), int).reshape(-1, 2)


@pytest.mark.parametrize(
    "graph",
    [nx.complete_graph(12), nx.cycle_graph(12), nx.star_graph(11), nx.gnp_random_graph(12, 0.3, seed=1)],
    ids=["complete", "cycle", "star", "random"],
)
def test_tims_are_the_incidence_matrix_times_the_points(graph):
    points = np.random.default_rng(0).normal(size=(12, 3))
    incidence = nx.incidence_matrix(graph, nodelist=range(12), oriented=True).toarray().T
    expected = np.kron(incidence, np.eye(3)) @ points.ravel()
    found = tims(jnp.asarray(points), jnp.asarray(oriented_edges(graph)))
    np.testing.assert_allclose(np.ravel(found), expected, atol=1e-15)


def test_tim_bounds_add():
    bounds = np.array([0.1, 0.2, 0.4])
    np.testing.assert_allclose(tim_bounds(jnp.asarray(bounds), jnp.array([[0, 1], [2, 1]])), [0.3, 0.6])


def test_tims_forget_translation_and_trims_rotation_too():
    matches = random_matches(0, n=12, wrong=0)
    pairs = jnp.asarray(oriented_edges(nx.complete_graph(12)))
    bounds = jnp.ones(len(pairs))
    a = tims(jnp.asarray(matches.src), pairs)
    np.testing.assert_allclose(tims(jnp.asarray(matches.src + 7), pairs), a, atol=1e-14)
    turn = random_rotation(np.random.default_rng(1))
    turned, _ = trims(a, a @ turn.T * 1.7, bounds)
    np.testing.assert_allclose(turned, 1.7, atol=1e-14)


def test_trims_of_right_matches_lie_within_their_bounds():
    matches = random_matches(3, n=30, wrong=0, scale=1.6)
    pairs = jnp.asarray(oriented_edges(nx.complete_graph(30)))
    a, b = (tims(jnp.asarray(x), pairs) for x in (matches.src, matches.dst))
    delta = tim_bounds(jnp.full(30, matches.noise_bound), pairs)
    values, bounds = trims(a, b, delta)
    np.testing.assert_allclose(bounds, np.asarray(delta) / np.linalg.norm(a, axis=1))
    assert np.all(np.abs(np.asarray(values) - 1.6) <= np.asarray(bounds))
    assert np.any(np.abs(np.asarray(values) - 1.6) > 0.2 * np.asarray(bounds))


def test_zero_length_pairs_cannot_vote_and_have_no_gradient():
    a = jnp.array([[0.0, 0, 0], [3, 0, 4], [0, 0, 0], [0, 2, 0]])
    b = jnp.array([[1.0, 0, 0], [0, 5, 0], [0, 0, 0], [0, 0, 0]])
    delta = jnp.full(4, 0.1)
    values, bounds = trims(a, b, delta)
    np.testing.assert_allclose(values, [0, 1, 0, 0])
    np.testing.assert_allclose(bounds, [np.inf, 0.02, np.inf, 0.05])

    def total(a, b):
        values, bounds = trims(a, b, delta)
        return jnp.sum(values) + jnp.sum(jnp.where(jnp.isfinite(bounds), bounds, 0))

    da, db = jax.jit(jax.grad(total, argnums=(0, 1)))(a, b)
    assert np.all(np.isfinite(da))
    assert np.all(np.isfinite(db))
    assert np.all(np.asarray(da)[[0, 2]] == 0)
    assert np.all(np.asarray(db)[[0, 2, 3]] == 0)
    # d(|b| / |a|)/db = b / (|a| |b|), and with the bound d(|b| + 0.1)/|a| in the direction of a.
    np.testing.assert_allclose(db[1], [0, 0.2, 0], atol=1e-15)
    np.testing.assert_allclose(da[1], -(5 + 0.1) / 125 * np.array([3, 0, 4]), atol=1e-15)


def test_lengths_and_roots_are_flat_at_zero():
    root, norm = (jax.jit(jax.value_and_grad(f)) for f in (arrays.safe_sqrt, arrays.safe_norm))
    assert root(0.0) == (0, 0)
    assert root(4.0) == (2, 0.25)
    length, slope = norm(np.zeros(3))
    assert length == 0
    assert np.all(np.asarray(slope) == 0)
    np.testing.assert_allclose(norm(np.array([3.0, 0, 4]))[1], [0.6, 0, 0.8])


@pytest.mark.long
@pytest.mark.parametrize("n", SIZES)
def test_fold_meets_each_ordered_pair_of_usable_matches_once(n):
    rng = np.random.default_rng(n)
    src, dst, beta = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(1, 2, n)
    mask = rng.uniform(size=n) < 0.8

    def mark(met, lane, visited):
        columns = jnp.arange(bits.words(n), dtype=jnp.int32) * 32 + lane
        return met.at[:, columns].add(jnp.where(visited.valid, 1, 0), mode="drop")

    fold = jax.jit(lambda *match: pairs_room.fold_pairs(mark, jnp.zeros((n, n), int), *match))
    met = fold(src, dst, beta, mask)
    np.testing.assert_array_equal(met, mask[:, None] & mask & ~np.eye(n, dtype=bool))


@pytest.mark.parametrize("n", [5, 33])
def test_fold_hands_out_the_tims_and_bounds_of_the_dense_graph(n):
    rng = np.random.default_rng(n)
    src, dst, beta = rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(1, 2, n)

    def collect(dense, lane, visited):
        columns = jnp.arange(bits.words(n), dtype=jnp.int32) * 32 + lane
        layers = [*visited.src_tims, *visited.dst_tims, visited.bounds]
        return dense.at[:, :, columns].set(jnp.where(visited.valid, jnp.stack(layers), 0), mode="drop")

    fold = jax.jit(lambda *match: pairs_room.fold_pairs(collect, jnp.zeros((7, n, n)), *match))
    found = fold(src, dst, beta, np.ones(n, bool))
    off = ~np.eye(n, dtype=bool)
    for k in range(3):
        np.testing.assert_allclose(found[k], (src[:, None, k] - src[None, :, k]) * off)
        np.testing.assert_allclose(found[3 + k], (dst[:, None, k] - dst[None, :, k]) * off)
    np.testing.assert_allclose(found[6], (beta[:, None] + beta[None]) * off)


@pytest.mark.long
@pytest.mark.parametrize("n", [5, 33])
def test_gradient_through_the_fold_is_the_dense_one(n):
    rng = np.random.default_rng(n)
    inputs = tuple(
        jnp.asarray(x) for x in (rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.uniform(1, 2, n))
    )
    mask = jnp.asarray(rng.uniform(size=n) < 0.8)

    def term(a2, b2, delta):
        return jnp.sin(a2) * b2 / delta**2

    def folded(src, dst, beta):
        def add(total, _, visited):
            a2, b2 = pairs_room.squared_norm(visited.src_tims), pairs_room.squared_norm(visited.dst_tims)
            return total + jnp.sum(jnp.where(visited.valid, term(a2, b2, visited.bounds), 0))

        return pairs_room.fold_pairs(add, jnp.zeros(()), src, dst, beta, mask)

    def dense(src, dst, beta):
        square = lambda x: jnp.sum((x[:, None] - x[None]) ** 2, axis=-1)
        valid = mask[:, None] & mask[None] & ~jnp.eye(n, dtype=bool)
        return jnp.sum(jnp.where(valid, term(square(src), square(dst), beta[:, None] + beta[None]), 0))

    found, expected = (jax.jit(jax.value_and_grad(f, argnums=(0, 1, 2)))(*inputs) for f in (folded, dense))
    np.testing.assert_allclose(found[0], expected[0], rtol=1e-13)
    for slope, right in zip(found[1], expected[1], strict=True):
        np.testing.assert_allclose(slope, right, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("n", "expected"), [(0, 0), (1, 1), (32, 1), (33, 2), (64, 2)])
def test_words(n, expected):
    assert bits.words(n) == expected
