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

SEEDS = 8


class Clique(NamedTuple):
    """Members of a clique, and a proved bound on the size of every clique."""

    members: Bool[AnyArray, " n"]
    upper_bound: Int[AnyArray, ""]


def greedy_clique(edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
    """The best of several greedy cliques, and a bound from peeling low degrees.

    Each seed, a vertex of high degree, takes its neighbours in the order of their degree inside
    the seed's neighbourhood. A vertex of a larger clique than the one found has at least that many
    neighbours which have that many neighbours, and so on: if peeling removes every vertex, the
    clique found is maximum.

    References: k-core bound; Rossi et al., SIAM J. Sci. Comput. 2015, for the scheme.
    """
    n = mask.shape[0]
    if n == 0:
        return Clique(jnp.zeros(0, bool), jnp.zeros((), jnp.int32))
    degree = jnp.where(mask, bits.count(edge_bits), -1)
    _, seeds = lax.top_k(degree, min(SEEDS, n))
    cliques = jax.vmap(partial(_grow, edge_bits, mask))(seeds)
    sizes = jnp.sum(cliques, axis=1, dtype=jnp.int32)
    members = cliques[jnp.argmax(sizes)]
    return Clique(members, peeling_bound(edge_bits, mask, jnp.max(sizes)))


def _grow(edge_bits: Array, mask: Array, seed: Array) -> Array:
    n = mask.shape[0]
    index = jnp.arange(n, dtype=seed.dtype)
    neighbours = edge_bits[seed]
    candidates = bits.unpack(neighbours, n)
    priority = bits.count(edge_bits & neighbours)
    # Candidates joined to all others belong in together: a clean graph needs no loop at all.
    universal = candidates & (priority >= jnp.sum(candidates, dtype=jnp.int32) - 1)
    clique = universal | ((index == seed) & mask)

    def take(state: tuple[Array, Array]) -> tuple[Array, Array]:
        clique, candidates = state
        chosen = jnp.argmax(jnp.where(candidates, priority, -1)).astype(seed.dtype)
        joined = clique | ((index == chosen) & jnp.any(candidates))
        return joined, candidates & bits.unpack(edge_bits[chosen], n)

    return lax.while_loop(lambda s: jnp.any(s[1]), take, (clique, candidates & ~universal))[0]


def peeling_bound(
    edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], lower: Int[Array, ""]
) -> Int[Array, ""]:
    """A bound on every clique, at least ``lower``: equal to it if no vertex survives peeling."""

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
    falling = jnp.sort(jnp.where(core.alive, core.degree, -1), descending=True)
    rank = jnp.arange(1, mask.shape[0] + 1, dtype=jnp.int32)
    return jnp.maximum(lower, jnp.max(jnp.minimum(falling + 1, rank), initial=0)).astype(jnp.int32)


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
    if method == "none" or mask.shape[0] == 0:
        return Clique(mask, jnp.sum(mask, dtype=jnp.int32))
    found = greedy_clique(edge_bits, mask)
    if method == "greedy":
        return found
    search = partial(_search_batch, method=method, nodes=nodes, seconds=seconds)
    shapes = Clique(jax.ShapeDtypeStruct(mask.shape, jnp.bool_), jax.ShapeDtypeStruct((), jnp.int32))

    def ask_host() -> Clique:
        return jax.pure_callback(search, shapes, edge_bits, mask, *found, vmap_method="broadcast_all")

    if method == "networkx":
        return ask_host()
    proved = jnp.sum(found.members, dtype=jnp.int32) >= found.upper_bound
    return lax.cond(proved, lambda: found, ask_host)


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


def _search_batch(edge_bits, mask, members, upper, *, method, nodes, seconds):
    edge_bits, mask, members, upper = (np.asarray(x) for x in (edge_bits, mask, members, upper))
    out = Clique(np.array(members), np.array(upper, dtype=np.int32))
    for item in np.ndindex(upper.shape):
        one = search_on_host(
            edge_bits[item],
            mask[item],
            Clique(members[item], upper[item]),
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
