"""A point has one partner: where matches of one point crowd, matches of one point do not agree.

Where many matches lead to one point, from a patch no larger than the noise, all of them agree pairwise and
are one piece of evidence all the same. There the clique is looked for among sets that have each point of
either cloud once. What follows it, the refinement and the verdict, sees all matches again.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.ground.branches import if_any
from teaser_jax.rows import keys
from teaser_jax.stages.consistency import consistency_graph, reach_of

# So many others of one point must agree with one of its matches: fewer outvote nobody, and a sparser graph
# takes longer. Of 133 right answers to hard real problems 128 are ok with all edges; with crowds from 12 on
# thinned 128 of 132, from 8 on 130 of 132, from 6, 4 or 1 on 132 of 134.
CROWD = 6


class OneToOne(NamedTuple):
    """A consistency graph, where matches crowd without edges between those of one point, and what these add.

    Attributes:
        edge_bits: Packed bit rows.
        further: Entry k - 1 says by how many matches a set that has each point once, and k matches, can grow
            at most when the others of its points join.
    """

    edge_bits: UInt32[Array, "n w"]
    further: Float[Array, " n"]


def one_to_one_graph(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    scale: Float[Array, ""],
    cbar2: Float[Array, ""],
) -> OneToOne:
    """Find the consistency graph of matches; where some crowd at a point, those of one point do not agree.

    Args:
        src, dst: Clean matches, row i with row i [length].
        noise_bound: beta_i [length of the target].
        mask: Rows to use.
        scale: Known or voted [-].
        cbar2: Truncation [-].

    Gradients: none; inputs are stopped.

    References: section VI-D for the graph.
    """
    inputs = lax.stop_gradient((src, dst, noise_bound, mask, scale, cbar2))
    return _whole(*inputs) if mask.shape[0] == 0 else _graph(*inputs)


def bound_on_rows(
    size: Int[AnyArray, ""], further: Float[Array, " n"], mask: Bool[Array, " n"]
) -> Int[Array, ""]:
    """Bound the matches of a clique of the whole graph, given a bound on those that have each point once.

    Args:
        size: No clique that has each point once is larger.
        further: From ``one_to_one_graph``.
        mask: Rows to use.
    """
    if mask.shape[0] == 0:
        return size
    more = jnp.where(size > 0, further[jnp.maximum(size - 1, 0)], 0)
    usable = jnp.sum(mask, dtype=jnp.int32)
    # Above the number of matches the sum may be rounded, and does not matter.
    return jnp.minimum(size + jnp.minimum(more, usable.astype(more.dtype)).astype(jnp.int32), usable)


def _has_crowded_points(
    src: Array, dst: Array, noise_bound: Array, mask: Array, scale: Array, cbar2: Array
) -> Bool[Array, ""]:
    """Tell whether more than ``CROWD`` usable matches may have one point: never no where they have.

    Points are counted in slots, by a hash of their coordinates.
    """
    width = (8 * mask.shape[0]).bit_length()  # so sparse that hardly any slot holds seven different points

    def fullest(points: Array) -> Array:
        slot = (keys(points.T) >> (31 - width)).astype(jnp.int32)
        return jnp.max(jnp.zeros(1 << width, jnp.int32).at[slot].add(mask.astype(jnp.int32)))

    return jnp.maximum(fullest(src), fullest(dst)) > CROWD


def _whole(src: Array, dst: Array, noise_bound: Array, mask: Array, scale: Array, cbar2: Array) -> OneToOne:
    edges = consistency_graph(src, dst, noise_bound, mask, scale=scale, cbar2=cbar2)
    return OneToOne(edges, jnp.zeros(mask.shape, jnp.float32))


def _thinned_where_crowded(
    src: Array, dst: Array, noise_bound: Array, mask: Array, scale: Array, cbar2: Array
) -> OneToOne:
    reach = jnp.where(mask, reach_of(src, dst, noise_bound, mask, scale, cbar2), jnp.nan)
    clouds = jnp.stack([scale * src, dst])  # points are equal here if they are in the graph
    most = jax.vmap(_company, (0, 0, None))(clouds, clouds[::-1], reach)
    crowded = jnp.any(most[:, 0] >= CROWD)
    edges = consistency_graph(src, dst, noise_bound, mask, scale=scale, cbar2=cbar2, one_to_one=crowded)
    further = jnp.cumsum(jnp.sum(most, axis=0).astype(jnp.float32))
    return OneToOne(edges, jnp.where(crowded, further, jnp.zeros_like(further)))


def _company(points: Array, partners: Array, reach: Array) -> Int[Array, " n"]:
    """Count for each point of a cloud the others that agree with one of its matches, the largest count first.

    The k largest bound what matches of one point may add to k that have each point once.

    Take matches out of a clique, each point once, until no more can be taken. Each one that is left has
    a point in common with one of those, and agrees with it: their partners lie within the reach of both. The
    taken ones are of k different points, so the k largest of these counts bound the rest: a count for each
    point, that of whichever of its matches has most.
    """
    n, usable = reach.shape[0], ~jnp.isnan(reach)
    # Equal points side by side, and what is not used at the end.
    coordinates = jnp.where(usable[None], jnp.where(points == 0, jnp.zeros_like(points), points).T, jnp.inf)
    *ordered, order = lax.sort((*coordinates, jnp.arange(n, dtype=jnp.int32)), num_keys=3)
    same = jnp.stack([x[1:] == x[:-1] for x in ordered]).all(axis=0) & usable[order][1:]
    point = bits.rank(jnp.pad(~same, (1, 0), constant_values=True)) - 1
    one = (point, reach[order], *partners[order].T)
    beyond = [jnp.concatenate([x, jnp.full_like(x, -1)]) for x in one]  # behind the last there is no point

    def compare(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        apart, counts, _ = state
        other = [lax.dynamic_slice_in_dim(x, apart, n) for x in beyond]
        alike = other[0] == point
        within2 = 1.001 * (one[1] + other[1]) ** 2  # for a bound, rather too many than too few
        agree = alike & (sum((y - x) ** 2 for x, y in zip(one[2:], other[2:], strict=True)) <= within2)
        behind = lax.dynamic_slice_in_dim(jnp.pad(agree, (n, 0)), n - apart, n)
        return apart + 1, counts + agree.astype(jnp.int32) + behind.astype(jnp.int32), jnp.any(alike)

    start = jnp.int32(1), jnp.zeros(n, jnp.int32), jnp.ones((), bool)
    counts = lax.while_loop(lambda state: state[2] & (state[0] < n), compare, start)[1]
    most = jnp.zeros(n, jnp.int32).at[point].max(counts)
    return -jnp.sort(-most)


_graph = if_any(_has_crowded_points, _thinned_where_crowded, _whole)
