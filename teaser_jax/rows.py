"""The rows of a problem in an order of their own, copies merged, so that nothing depends on how they came.

Cliques of equal size, chains of TIMs and the last bit of a sum depend on the order of the matches. So rows
are solved in the order of a hash of their numbers, and whoever permutes them gets the same sets. Rows that
are exact copies of one another meet there: one of them is solved, and all share its fate, so that a row
listed two hundred times is one match and not two hundred.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, Placeholder, namespace
from teaser_jax.problem import Problem

# Odd numbers, one for each coordinate of a match and one for their sum, that mix bits.
MIX_EACH = np.array([0x9E3779B1, 0x85EBCA6B, 0xC2B2AE35, 0x27D4EB2F, 0x165667B1, 0x7FEB352D], np.uint32)
MIX_SUM = np.uint32(0x846CA68B)
LAST = np.uint32(0xFFFFFFFF)  # the key of rows that cannot be used


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
    with jax.enable_x64(True):  # one number to sort by is four times as fast as two
        key = jnp.where(p.mask, keys(points), LAST).astype(jnp.uint64) << 32
        order = (lax.sort(key | index.astype(jnp.uint64)) & LAST.astype(np.uint64)).astype(jnp.int32)
    here, usable = points[:, order], p.mask[order]
    copy = jnp.all(here[:, 1:] == here[:, :-1], axis=0) & usable[1:] & usable[:-1]
    leads = jnp.pad(~copy, (1, 0), constant_values=True)
    start = bits.listed(leads)[bits.rank(leads) - 1]
    place = jnp.zeros_like(index).at[order].set(start)
    # Of copies the most confident one stands for all, and of those one with the smallest bound.
    best = jnp.zeros_like(p.confidence).at[place].max(p.confidence)
    doubt = jnp.where(p.confidence == best[place], p.noise_bound, jnp.inf)
    least = jnp.full_like(doubt, jnp.inf).at[place].min(doubt)
    winner = jnp.full(n, n - 1, jnp.int32).at[place].min(jnp.where(doubt == least[place], index, n - 1))
    return Rows(jnp.where(leads, winner, order), place)


def arrange_on_host(
    points: Float[np.ndarray, "*b 6 n"],
    mask: Bool[np.ndarray, "*b n"],
    noise_bound: Float[np.ndarray, "*b n"],
    confidence: Float[np.ndarray, "*b n"],
) -> Rows:
    """Arrange the rows of one problem, or of a stack, as ``arrange`` does; in numpy, from its coordinates."""
    n = points.shape[-1]
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that nobody can use
        key = np.where(mask, keys(points), LAST)
    both = key.astype(np.uint64)
    both <<= np.uint64(32)
    both |= np.arange(n, dtype=np.uint64)
    both.sort(axis=-1)
    order = (both & np.uint64(LAST)).astype(np.int32)
    place = np.empty_like(order)
    front = () if order.ndim == 1 else (np.arange(len(order))[:, None],)
    place[(*front, order)] = np.arange(n, dtype=np.int32)
    both >>= np.uint64(32)
    alike = (both[..., 1:] == both[..., :-1]) & (both[..., 1:] != LAST)
    if not alike.any():  # nearly always
        return Rows(order, place)
    for k in zip(*np.nonzero(alike.any(axis=-1)), strict=True) if alike.ndim > 1 else [()]:
        _merge_copies(points[k], mask[k], noise_bound[k], confidence[k], order[k], place[k])
    return Rows(order, place)


def _merge_copies(
    points: np.ndarray, mask: np.ndarray, noise_bound: np.ndarray, confidence: np.ndarray,
    order: np.ndarray, place: np.ndarray,
) -> None:  # fmt: skip
    """Send the copies among the rows of one problem to the row that stands for them, in place."""
    usable = mask & np.isfinite(noise_bound + confidence) & (noise_bound > 0) & (confidence > 0)
    here, index = points[:, order], np.arange(len(order), dtype=np.int32)
    copy = (here[:, 1:] == here[:, :-1]).all(axis=0) & usable[order][1:] & usable[order][:-1]
    place[order] = np.maximum.accumulate(np.where(np.append(False, copy), 0, index))
    ranked = np.lexsort((noise_bound, -np.where(usable, confidence, 0), place))
    leads, first = np.unique(place[ranked], return_index=True)
    order[leads] = ranked[first]


def keys(points: Float[AnyArray, "*b k n"]) -> UInt32[AnyArray, "*b n"]:
    """Compute a number of 31 bits for each point or match, from its coordinates as float32 knows them."""
    xp = namespace(points)
    narrow = (points + 0.0).astype(np.float32)  # of the two zeros one
    words = narrow.view(np.uint32) if xp is np else lax.bitcast_convert_type(_one_zero(narrow), jnp.uint32)
    count = words.shape[-2]
    factors = MIX_EACH[:count].reshape((1,) * (words.ndim - 2) + (count, 1))
    words = (words ^ (words >> np.uint32(16))) * factors
    words = words ^ (words >> np.uint32(13))
    found = xp.sum(words, axis=-2, dtype=np.uint32)
    found = (found ^ (found >> np.uint32(16))) * MIX_SUM
    return (found ^ (found >> np.uint32(15))) >> np.uint32(1)


def _one_zero(numbers: Float[Array, "*k"]) -> Float[Array, "*k"]:
    """Replace the zero below by the zero above; XLA leaves a sum with zero out."""
    return jnp.where(numbers == 0, jnp.zeros_like(numbers), numbers)


def in_rows(problem: Problem, rows: Rows) -> Problem:
    """Put a problem into its rows: copies are masked, and pairs name the rows that stand for them.

    Gradients: exact; what a copy would get goes to the row that stands for it.
    """
    xp = namespace(problem.src)
    order, place = rows.order, rows.place
    alone = place[order] == xp.arange(order.shape[0], dtype=order.dtype)
    return replace(
        problem,
        src=problem.src[order],
        dst=problem.dst[order],
        noise_bound=problem.noise_bound[order],
        mask=problem.mask[order] & alone,
        confidence=problem.confidence[order],
        pairs=None if problem.pairs is None else place[problem.pairs],
    )


def in_users_order(values: AnyArray, rows: Rows) -> AnyArray:
    """Give each row what was found at the place of the row that stands for it, (..., n) or (..., n, k)."""
    place = rows.place
    if place.ndim == 1:
        return values[place]
    xp = namespace(values)
    index = place[..., None] if values.ndim > place.ndim else place
    return xp.take_along_axis(values, index, axis=place.ndim - 1)
