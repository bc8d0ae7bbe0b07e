"""From answers to pairs of clouds to a pose for each cloud that they hold."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import networkx as nx
import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.maps.cycles import GATE, Consensus, Refusal, consensus
from teaser_jax.maps.graph import Edge, Engine, settle, strain
from teaser_jax.maps.pair import MapPair, widened


class Placing(NamedTuple):
    """Where clouds lie, and which pairs say so.

    Attributes:
        poses: ``T_map_cloud`` of each, between the frames as given; NaN where it is not placed.
        component: Which clouds are connected: a number for each, 0 for the largest part.
        placed: Which are in that part, if it holds two or more.
        confirmed: Which of them a cycle holds, so that no single pair decides.
        kept: Rows of the pairs that the map rests on.
        refused: Rows of trusted pairs that contradict others, and how.
        strained: Rows of those that fit the ways between their clouds and not the map, with the squared
            error in standard deviations.
        withheld: Rows of those that are contradicted and that nothing confirms.
        bridges: Rows of kept pairs that no other confirms.
    """

    poses: Float[np.ndarray, "n 4 4"]
    component: Int[np.ndarray, " n"]
    placed: Bool[np.ndarray, " n"]
    confirmed: Bool[np.ndarray, " n"]
    kept: list[int]
    refused: dict[int, Refusal]
    strained: dict[int, float]
    withheld: list[int]
    bridges: list[int]


def place(pairs: Sequence[MapPair], origins: Float[np.ndarray, "n 3"], engine: Engine, near: int) -> Placing:
    """Lay clouds together by the pairs that agree.

    Args:
        pairs: At most one for two clouds; only those that are ok count.
        origins: The middle of each cloud in its own frame: the work is done between them [length].
        engine: What optimises the poses.
        near: Up to how far apart in number clouds are neighbours in time; 0: numbers mean nothing.
    """
    rows = [k for k, pair in enumerate(pairs) if pair.ok]
    edges = {k: _edge(pairs[k], origins) for k in rows}
    found = _rows_of(consensus([*edges.values()], near), rows)
    kept, strained = list(found.kept), dict[int, float]()
    poses, component = _settled(edges, kept, len(origins), engine)
    while (row := _worst(edges, kept, poses)) is not None:
        strained[row] = strain(edges[row], poses)
        kept.remove(row)
        poses, component = _settled(edges, kept, len(origins), engine)
    placed = component == 0
    placed &= placed.sum() > 1
    graph = nx.Graph([(edges[k].i, edges[k].j) for k in kept])
    bridges = {frozenset(ends) for ends in nx.bridges(graph)}
    return Placing(
        poses=_given(poses, placed, origins),
        component=component,
        placed=placed,
        confirmed=placed & _on_a_cycle(graph, bridges, placed),
        kept=kept,
        refused=found.refused,
        strained=strained,
        withheld=found.withheld,
        bridges=[k for k in kept if frozenset((edges[k].i, edges[k].j)) in bridges],
    )


def _edge(pair: MapPair, origins: Float[np.ndarray, "n 3"]) -> Edge:
    """Write a pair as an edge between the middles of its clouds."""
    T = pair.T.copy()
    T[:3, 3] += T[:3, :3] @ origins[pair.j] - origins[pair.i]
    covariance = widened(pair, T, pair.centroid - origins[pair.i])
    least = np.trace(covariance[3:, 3:])
    return Edge(pair.i, pair.j, T, covariance, float(least))


def _rows_of(found: Consensus, rows: Sequence[int]) -> Consensus:
    """Name edges by the rows of their pairs."""
    return Consensus(
        [rows[k] for k in found.kept],
        {rows[k]: refusal for k, refusal in found.refused.items()},
        [rows[k] for k in found.withheld],
    )


def _settled(
    edges: dict[int, Edge], kept: Sequence[int], count: int, engine: Engine
) -> tuple[dict[int, Float[np.ndarray, "4 4"]], Int[np.ndarray, " n"]]:
    """Settle each connected part about its first cloud, and number the parts, the largest first."""
    graph = nx.Graph([(edges[k].i, edges[k].j) for k in kept])
    graph.add_nodes_from(range(count))
    parts = sorted((sorted(part) for part in nx.connected_components(graph)), key=lambda x: (-len(x), x))
    component = np.zeros(count, int)
    poses: dict[int, Float[np.ndarray, "4 4"]] = {}
    for number, part in enumerate(parts):
        component[part] = number
        members = set(part)
        inside = [edges[k] for k in kept if edges[k].i in members]
        poses.update(settle(inside, part[0], engine) if inside else {part[0]: np.eye(4)})
    return poses, component


def _worst(
    edges: dict[int, Edge], kept: Sequence[int], poses: dict[int, Float[np.ndarray, "4 4"]]
) -> int | None:
    """Find the kept edge that fits the poses least, if it does not fit; None: all do."""
    strains = {k: strain(edges[k], poses) for k in kept}
    return max((k for k in kept if strains[k] > GATE), key=strains.__getitem__, default=None)


def _given(
    poses: dict[int, Float[np.ndarray, "4 4"]],
    placed: Bool[np.ndarray, " n"],
    origins: Float[np.ndarray, "n 3"],
) -> Float[np.ndarray, "n 4 4"]:
    """Write poses between the middles as poses between the frames as given.

    The frame of the map is that of the first cloud that is placed.
    """
    found = np.full((len(placed), 4, 4), np.nan)
    there = np.flatnonzero(placed)
    for k in there:
        found[k] = poses[int(k)]
        found[k, :3, 3] += origins[there[0]] - found[k, :3, :3] @ origins[k]
    return found


def _on_a_cycle(
    graph: nx.Graph, bridges: set[frozenset[int]], placed: Bool[np.ndarray, " n"]
) -> Bool[np.ndarray, " n"]:
    """Tell which clouds belong to the largest part that no single edge can be cut from."""
    without = graph.subgraph([k for k in graph if placed[k]]).copy()
    without.remove_edges_from([tuple(ends) for ends in bridges])
    found = np.zeros(len(placed), bool)
    parts = sorted((sorted(part) for part in nx.connected_components(without)), key=lambda x: (-len(x), x))
    if parts and len(parts[0]) > 1:
        found[parts[0]] = True
    return found
