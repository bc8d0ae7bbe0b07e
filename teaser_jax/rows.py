"""The rows of a problem in an order of their own, copies merged, so that nothing depends on how they came.

Cliques of equal size, chains of TIMs and the last bit of a sum depend on the order of the matches. So rows
are solved in the order of a combination of their coordinates, shuffled. Whoever permutes them gets the same
sets, and who moves a point a little the same order, so that derivatives mean something. Rows that are exact
copies of one another meet there: one of them is solved, and all share its fate. A row listed two hundred
times is one match.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32, UInt64

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, Placeholder, namespace
from teaser_jax.ground.branches import if_any
from teaser_jax.problem import Problem

# Odd numbers, one for each coordinate of a match and one for their sum, that mix bits.
MIX_EACH = np.array([0x9E3779B1, 0x85EBCA6B, 0xC2B2AE35, 0x27D4EB2F, 0x165667B1, 0x7FEB352D], np.uint32)
MIX_SUM = np.uint32(0x846CA68B)
# A direction of the six coordinates of a match in which hardly any two matches are level.
DIRECTION = np.array([0.6180339887, 1.0, 0.3247179572, -0.7548776662, 0.4142135624, -0.8191725134])


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rows:
    """Where the rows of a problem are solved.

    Attributes:
        order: The row at each place; rows that can be used come first.
        place: The place of each row; of a copy, that of the row that stands for it.
    """

    order: Int[AnyArray, "... n"] | Placeholder
    place: Int[AnyArray, "... n"] | Placeholder

    @property
    def alone(self) -> Bool[AnyArray, "... n"]:
        """Which rows stand for themselves: all but copies."""
        xp = namespace(self.order)
        own = xp.broadcast_to(xp.arange(self.order.shape[-1], dtype=np.int32), self.order.shape)
        return xp.take_along_axis(self.order, self.place, axis=-1) == own


def arrange(problem: Problem) -> Rows:
    """Arrange the rows of a clean problem; works under jit. Gradients: none, an order is a choice."""
    p = lax.stop_gradient(problem)
    n = p.mask.shape[0]
    index, points = jnp.arange(n, dtype=jnp.int32), jnp.concatenate([p.src.T, p.dst.T])
    with jax.enable_x64(True):  # one number to sort by, row and all, is four times as fast as two
        width = np.uint64(max(1, (n - 1).bit_length()))
        key = jnp.where(p.mask, _ordered(points), _LAST) >> width
        both = lax.sort((key << width) | index.astype(jnp.uint64))
        key, order = both >> width, (both & ((np.uint64(1) << width) - np.uint64(1))).astype(jnp.int32)
        usable = key != _LAST >> width
    alike = jnp.pad((key[1:] == key[:-1]) & usable[1:], (1, 0))
    return _arranged(order, usable, alike, points, p.confidence, p.noise_bound)


def _without_copies(order: Array, usable: Array, *_: Array) -> Rows:
    """Shuffle rows of which no two can be copies: nearly always."""
    index = jnp.arange(order.shape[0], dtype=jnp.int32)
    mixed = order[_shuffled(index, jnp.sum(usable, dtype=jnp.int32))]
    return Rows(mixed, jnp.zeros_like(index).at[mixed].set(index))


def _with_copies(
    order: Array, usable: Array, alike: Array, points: Array, confidence: Array, noise_bound: Array
) -> Rows:
    """Shuffle rows of which some may be copies; these go to the end, where nobody will look at them."""
    n = order.shape[0]
    index = jnp.arange(n, dtype=jnp.int32)
    here = points[:, order]
    copy = alike & jnp.pad(jnp.all(here[:, 1:] == here[:, :-1], axis=0), (1, 0))
    leads = usable & ~copy
    count = jnp.sum(leads, dtype=jnp.int32)
    shuffled = _shuffled(index, count)
    back = jnp.zeros_like(index).at[shuffled].set(index)
    place = jnp.zeros_like(index).at[order].set(jnp.where(usable, back[bits.rank(leads) - 1], index))
    # Of copies the most confident one stands for all, and of those one with the smallest bound.
    best = jnp.zeros_like(confidence).at[place].max(confidence)
    doubt = jnp.where(confidence == best[place], noise_bound, jnp.inf)
    least = jnp.full_like(doubt, jnp.inf).at[place].min(doubt)
    winner = jnp.full(n, n - 1, jnp.int32).at[place].min(jnp.where(doubt == least[place], index, n - 1))
    last = jnp.where(copy, count + bits.rank(copy) - 1, index)
    rest = order.at[jnp.where(leads, n, last)].set(order, mode="drop")
    return Rows(jnp.where(index < count, winner, rest), place)


def _may_have_copies(order: Array, usable: Array, alike: Array, *_: Array) -> Bool[Array, ""]:
    return jnp.any(alike)


_arranged = if_any(_may_have_copies, _with_copies, _without_copies)


def _shuffled(index: Int[Array, " n"], count: Int[Array, ""]) -> Int[Array, " n"]:
    """Shuffle the first ``count`` places in strides of a quarter to a half of them.

    Neighbours in one direction make short TIMs, which say little of the rotation. A power of two shares no
    factor with an odd number, so each place is met once.
    """
    with jax.enable_x64(True):
        wide = index.astype(jnp.uint32 if len(index) <= 1 << 15 else jnp.uint64)
        odd = jnp.maximum(count - (count + 1) % 2, 1)
        stride = jnp.left_shift(1, jnp.maximum(30 - lax.clz(odd), 0))
        shuffled = (wide * stride.astype(wide.dtype)) % odd.astype(wide.dtype)
        return jnp.where(index < odd, shuffled.astype(jnp.int32), index)


_LAST = np.uint64(0xFFFFFFFFFFFFFFFF)  # the key of rows that cannot be used


def _ordered(points: Float[Array, "6 n"]) -> UInt64[Array, " n"]:
    """Compute a number for each match that is the larger the further it lies in the direction."""
    along = sum(step * x.astype(jnp.float64) for step, x in zip(DIRECTION, points, strict=True))
    along = jnp.where(along == 0, 0.0, jnp.where(jnp.isnan(along), jnp.inf, along))  # of two zeros one
    word, sign = lax.bitcast_convert_type(along, jnp.uint64), np.uint64(1) << np.uint64(63)
    return jnp.where(word >= sign, ~word, word | sign)


def keys(points: Float[Array, "k n"]) -> UInt32[Array, " n"]:
    """Compute a number of 31 bits for each point or match, from its coordinates as float32 knows them."""
    narrow = points.astype(jnp.float32)
    # Of the two zeros one; XLA would leave a sum with zero out.
    words = lax.bitcast_convert_type(jnp.where(narrow == 0, jnp.zeros_like(narrow), narrow), jnp.uint32)
    words = (words ^ (words >> 16)) * MIX_EACH[: len(words), None]
    found = jnp.sum(words ^ (words >> 13), axis=0, dtype=jnp.uint32)
    found = (found ^ (found >> 16)) * MIX_SUM
    return (found ^ (found >> 15)) >> 1


def in_rows(problem: Problem, rows: Rows) -> Problem:
    """Put a problem into its rows: copies are masked, and pairs name the rows that stand for them.

    Gradients: exact; what a copy would get goes to the row that stands for it.
    """
    order, place = rows.order, rows.place
    alone = place[order] == jnp.arange(order.shape[0], dtype=order.dtype)
    return replace(
        problem,
        src=problem.src[order],
        dst=problem.dst[order],
        noise_bound=problem.noise_bound[order],
        mask=problem.mask[order] & alone,
        confidence=problem.confidence[order],
        pairs=None if problem.pairs is None else place[problem.pairs],
    )
