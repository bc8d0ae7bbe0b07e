"""The largest set of matches that agree pairwise (section VI-D): device part and the way to the host.

A few greedy cliques and a peeling bound prove the maximum on most graphs of the paper's kind; only
the rest go to the exact search on the host.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Int, UInt32

from teaser_jax.so3 import AnyArray
from teaser_jax.stages import bits
from teaser_jax.types import CliqueMethod

# Cliques grown before the host takes over, and where nothing comes after them.
SEEDS_BEFORE_SEARCH, SEEDS_ALONE = 2, 8
# Share of the range of degrees that goes at a time: smaller is slower and hardly better.
CUT = 0.15


class Clique(NamedTuple):
    """Members of a clique, and a proved bound on the size of every clique."""

    members: Bool[AnyArray, " n"]
    upper_bound: Int[AnyArray, ""]

    @property
    def proved(self) -> Bool[AnyArray, ""]:
        """Whether no clique is larger."""
        return self.members.sum(dtype=np.int32) >= self.upper_bound


def greedy_clique(
    edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], *, seeds: int = SEEDS_ALONE
) -> Clique:
    """The best of some greedy cliques, and a bound from peeling off vertices of low degree.

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
    """A maximal clique through ``seed``: its neighbourhood, less whoever knows fewest of the rest.

    Dropping from a neighbourhood finds larger cliques than adding to a vertex, and takes few
    rounds, because whoever stands low goes at once.
    """

    class Growth(NamedTuple):
        inside: Array
        done: Array

    def once(state: Growth) -> Growth:
        inside = state.inside
        joined = bits.count(edge_bits & bits.pack(inside))  # neighbours inside
        size = jnp.sum(inside, dtype=jnp.int32)
        lowest = jnp.min(jnp.where(inside, joined, size))
        # The seed is joined to all, so the range ends at size - 1 and the seed stays.
        cut = lowest + (CUT * (size - 1 - lowest).astype(jnp.float32)).astype(jnp.int32)
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
    """Vertices that a clique larger than ``lower`` could have, and a bound on every clique.

    Such a vertex has at least ``lower`` neighbours that have as many, and so on. If none is left,
    the bound is ``lower``: a clique of that size is maximum.
    """

    class Peel(NamedTuple):
        alive: Array
        degree: Array
        changed: Array

    def once(state: Peel) -> Peel:
        degree = bits.count(edge_bits & bits.pack(state.alive))
        alive = state.alive & (degree >= lower)
        return Peel(alive, degree, jnp.any(alive != state.alive))

    start = Peel(mask, jnp.zeros(mask.shape, jnp.int32), jnp.ones((), bool))
    core = lax.while_loop(lambda s: s.changed, once, start)
    # A clique of k needs k vertices of degree k - 1.
    falling = -jnp.sort(jnp.where(core.alive, -core.degree, 1))
    rank = jnp.arange(1, mask.shape[0] + 1, dtype=jnp.int32)
    bound = jnp.max(jnp.minimum(falling + 1, rank), initial=0)
    return core.alive, jnp.maximum(lower, bound).astype(jnp.int32)


def clique_on_device(
    edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], *, method: CliqueMethod = "exact"
) -> Clique:
    """As far as the device goes: all usable matches for ``"none"``, otherwise greedy cliques."""
    if method == "none":
        return Clique(mask, jnp.sum(mask, dtype=jnp.int32))
    alone = method == "greedy"
    return greedy_clique(edge_bits, mask, seeds=SEEDS_ALONE if alone else SEEDS_BEFORE_SEARCH)


def maximum_clique(
    edge_bits: UInt32[Array, "n w"],
    mask: Bool[Array, " n"],
    *,
    method: CliqueMethod = "exact",
    nodes: int = 100_000_000,
    seconds: float = 60.0,
) -> Clique:
    """The maximum clique of a consistency graph, or the best within the budget with its bound.

    ``"exact"`` calls the host, once for a whole batch under ``vmap``, and only if the device has
    no proof. ``"none"`` returns all usable matches. Works under jit, vmap and scan on one device.

    Gradients: none.
    """
    found = clique_on_device(edge_bits, mask, method=method)
    if method in ("none", "greedy") or mask.shape[0] == 0:
        return found
    search = partial(search_batch_on_host, method=method, nodes=nodes, seconds=seconds)
    shapes = Clique(jax.ShapeDtypeStruct(mask.shape, jnp.bool_), jax.ShapeDtypeStruct((), jnp.int32))

    def ask_host() -> Clique:
        return jax.pure_callback(search, shapes, edge_bits, mask, *found, vmap_method="broadcast_all")

    if method == "networkx":
        return ask_host()
    return lax.cond(found.proved, lambda: found, ask_host)


def search_on_host(
    edge_bits: np.ndarray,
    mask: np.ndarray,
    found: Clique,
    *,
    method: str = "exact",
    nodes: int = 100_000_000,
    seconds: float = 60.0,
) -> Clique:
    """Finish one graph on the host, outside jit. A proved clique is returned as it is."""
    members, upper = np.asarray(found.members), int(found.upper_bound)
    if method == "networkx":
        return _with_networkx(np.asarray(edge_bits), np.asarray(mask))
    if members.sum() >= upper:
        return Clique(members, np.int32(upper))
    from teaser_jax.stages import clique_search

    members, upper = clique_search.search(np.asarray(edge_bits), members, upper, nodes=nodes, seconds=seconds)
    return Clique(members, np.int32(upper))


def search_batch_on_host(
    edge_bits: np.ndarray,
    mask: np.ndarray,
    members: np.ndarray,
    upper_bound: np.ndarray,
    *,
    method: str,
    nodes: int,
    seconds: float,
) -> Clique:
    """``search_on_host`` for whatever batch axes stand in front, one graph after the other."""
    out = Clique(np.array(members), np.array(upper_bound, dtype=np.int32))
    edge_bits, mask = np.asarray(edge_bits), np.asarray(mask)
    unproved = (out.members.sum(axis=-1) < out.upper_bound) | (method == "networkx")
    for item in map(tuple, np.argwhere(unproved)):
        one = search_on_host(
            edge_bits[item],
            mask[item],
            Clique(out.members[item], out.upper_bound[item]),
            method=method,
            nodes=nodes,
            seconds=seconds,
        )
        out.members[item], out.upper_bound[item] = one
    return out


def _with_networkx(edge_bits: np.ndarray, mask: np.ndarray) -> Clique:
    import networkx as nx

    graph = graph_of(edge_bits, mask)
    members = np.zeros(mask.shape[0], bool)
    clique, _ = nx.max_weight_clique(graph, weight=None)
    members[clique] = True
    return Clique(members, np.int32(members.sum()))


def graph_of(edge_bits: np.ndarray, mask: np.ndarray):
    """The consistency graph as a ``networkx.Graph`` on the usable matches, to look inside."""
    import networkx as nx

    n = mask.shape[0]
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(mask).tolist())
    rows, columns = np.nonzero(np.triu(bits.unpack_host(np.asarray(edge_bits), n), 1))
    graph.add_edges_from(zip(rows.tolist(), columns.tolist(), strict=True))
    return graph
