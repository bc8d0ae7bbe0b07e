"""A point has one partner: matches of one point, of the source or of the target, do not agree.

Where many matches lead to one point, from a patch no larger than the noise, all of them agree pairwise and
are one piece of evidence all the same. So the clique is looked for among sets that have each point once. What
follows it, the refinement and the verdict, sees all matches again.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.rows import keys
from teaser_jax.stages.pairs import PairSlice, fold_pairs


class OneToOne(NamedTuple):
    """A consistency graph without the edges between matches of one point, and what these may add.

    Attributes:
        edge_bits: Packed bit rows.
        further: Entry k - 1 says by how many matches a set that has each point once, and k matches, can grow
            at most when the others of its points join.
    """

    edge_bits: UInt32[Array, "n w"]
    further: Float[Array, " n"]


def one_to_one(
    edge_bits: UInt32[Array, "n w"],
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    mask: Bool[Array, " n"],
) -> OneToOne:
    """Take the edges between matches of one point out of a consistency graph.

    Costs next to nothing where no point is in two matches; in a batch, where none is in any problem.

    Args:
        edge_bits: Packed bit rows of the graph.
        src, dst: Clean matches [length].
        mask: Rows to use.

    Gradients: none; inputs must be stopped by the caller.
    """
    if mask.shape[0] == 0:
        return _as_it_is(edge_bits, src, dst, mask)
    return OneToOne(*_thinned(edge_bits, src, dst, mask))


def bound_on_rows(
    size: Int[AnyArray, ""], further: Float[Array, " n"], mask: Bool[Array, " n"]
) -> Int[Array, ""]:
    """Bound the matches of a clique of the whole graph, given a bound on those that have each point once.

    Args:
        size: No clique that has each point once is larger.
        further: From ``one_to_one``.
        mask: Rows to use.
    """
    if mask.shape[0] == 0:
        return size
    more = jnp.where(size > 0, further[jnp.maximum(size - 1, 0)], 0)
    usable = jnp.sum(mask, dtype=jnp.int32)
    # Above the number of matches the sum may be rounded, and does not matter.
    return jnp.minimum(size + jnp.minimum(more, usable.astype(more.dtype)).astype(jnp.int32), usable)


@custom_vmap
def _thinned(*inputs: Any) -> OneToOne:
    return lax.cond(_has_shared_points(*inputs), _without_shared_points, _as_it_is, *inputs)


@_thinned.def_vmap
def _thinned_of_many(size: int, batched: Any, *inputs: Any) -> tuple[OneToOne, OneToOne]:
    # One question for the whole batch: under a plain vmap all would pay for both answers.
    each = [
        x if has_axis else jnp.broadcast_to(x, (size, *x.shape))
        for x, has_axis in zip(inputs, batched, strict=True)
    ]
    # This may be traced after the block that allowed float64 has ended: its numbers must stay what they are.
    with jax.enable_x64(True) if inputs[1].dtype == jnp.float64 else nullcontext():
        some = jnp.any(jax.vmap(_has_shared_points)(*each))
        found = lax.cond(some, jax.vmap(_without_shared_points), jax.vmap(_as_it_is), *each)
    return found, OneToOne(True, True)  # type: ignore[arg-type]  # which of them have the axis


def _has_shared_points(edge_bits: Array, src: Array, dst: Array, mask: Array) -> Bool[Array, ""]:
    """Tell whether two usable matches may have a point in common: never no where they have."""
    unusable = jnp.uint32(0xFFFFFFFF)
    key = jax.vmap(lambda points: jnp.sort(jnp.where(mask, keys(points.T), unusable)))(jnp.stack([src, dst]))
    return jnp.any((key[:, 1:] == key[:, :-1]) & (key[:, 1:] != unusable))


def _as_it_is(edge_bits: Array, src: Array, dst: Array, mask: Array) -> OneToOne:
    return OneToOne(edge_bits, jnp.zeros(mask.shape, jnp.float32))


def _without_shared_points(edge_bits: Array, src: Array, dst: Array, mask: Array) -> OneToOne:
    shared, further = jax.vmap(lambda points: _shared(edge_bits, points, mask))(jnp.stack([src, dst]))
    return OneToOne(edge_bits & ~shared[0] & ~shared[1], further[0] + further[1])


def _shared(edge_bits: Array, points: Array, mask: Array) -> tuple[UInt32[Array, "n w"], Float[Array, " n"]]:
    """Find which matches share a point of one cloud, and what that may add to a set that has each point once.

    Take matches out of a clique, each point once, until no more can be taken. Each one that is left has
    a point in common with one of those, and agrees with it. The taken ones are of k different points, so the
    k largest of these counts bound the rest: a count for each point, that of whichever match has most.
    """

    def mark(rows: Array, lane: Array, visited: PairSlice) -> Array:
        x, y, z = visited.src_tims
        return bits.with_lane(rows, lane, (x == 0) & (y == 0) & (z == 0) & visited.valid)

    n = mask.shape[0]
    shared = fold_pairs(mark, bits.no_bits(n), points, points, jnp.zeros_like(points[:, 0]), mask)
    counts = bits.count(edge_bits & shared)
    first = jnp.minimum(bits.first_set(shared), jnp.arange(n, dtype=jnp.int32))
    of_points = jnp.zeros(n, jnp.int32).at[first].max(counts)
    return shared, jnp.cumsum(-jnp.sort(-of_points).astype(jnp.float32))
