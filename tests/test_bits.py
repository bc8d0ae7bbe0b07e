"""Packed bit rows against the plain mask."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from teaser_jax.ground import bits

# One program each instead of one an operation.
pack, count, rank, listed = (jax.jit(f) for f in (bits.pack, bits.count, bits.rank, bits.listed))
unpack, others = jax.jit(bits.unpack, static_argnames="n"), jax.jit(bits.others, static_argnames="n")

SIZES = [0, 1, 31, 32, 33, 64, 100]


def mask_of(n: int, rows: int = 5) -> np.ndarray:
    return np.random.default_rng(n).uniform(size=(rows, n)) < 0.5


@pytest.mark.parametrize("n", SIZES)
def test_packing_is_the_plain_sum_of_powers(n):
    packed = pack(mask_of(n))
    assert packed.dtype == jnp.uint32
    np.testing.assert_array_equal(packed, oracles.pack(mask_of(n)))


@pytest.mark.long
@pytest.mark.parametrize("n", SIZES)
def test_unpacking_undoes_packing(n):
    mask = mask_of(n)
    np.testing.assert_array_equal(unpack(pack(mask), n), mask)
    np.testing.assert_array_equal(bits.unpack_host(oracles.pack(mask), n), mask)
    np.testing.assert_array_equal(unpack(pack(mask[0]), n), mask[0])


@pytest.mark.parametrize("n", SIZES)
def test_counting_counts(n):
    np.testing.assert_array_equal(count(pack(mask_of(n))), mask_of(n).sum(axis=1))


def test_bit_t_of_word_j_is_column_32_j_plus_t():
    expected = np.zeros((40, 2), np.uint32)
    for column in range(40):
        expected[column, column // 32] = 1 << (column % 32)
    np.testing.assert_array_equal(pack(np.eye(40, dtype=bool)), expected)


def test_leading_axes_are_a_batch():
    mask = mask_of(40, rows=6).reshape(2, 3, 40)
    packed = pack(mask)
    assert packed.shape == (2, 3, 2)
    np.testing.assert_array_equal(unpack(packed, 40), mask)
    np.testing.assert_array_equal(count(packed), mask.sum(axis=-1))


@pytest.mark.parametrize("n", [1, 5, 32, 33, 64, 100])
def test_others_are_all_but_oneself(n):
    found = others(n)
    assert found.dtype == jnp.uint32
    every = np.asarray(unpack(found, 32 * found.shape[1]))
    np.testing.assert_array_equal(every[:, :n], ~np.eye(n, dtype=bool))
    assert not every[:, n:].any()


@pytest.mark.long
@pytest.mark.parametrize("n", [1, 5, 32, 33, 100, 3000])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_rank_and_list(n, share):
    mask = np.random.default_rng(n).uniform(size=n) < share
    np.testing.assert_array_equal(rank(mask), np.cumsum(mask))
    places = np.asarray(listed(mask))
    np.testing.assert_array_equal(places[: mask.sum()], np.flatnonzero(mask))
    assert not places[mask.sum() :].any()
