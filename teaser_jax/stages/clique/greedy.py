"""Greedy cliques on the device, with a proved bound: enough for most graphs of the paper's kind."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.ground.numbers import named
from teaser_jax.stages.clique.clique import Clique

SEEDS = 8  # cliques grown where no search follows
# Share of the range of degrees that goes at a time: smaller is slower and hardly better.
DROPPED_SHARE = 0.15


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class GreedyClique:
    """Take the best of a few greedy cliques; all of it stays on the device. The bound is proved."""

    name: str = named("greedy")
    needs_host: ClassVar[bool] = False
    prunes: ClassVar[bool] = True

    def on_device(self, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
        """Find the best of some greedy cliques, and the bound from peeling."""
        return greedy_clique(edge_bits, mask)

    def is_settled(self, found: Clique) -> Bool[AnyArray, "*batch"]:
        """Return True for every graph: no search follows."""
        return namespace(found.upper_bound).ones_like(found.upper_bound, dtype=bool)

    def on_host(
        self, edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"], found: Clique
    ) -> Clique:
        """Return what the device has found."""
        return found


def greedy_clique(edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], *, seeds: int = SEEDS) -> Clique:
    """Find the best of some greedy cliques, and a bound from peeling off vertices of low degree.

    Grows cliques from vertices of high degree, each outside the cliques before it, until one is
    proved maximum or the seeds are used up.

    References: k-core bound; Rossi et al., SIAM J. Sci. Comput. 2015, for the scheme.
    """
    n = mask.shape[0]
    if n == 0:
        return Clique(jnp.zeros(0, bool), jnp.zeros((), jnp.int32))
    degree = jnp.where(mask, bits.count(edge_bits), -1)
    index = jnp.arange(n, dtype=jnp.int32)

    class Search(NamedTuple):
        members: Array
        upper_bound: Array
        untried: Array  # vertices that no clique so far has, and that a larger one could have
        seeds: Array

    def once(state: Search) -> Search:
        seed = bits.first_smallest(jnp.where(state.untried, -degree, 1))
        grown = _grow(edge_bits, degree, index, seed) & mask
        larger = jnp.sum(grown, dtype=jnp.int32) > jnp.sum(state.members, dtype=jnp.int32)
        members = jnp.where(larger, grown, state.members)
        alive, bound = peeling_bound(edge_bits, mask, jnp.sum(members, dtype=jnp.int32))
        untried = state.untried & alive & ~grown & (index != seed)
        return Search(members, jnp.minimum(bound, state.upper_bound), untried, state.seeds + 1)

    def unproved(state: Search) -> Array:
        short = jnp.sum(state.members, dtype=jnp.int32) < state.upper_bound
        return short & (state.seeds < seeds) & jnp.any(state.untried)

    start = Search(jnp.zeros(n, bool), jnp.sum(mask, dtype=jnp.int32), mask, jnp.int32(0))
    final = lax.while_loop(unproved, once, start)
    return Clique(final.members, final.upper_bound)


def _grow(edge_bits: Array, degree: Array, index: Array, seed: Array) -> Array:
    """Grow a maximal clique through ``seed``: its neighbourhood, less whoever knows fewest of the rest.

    Dropping from a neighbourhood finds larger cliques than adding to a vertex, and takes few
    rounds, because whoever stands low goes at once.
    """

    class Growth(NamedTuple):
        inside: Array
        done: Array

    def once(state: Growth) -> Growth:
        inside = state.inside
        joined = bits.count(edge_bits & bits.pack(inside)[None])  # neighbours inside
        size = jnp.sum(inside, dtype=jnp.int32)
        lowest = jnp.min(jnp.where(inside, joined, size))
        # The seed is joined to all, so the range ends at size - 1 and the seed stays.
        cut = lowest + (DROPPED_SHARE * (size - 1 - lowest).astype(jnp.float32)).astype(jnp.int32)
        complete = lowest >= size - 1
        fitting = ~inside & (joined == size)
        chosen = bits.first_smallest(jnp.where(fitting, -degree, 1))
        larger = inside | (fitting & (index == chosen))
        return Growth(jnp.where(complete, larger, inside & (joined > cut)), complete & ~jnp.any(fitting))

    neighbours = bits.unpack(edge_bits[seed], degree.shape[0]) | (index == seed)
    return lax.while_loop(lambda s: ~s.done, once, Growth(neighbours, jnp.zeros((), bool))).inside


def peeling_bound(
    edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], lower: Int[Array, ""]
) -> tuple[Bool[Array, " n"], Int[Array, ""]]:
    """Find the vertices that a clique larger than ``lower`` could have, and a bound on every clique.

    Such a vertex has at least ``lower`` neighbours that have as many, and so on. If none is left,
    the bound is ``lower``: a clique of that size is maximum.
    """

    class Peel(NamedTuple):
        alive: Array
        degree: Array
        changed: Array

    def once(state: Peel) -> Peel:
        degree = bits.count(edge_bits & bits.pack(state.alive)[None])
        alive = state.alive & (degree >= lower)
        return Peel(alive, degree, jnp.any(alive != state.alive))

    start = Peel(mask, jnp.zeros(mask.shape, jnp.int32), jnp.ones((), bool))
    core = lax.while_loop(lambda s: s.changed, once, start)
    # A clique of k needs k vertices of degree k - 1.
    falling = -jnp.sort(jnp.where(core.alive, -core.degree, 1))
    rank = jnp.arange(1, mask.shape[0] + 1, dtype=jnp.int32)
    bound = jnp.max(jnp.minimum(falling + 1, rank), initial=0)
    return core.alive, jnp.maximum(lower, bound).astype(jnp.int32)
