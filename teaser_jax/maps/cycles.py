"""Which answers to two clouds contradict the others: whoever walks round a cycle must come home.

Two clouds alone can be wrong: two places may look alike. A false answer shows where it closes a cycle of
true ones. Edges are taken one by one, and each must agree with the way that those before it make: first
neighbours in time, which hardly ever take one place for another, then those that the most triangles confirm.
What is refused is weighed against what refused it. Where two places look alike, false edges between them
agree with one another, and may outnumber the true ones; then no one can tell, and that is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import networkx as nx
import numpy as np
from jaxtyping import Float

from teaser_jax.maps.graph import Edge
from teaser_jax.maps.motions import Way, chained, inverse, log, turned_round

GATE = 22.5  # of a squared error of six numbers, in standard deviations: 999 of 1000 are smaller
# A group outvotes another one if it is so many times as large, and by so many.
CLEARLY, AT_LEAST_BY = 2, 2
SWAPS = 20


class Gap(NamedTuple):
    """How a cycle fails to close.

    Attributes:
        nodes: Of the cycle, along the way that others make.
        shift: By how much it is off [length].
        turn: And turned [deg].
        error: Squared, in standard deviations.
    """

    nodes: tuple[int, ...]
    shift: float
    turn: float
    error: float


class Refusal(NamedTuple):
    """Why an edge is refused: the gap, how many edges speak for it, and how many against."""

    gap: Gap
    votes: int
    against: int

    @property
    def is_clear(self) -> bool:
        """Whether those against outvote those for it."""
        return _outvote(self.against, self.votes)


@dataclass(frozen=True, eq=False)
class Consensus:
    """Which edges agree.

    Attributes:
        kept: Rows of edges that agree with one another.
        refused: Rows of those that contradict them, and why.
        withheld: Rows of those that are contradicted and that nothing confirms.
    """

    kept: list[int]
    refused: dict[int, Refusal]
    withheld: list[int]


def consensus(edges: Sequence[Edge], near: int) -> Consensus:
    """Find edges that agree with one another, as many as can be told.

    Args:
        edges: At most one for two nodes, the first node being the smaller one.
        near: Up to how far apart in number nodes are neighbours in time, whose edges no others outvote;
            0: numbers mean nothing.
    """
    order = _most_confirmed_first(edges, near)
    web = _woven(edges, order)
    refusals = _refusals(web)
    for _ in range(SWAPS):
        better = _better(web, refusals, order, near)
        if better is None:
            break
        web, refusals = better, _refusals(better)
    withheld = _withheld(web, refusals, near)
    kept = sorted(k for k in web.kept if k not in withheld)
    return Consensus(kept, {k: refusals[k] for k in sorted(refusals)}, sorted(withheld))


@dataclass(frozen=True, eq=False)
class _Web:
    """Edges that agree, as a graph, and those that do not."""

    edges: Sequence[Edge]
    kept: list[int] = field(default_factory=list)
    gaps: dict[int, Gap] = field(default_factory=dict)
    graph: nx.Graph = field(default_factory=nx.Graph)
    _ways: dict[tuple[int, int], tuple[int, ...] | None] = field(default_factory=dict)

    def add(self, k: int) -> None:
        """Keep an edge if it agrees with the way between its nodes, or if there is none."""
        edge = self.edges[k]
        nodes = self.nodes_between(edge.i, edge.j)
        gap = None if nodes is None else _gap(edge, self.along(nodes), nodes)
        if gap is not None and gap.error > GATE:
            self.gaps[k] = gap
            return
        self.kept.append(k)
        self._ways.clear()
        self.graph.add_edge(edge.i, edge.j, weight=edge.spread, row=k)

    def count_near(self, near: int) -> int:
        """Count the kept edges of neighbours in time."""
        return sum(self.edges[k].j - self.edges[k].i <= near for k in self.kept)

    def nodes_between(self, a: int, b: int) -> tuple[int, ...] | None:
        """Find the most certain way between two nodes; None: there is none."""
        if (a, b) not in self._ways:
            there = a in self.graph and b in self.graph and nx.has_path(self.graph, a, b)
            self._ways[a, b] = tuple(nx.shortest_path(self.graph, a, b, weight="weight")) if there else None
        return self._ways[a, b]

    def along(self, nodes: tuple[int, ...]) -> Way:
        """Chain the poses along a way."""
        way = np.eye(4), np.zeros((6, 6))
        for a, b in zip(nodes, nodes[1:], strict=False):
            edge = self.edges[self.graph.edges[a, b]["row"]]
            way = chained(way, _from(edge, a))
        return way


def _from(edge: Edge, node: int) -> Way:
    """Read an edge so that it begins at one of its nodes."""
    way = edge.T, edge.covariance
    return way if edge.i == node else turned_round(way)


def _apart(way: Way, other: Way) -> tuple[Float[np.ndarray, "*n 6"], Float[np.ndarray, "*n"]]:
    """Compute by what motion two ways differ, and its square in standard deviations."""
    error = log(inverse(way[0]) @ other[0])
    weighed = np.linalg.solve(way[1] + other[1], error[..., None])[..., 0]
    return error, np.asarray(np.sum(error * weighed, axis=-1))


def _gap(edge: Edge, way: Way, nodes: tuple[int, ...]) -> Gap:
    """Compare an edge with another way from its first to its second node."""
    error, squared = _apart((edge.T, edge.covariance), way)
    shift = float(np.linalg.norm(edge.T[:3, 3] - way[0][:3, 3]))
    return Gap(nodes, shift, float(np.degrees(np.linalg.norm(error[:3]))), float(squared))


def _most_confirmed_first(edges: Sequence[Edge], near: int) -> list[int]:
    """Order edges by the triangles that close with them, less those that do not.

    Those of neighbours in time come before all others.
    """
    rows = {(edge.i, edge.j): k for k, edge in enumerate(edges)}
    after: dict[int, list[int]] = {}
    for i, j in rows:
        after.setdefault(i, []).append(j)
    sides = [
        (rows[i, j], rows[j, k], rows[i, k])
        for i, j in rows
        for k in after.get(j, ())
        if (i, k) in rows
    ]  # fmt: skip
    votes = np.zeros(len(edges))
    if sides:
        each = np.array(sides).T
        T, C = np.array([x.T for x in edges]), np.array([x.covariance for x in edges])
        first, second, direct = ((T[k], C[k]) for k in each)
        closes = _apart(direct, chained(first, second))[1] <= GATE
        signs = np.where(closes, 1, -1)
        votes = np.sum([np.bincount(k, signs, len(edges)) for k in each], axis=0)
    key = lambda k: (edges[k].j - edges[k].i > near, -votes[k], edges[k].spread, edges[k].i, edges[k].j)
    return sorted(range(len(edges)), key=key)


def _woven(edges: Sequence[Edge], order: Sequence[int]) -> _Web:
    web = _Web(edges)
    for k in order:
        web.add(k)
    return web


def _refusals(web: _Web) -> dict[int, Refusal]:
    """Count for each refused edge those that agree with it, and the kept ones that must go for it."""
    agree = dict.fromkeys(web.gaps, 1)
    for k, other in combinations(web.gaps, 2):
        if _is_backed(web, k, other):
            agree[k] += 1
            agree[other] += 1
    against = {k: nx.edge_connectivity(web.graph, web.edges[k].i, web.edges[k].j) for k in web.gaps}
    return {k: Refusal(gap, agree[k], against[k]) for k, gap in web.gaps.items()}


def _is_backed(web: _Web, k: int, other: int) -> bool:
    """Tell whether two refused edges say the same of the parts that they join."""
    edge, by = web.edges[k], web.edges[other]
    for start, end in ((by.i, by.j), (by.j, by.i)):
        out, home = web.nodes_between(edge.i, start), web.nodes_between(end, edge.j)
        if out is None or home is None:
            continue
        way = chained(chained(web.along(out), _from(by, start)), web.along(home))
        if _gap(edge, way, ()).error <= GATE:
            return True
    return False


def _outvote(ours: int, theirs: int) -> bool:
    return ours >= CLEARLY * theirs and ours >= theirs + AT_LEAST_BY


def _better(web: _Web, refusals: dict[int, Refusal], order: Sequence[int], near: int) -> _Web | None:
    """Weave anew with a group of refused edges first, if that is better; None: it is not for any group.

    It is if the group outvotes what refuses it, and more edges are kept, but none of neighbours in time is
    lost; or if more of those are kept.
    """
    tried = set()
    for k, refusal in refusals.items():
        group = [x for x in web.gaps if x == k or _is_backed(web, k, x)]
        if refusal.is_clear or frozenset(group) in tried:
            continue
        tried.add(frozenset(group))
        other = _woven(web.edges, [*group, *(x for x in order if x not in group)])
        more_near = other.count_near(near) - web.count_near(near)
        more = _outvote(refusal.votes, refusal.against) and len(other.kept) > len(web.kept)
        if more_near > 0 or (more_near == 0 and more):
            return other
    return None


def _withheld(web: _Web, refusals: dict[int, Refusal], near: int) -> set[int]:
    """Find kept edges that nothing confirms, that are contradicted by as many, and are no neighbours in time.

    Of a cloud that two edges place in two ways neither is known to be right. A chain of scans in their order
    stays what it is: there the edge that closes it is left out.
    """
    bridges = {frozenset(ends) for ends in nx.bridges(web.graph)}
    found = set()
    for refusal in refusals.values():
        if refusal.is_clear:
            continue
        nodes = refusal.gap.nodes
        for a, b in zip(nodes, nodes[1:], strict=False):
            if frozenset((a, b)) in bridges and abs(a - b) > near:
                found.add(web.graph.edges[a, b]["row"])
    return found
