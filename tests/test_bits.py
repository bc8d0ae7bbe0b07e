"""Packed bit rows against the plain mask."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import oracles
import pytest

from teaser_jax.ground import bits

SIZES = [0, 1, 31, 32, 33, 64, 100]


def mask_of(n: int, rows: int = 5) -> np.ndarray:
    return np.random.default_rng(n).uniform(size=(rows, n)) < 0.5


@pytest.mark.parametrize("n", SIZES)
def test_packing_is_the_plain_sum_of_powers(n):
    packed = bits.pack(jnp.asarray(mask_of(n)))
    assert packed.dtype == jnp.uint32
    np.testing.assert_array_equal(packed, oracles.pack(mask_of(n)))


@pytest.mark.parametrize("n", SIZES)
def test_unpacking_undoes_packing(n):
    mask = mask_of(n)
    np.testing.assert_array_equal(bits.unpack(bits.pack(jnp.asarray(mask)), n), mask)
    np.testing.assert_array_equal(bits.unpack_host(oracles.pack(mask), n), mask)
    np.testing.assert_array_equal(bits.unpack(bits.pack(jnp.asarray(mask[0])), n), mask[0])


@pytest.mark.parametrize("n", SIZES)
def test_counting_counts(n):
    np.testing.assert_array_equal(bits.count(bits.pack(jnp.asarray(mask_of(n)))), mask_of(n).sum(axis=1))


def test_bit_t_of_word_j_is_column_32_j_plus_t():
    expected = np.zeros((40, 2), np.uint32)
    for column in range(40):
        expected[column, column // 32] = 1 << (column % 32)
    np.testing.assert_array_equal(bits.pack(jnp.eye(40, dtype=bool)), expected)


def test_leading_axes_are_a_batch():
    mask = mask_of(40, rows=6).reshape(2, 3, 40)
    packed = bits.pack(jnp.asarray(mask))
    assert packed.shape == (2, 3, 2)
    np.testing.assert_array_equal(bits.unpack(packed, 40), mask)
    np.testing.assert_array_equal(bits.count(packed), mask.sum(axis=-1))


@pytest.mark.parametrize("n", [1, 5, 32, 33, 64, 100])
def test_others_are_all_but_oneself(n):
    found = bits.others(n)
    assert found.dtype == jnp.uint32
    np.testing.assert_array_equal(bits.unpack(found, 32 * found.shape[1])[:, :n], ~np.eye(n, dtype=bool))
    assert not bits.unpack(found, 32 * found.shape[1])[:, n:].any()


@pytest.mark.parametrize("n", [1, 5, 32, 33, 100, 3000])
@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_rank_and_list(n, share):
    mask = np.random.default_rng(n).uniform(size=n) < share
    np.testing.assert_array_equal(bits.rank(jnp.asarray(mask)), np.cumsum(mask))
    listed = np.asarray(bits.listed(jnp.asarray(mask)))
    np.testing.assert_array_equal(listed[: mask.sum()], np.flatnonzero(mask))
    assert not listed[mask.sum() :].any()
