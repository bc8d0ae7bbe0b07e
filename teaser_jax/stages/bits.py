"""Packed bit rows: n verdicts in n/32 words. Bit t of word j stands for column 32 j + t."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, Shaped, UInt32

from teaser_jax.stages.invariants import LANES, words


def pack(mask: Bool[Array, "*k n"]) -> UInt32[Array, "*k w"]:
    """A mask as words along the last axis; bits beyond n are zero."""
    *batch, n = mask.shape
    padded = jnp.pad(mask, [(0, 0)] * len(batch) + [(0, words(n) * LANES - n)])
    lanes = padded.reshape(*batch, words(n), LANES).astype(jnp.uint32)
    return jnp.sum(lanes << jnp.arange(LANES, dtype=jnp.uint32), axis=-1, dtype=jnp.uint32)


def unpack(packed: UInt32[Array, "*k w"], n: int) -> Bool[Array, "*k n"]:
    """Words as a mask of n bits along the last axis."""
    bits = (packed[..., None] >> jnp.arange(LANES, dtype=jnp.uint32)) & 1
    return bits.reshape(*packed.shape[:-1], -1)[..., :n].astype(bool)


def others(n: int) -> UInt32[Array, "n w"]:
    """Rows with every bit set but a row's own, and none beyond n."""
    index, word = jnp.arange(n, dtype=jnp.int32)[:, None], jnp.arange(words(n), dtype=jnp.int32)[None]
    own = jnp.uint32(1) << (index % LANES).astype(jnp.uint32)
    within = jnp.minimum(n - LANES * word, LANES)  # bits of this word that exist: 1 to 32
    existing = jnp.uint32(0xFFFFFFFF) >> (LANES - within).astype(jnp.uint32)
    return jnp.where(index // LANES == word, existing & ~own, existing)


def count(packed: UInt32[Array, "*k w"]) -> Int[Array, "*k"]:
    """Number of set bits along the last axis."""
    return jnp.sum(lax.population_count(packed), axis=-1, dtype=jnp.int32)


def rank(mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """How many are set up to and including each: a running sum in two small products.

    XLA would make log n passes of a cumulative sum on the CPU. Exact: counts stay below 2^24.
    """
    n = mask.shape[0]
    lanes = jnp.pad(mask, (0, words(n) * LANES - n)).reshape(words(n), LANES).astype(jnp.float32)
    high = lax.Precision.HIGHEST
    inside = jnp.matmul(lanes, np.triu(np.ones((LANES, LANES), np.float32)), precision=high)
    before = jnp.matmul(np.tri(words(n), k=-1, dtype=np.float32), inside[:, -1], precision=high)
    return (inside + before[:, None]).reshape(-1)[:n].astype(jnp.int32)


def listed(mask: Bool[Array, " n"]) -> Int[Array, " n"]:
    """The set positions in order, then zeros."""
    n = mask.shape[0]
    place = jnp.where(mask, rank(mask) - 1, n)
    return jnp.zeros(n, jnp.int32).at[place].set(jnp.arange(n, dtype=jnp.int32), mode="drop")


def first_smallest(x: Shaped[Array, " m"]) -> Int[Array, ""]:
    """``argmin`` from plain reductions.

    Inside a jit, programs are lowered after a caller's x64 block was left. What is lowered by way
    of other JAX functions (argmin, an iota of 64 bits) then mixes 32 and 64 bits; plain operations
    on values that are 64 bits wide already do not. Indices are int32 throughout for that reason.
    """
    index = jnp.arange(x.shape[0], dtype=jnp.int32)
    return jnp.min(jnp.where(x == jnp.min(x), index, x.shape[0] - 1))


def unpack_host(packed: np.ndarray, n: int) -> np.ndarray:
    """Words (k, w) as a boolean (k, n) array, in numpy, whatever the machine's byte order."""
    little = np.ascontiguousarray(packed).astype("<u4", copy=False)
    return np.unpackbits(little.view(np.uint8), axis=-1, bitorder="little", count=n).astype(bool)
