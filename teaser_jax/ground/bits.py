"""Packed bit rows: n verdicts in n/32 words. Bit t of word j stands for column 32 j + t.

A *lane* is all columns with the same t: one in 32, with a word's distance between them. Pairs of matches are
visited lane by lane (``stages/pairs.py``), so that the verdicts of a visit are one bit of every word.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, Shaped, UInt32

LANES = 32


def words(n: int) -> int:
    """Count the 32-bit words that hold n bits."""
    return -(-n // LANES)


def pack(mask: Bool[Array, "*k n"]) -> UInt32[Array, "*k w"]:
    """Pack a mask into words along the last axis; bits beyond n are zero."""
    *batch, n = mask.shape
    padded = jnp.pad(mask, [(0, 0)] * len(batch) + [(0, words(n) * LANES - n)])
    lanes = padded.reshape(*batch, words(n), LANES).astype(jnp.uint32)
    return jnp.sum(lanes << _each_lane(lanes.ndim), axis=-1, dtype=jnp.uint32)


def unpack(packed: UInt32[Array, "*k w"], n: int) -> Bool[Array, "*k n"]:
    """Unpack words into a mask of n bits along the last axis."""
    bits = (packed[..., None] >> _each_lane(packed.ndim + 1)) & 1
    return bits.reshape(*packed.shape[:-1], -1)[..., :n].astype(bool)


def _each_lane(ndim: int) -> UInt32[Array, "*ones 32"]:
    """Number the lanes, along the last of so many axes."""
    return lax.broadcast_to_rank(jnp.arange(LANES, dtype=jnp.uint32), ndim)


def no_bits(n: int) -> UInt32[Array, "n w"]:
    """Make n rows of n bits with none set."""
    return jnp.zeros((n, words(n)), jnp.uint32)


def with_lane(
    packed: UInt32[Array, "n w"], lane: Int[Array, ""], verdicts: Bool[Array, "n w"]
) -> UInt32[Array, "n w"]:
    """Set one lane of the rows where the verdicts are true; the lane must have been clear."""
    return packed | (verdicts.astype(jnp.uint32) << lane.astype(jnp.uint32))


def lane_of(packed: UInt32[Array, "n w"], lane: Int[Array, ""]) -> Bool[Array, "n w"]:
    """Read the verdicts of one lane."""
    return ((packed >> lane.astype(jnp.uint32)) & 1).astype(bool)


def in_lanes(values: Shaped[Array, " n"]) -> Shaped[Array, "32 w"]:
    """Arrange the values of the columns as a row for each lane; what fills the last word is zero."""
    (n,) = values.shape
    return jnp.pad(values, (0, words(n) * LANES - n)).reshape(words(n), LANES).T


def others(n: int) -> UInt32[Array, "n w"]:
    """Make n rows with every bit set but the row's own, and none beyond n."""
    index, word = jnp.arange(n, dtype=jnp.int32)[:, None], jnp.arange(words(n), dtype=jnp.int32)[None]
    own = jnp.uint32(1) << (index % LANES).astype(jnp.uint32)
    within = jnp.minimum(n - LANES * word, LANES)  # bits of this word that exist: 1 to 32
    existing = jnp.uint32(0xFFFFFFFF) >> (LANES - within).astype(jnp.uint32)
    return jnp.where(index // LANES == word, existing & ~own, existing)


def count(packed: UInt32[Array, "*k w"]) -> Int[Array, "*k"]:
    """Count the bits that are set along the last axis."""
    return jnp.sum(lax.population_count(packed), axis=-1, dtype=jnp.int32)


def rank(mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """Count the bits set up to and including each: a running sum in two small products.

    XLA would make log n passes of a cumulative sum on the CPU. Exact: counts stay below 2^24.
    """
    n = mask.shape[0]
    lanes = jnp.pad(mask, (0, words(n) * LANES - n)).reshape(words(n), LANES).astype(jnp.float32)
    high = lax.Precision.HIGHEST
    inside = jnp.matmul(lanes, np.triu(np.ones((LANES, LANES), np.float32)), precision=high)
    before = jnp.matmul(np.tri(words(n), k=-1, dtype=np.float32), inside[:, -1], precision=high)
    return (inside + before[:, None]).reshape(-1)[:n].astype(jnp.int32)


def listed(mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """List the set positions in order, then zeros."""
    n = mask.shape[0]
    place = jnp.where(mask, rank(mask) - 1, n)
    return jnp.zeros(n, jnp.int32).at[place].set(jnp.arange(n, dtype=jnp.int32), mode="drop")


def first_smallest(x: Shaped[Array, " m"]) -> Int[Array, ""]:
    """Find the index of the first smallest entry: ``argmin`` from plain reductions.

    Inside a jit, programs are lowered after a caller's x64 block was left. What is lowered by way
    of other JAX functions (argmin, an iota of 64 bits) then mixes 32 and 64 bits; plain operations
    on values that are 64 bits wide already do not. Indices are int32 throughout for that reason.
    """
    index = jnp.arange(x.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(x == jnp.min(x), index, x.shape[0] - 1))


def unpack_host(packed: UInt32[np.ndarray, "*k w"], n: int) -> Bool[np.ndarray, "*k n"]:
    """Unpack words into a mask of n bits, in numpy, whatever the machine's byte order."""
    little = np.ascontiguousarray(packed).astype("<u4", copy=False)
    return np.unpackbits(little.view(np.uint8), axis=-1, bitorder="little", count=n).astype(bool)
