"""The maximum clique by networkx: slow, trusted, and a graph to look at."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import jax
import numpy as np
from jaxtyping import Array, Bool, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.ground.numbers import named
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.greedy import greedy_clique

if TYPE_CHECKING:
    import networkx as nx


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NetworkxClique:
    """Search every graph on the host with networkx, whatever the device has proved: the slow oracle."""

    name: str = named("networkx")
    needs_host: ClassVar[bool] = True
    prunes: ClassVar[bool] = True

    def on_device(self, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
        """Find a greedy clique, which the host does not look at."""
        return greedy_clique(edge_bits, mask, seeds=1)

    def is_settled(self, found: Clique) -> Bool[AnyArray, "*batch"]:
        """Return False for every graph: the oracle judges for itself."""
        return namespace(found.upper_bound).zeros_like(found.upper_bound, dtype=bool)

    def on_host(
        self, edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"], found: Clique
    ) -> Clique:
        """Find a maximum clique of the graph."""
        return networkx_clique(edge_bits, mask)


def networkx_clique(edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"]) -> Clique:
    """Find a maximum clique, exactly, slowly and without a budget."""
    import networkx as nx

    members = np.zeros(mask.shape[0], bool)
    clique, _ = nx.max_weight_clique(graph_of(edge_bits, mask), weight=None)
    members[clique] = True
    return Clique(members, np.int32(members.sum()))


def graph_of(edge_bits: UInt32[AnyArray, "n w"], mask: Bool[AnyArray, " n"]) -> nx.Graph:
    """Make a ``networkx.Graph`` of the consistency graph on the usable matches, to look inside."""
    import networkx as nx

    n = mask.shape[0]
    graph = nx.Graph()
    graph.add_nodes_from(np.flatnonzero(mask).tolist())
    rows, columns = np.nonzero(np.triu(bits.unpack_host(np.asarray(edge_bits), n), 1))
    graph.add_edges_from(zip(rows.tolist(), columns.tolist(), strict=True))
    return graph
