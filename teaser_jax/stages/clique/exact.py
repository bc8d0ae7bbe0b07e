"""The exact maximum clique: on the host, within a budget, and with a proved bound at every moment.

Reduce, order, bound, branch: greedy cliques and the removal of vertices (k-core) and edges
(truss) that no larger clique can contain shrink the graph; a degeneracy order splits it into one
small root problem a vertex; colouring bounds discard most roots; branch and bound with
recolouring (San Segundo et al. 2013) settles the rest, best bound first, so that the global
upper bound falls while the search runs.
"""

from __future__ import annotations

import logging
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from typing import ClassVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Int, UInt32, UInt64

from teaser_jax.ground.arrays import AnyArray
from teaser_jax.ground.numbers import TracedNumber, count, named, number, settle
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.greedy import DROPPED_SHARE, greedy_clique
from teaser_jax.stages.clique.oracle import networkx_clique
from teaser_jax.stages.clique.watch import Watch

log = logging.getLogger("teaser_jax")

SEEDS_BEFORE_SEARCH = 2  # greedy cliques on the device before the host takes over
SLICE = 2_000_000  # word operations between two looks at the clock: one or two milliseconds
# A better clique before the edges are thinned saves more than it costs, the more so the more edges
# there are. Seeds are tried until so many in a row gave nothing larger: these, or the square of the
# edges in units of EDGES. On real graphs of 0.7, 1.6 and 2.8 million edges 8, 8 - 32 and 128 were best.
PATIENCE, EDGES = 8, 250_000
_ready = False
_loading = threading.Lock()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ExactClique:
    """Find the maximum clique: greedy cliques on the device, then a search on the host if they prove none.

    When a budget is spent, the best clique so far and the bound proved by then are returned.

    Attributes:
        nodes: Budget of search nodes; traced.
        seconds: Budget of time [s]; traced. Compiling the search is not counted.
    """

    name: str = named("exact")
    nodes: TracedNumber = count(100_000_000, traced=True)
    seconds: TracedNumber = number(60.0, least=0, infinite=True)
    needs_host: ClassVar[bool] = True
    prunes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        settle(self)

    def on_device(self, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
        """Find the better of two greedy cliques, and the bound from peeling."""
        return greedy_clique(edge_bits, mask, seeds=SEEDS_BEFORE_SEARCH)

    def is_settled(self, found: Clique) -> Bool[AnyArray, "*batch"]:
        """Tell whether the device has proved its clique."""
        return found.proved

    def on_host(
        self, edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"], found: Clique
    ) -> Clique:
        """Find the maximum clique, or the best one within the budget."""
        return search_clique(edge_bits, found, nodes=int(self.nodes), seconds=float(self.seconds))


def search_clique(
    edge_bits: UInt32[np.ndarray, "n w"], found: Clique, *, nodes: int, seconds: float
) -> Clique:
    """Find the maximum clique of a packed graph, or the best one within the budget.

    Where numba cannot be had, networkx searches instead, exactly but slowly and without budget.

    Args:
        edge_bits: Rows of the graph, symmetric, no loops.
        found: A clique to start from, and a bound that is known already.
        nodes: Budget of search nodes.
        seconds: Budget of time [s]; compiling the loops is not counted.

    Returns:
        The best clique, and a proved bound on every clique: they are equal if the search came to its end.
    """
    if not load_kernels():
        return networkx_clique(edge_bits, found.members | np.any(edge_bits, axis=1))
    return _Search(edge_bits, found, nodes, seconds).run()


class _OutOfBudget(Exception):
    """Raised inside the search when time or nodes are spent; never leaves this module."""


class _Search:
    """One search for the maximum clique. ``best`` (original numbers) and ``upper`` are always valid."""

    def __init__(
        self, edge_bits: UInt32[np.ndarray, "n w"], found: Clique, nodes: int, seconds: float
    ) -> None:
        # Not above: they import numba, which takes its time.
        from teaser_jax.stages.clique import branching, reduction

        self.reduction, self.branching = reduction, branching
        self.deadline = time.perf_counter() + seconds
        self.watch = Watch()
        self.nodes_left = nodes
        self.n = found.members.shape[0]
        self.best = np.flatnonzero(found.members).astype(np.int64)
        self.upper = max(int(found.upper_bound), len(self.best))
        self.rows = _as_words(edge_bits)
        self.names = np.arange(self.n)  # original number of each vertex of `rows`

    def run(self) -> Clique:
        """Search the graph until the maximum is proved or a budget is spent."""
        with self.watch, suppress(_OutOfBudget):  # best and upper say how far it came
            self.reduce()
            self.order_and_branch()
        members = np.zeros(self.n, bool)
        members[self.best] = True
        return Clique(members, np.int32(self.upper))

    def check_budget(self) -> None:
        """End the search if time or nodes are spent; show how far it is, and let an interrupt through."""
        self.watch.look(len(self.best), self.upper)
        if time.perf_counter() >= self.deadline or self.nodes_left <= 0:
            raise _OutOfBudget

    def lower_upper(self, bound: int) -> bool:
        """Record a proved bound; return True if it closes the search."""
        self.upper = max(len(self.best), min(self.upper, bound))
        return self.upper == len(self.best)

    def keep(self, chosen: Int[np.ndarray, " m"]) -> None:
        """Leave only these vertices in the graph, renumbered in that order."""
        self.rows = self.reduction.induced(self.rows, chosen)
        self.names = self.names[chosen]

    def reduce(self) -> None:
        """Shrink the graph to what could hold a larger clique; improve the clique on the way."""
        k = self.reduction
        while True:
            before = len(self.names)
            self.peel()
            if self.lower_upper(0 if len(self.names) == 0 else self.upper):
                return
            self.order()
            if self.lower_upper(self.colours()):
                return
            edges = int(k.degrees(self.rows).sum()) // 2
            improved = self.grow(patience=max(PATIENCE, (edges / EDGES) ** 2))
            if self.lower_upper(self.upper):
                return
            removed = self.truss()
            self.peel()
            if self.lower_upper(0 if len(self.names) == 0 else self.upper):
                return
            if not improved and removed < 0.05 * edges and len(self.names) > 0.95 * before:
                return

    def peel(self) -> None:
        """Drop vertices with too few neighbours for a larger clique."""
        alive = np.ones(len(self.names), bool)
        degree = self.reduction.degrees(self.rows)
        if self.reduction.peel(self.rows, degree, alive, len(self.best)) < len(alive):
            self.keep(np.flatnonzero(alive))

    def order(self) -> None:
        """Number the vertices by degeneracy, largest cores first, and take the bound that gives."""
        order, core = self.reduction.degeneracy_order(self.rows)
        self.keep(np.ascontiguousarray(order[::-1]))
        self.lower_upper(int(core.max()) + 1)

    def colours(self) -> int:
        """Count the colours that do for the whole graph: half the bound of the cores, for next to nothing."""
        n, width = self.rows.shape
        everyone = np.zeros(64 * width, bool)
        everyone[:n] = True
        candidates = np.packbits(everyone, bitorder="little").view("<u8").astype(np.uint64)
        listed = np.empty((2, n + 1), np.int64)
        scratch, classes = np.empty((2, width), np.uint64), np.zeros((2, width), np.uint64)
        _, used, _ = self.branching.colour(candidates, self.rows, 0, *listed, classes, *scratch)
        return int(used)

    def grow(self, *, patience: float) -> bool:
        """Grow greedy cliques from vertices in no clique so far, until ``patience`` of them are no larger."""
        clique = np.empty(len(self.names) + 1, np.int64)
        covered = np.zeros(len(self.names), bool)
        improved, idle = False, 0
        for seed in range(len(self.names)):
            if covered[seed]:
                continue
            size = self.reduction.grow_clique(self.rows, seed, DROPPED_SHARE, clique)
            covered[clique[:size]] = True
            idle += 1
            if size > len(self.best):
                self.best, improved, idle = self.names[clique[:size]], True, 0
                if self.lower_upper(self.upper):
                    break
            if idle >= patience:
                break
            self.check_budget()
        return improved

    def truss(self) -> int:
        """Drop edges with too few common neighbours for a larger clique, and count them."""
        degree = self.reduction.degrees(self.rows)
        removed, row = 0, len(self.names) - 1
        while row >= 0:
            gone, row = self.reduction.drop_weak_edges(self.rows, degree, len(self.best), row, SLICE)
            removed += gone
            self.check_budget()
        return removed

    def order_and_branch(self) -> None:
        """Settle root after root, the one with the highest bound first."""
        if self.upper == len(self.best):
            return
        self.order()
        if self.lower_upper(self.colours()):
            return
        bounds = np.full(len(self.names), self.upper, np.int64)
        vertex = 0
        while vertex < len(bounds):
            vertex = self.branching.root_bounds(self.rows, len(self.best), bounds, vertex, SLICE)
            self.check_budget()
        if self.lower_upper(int(bounds.max())):
            return
        for root in np.argsort(-bounds, kind="stable"):
            if self.lower_upper(int(bounds[root])):
                return
            self.branch_root(int(root))
            bounds[root] = 0
        self.lower_upper(0)

    def branch_root(self, root: int) -> None:
        """Settle the cliques whose latest vertex is ``root``."""
        k, target = self.reduction, len(self.best)
        row = _unpack(self.rows[root], len(self.names))
        inside = np.flatnonzero(row[:root])
        if len(inside) < target:
            return
        rows = k.induced(self.rows, inside)
        order, core = k.degeneracy_order(rows)
        # Within the root problem a clique of `target` more is wanted: core >= target - 1.
        kept = np.ascontiguousarray(order[core[order] >= target - 1][::-1])
        if len(kept) < target:
            return
        rows, inside = k.induced(rows, kept), inside[kept]
        m, width = rows.shape
        deep = int(core.max()) + 3
        state = np.array([0, target - 1, 0, 0], np.int64)
        best = np.empty(m + 1, np.int64)
        work = (
            np.zeros((deep + 1, width), np.uint64),
            np.zeros((deep + 1, m), np.int64),
            np.zeros((deep + 1, m), np.int64),
            np.zeros(deep + 1, np.int64),
            np.zeros(deep + 1, np.int64),
            best,
            np.zeros((m + 2, width), np.uint64),
            np.zeros((2, width), np.uint64),
        )
        finished, visited = False, 0
        while not finished:
            finished = self.branching.branch(rows, state, *work, SLICE)
            if state[1] + 1 > len(self.best):
                self.best = self.names[np.append(inside[best[: state[1]]], root)]
            self.nodes_left -= int(state[2]) - visited
            visited = int(state[2])
            if not finished:
                self.check_budget()
        self.check_budget_after_root()

    def check_budget_after_root(self) -> None:
        """End the search as ``check_budget`` does, but not after a root that closed it."""
        if len(self.best) < self.upper:
            self.check_budget()


def _as_words(edge_bits: UInt32[np.ndarray, "n w"]) -> UInt64[np.ndarray, "n v"]:
    """Turn rows of 32-bit words into rows of 64-bit words: the same bits, lower half first."""
    little = np.zeros((len(edge_bits), edge_bits.shape[1] + edge_bits.shape[1] % 2), "<u4")
    little[:, : edge_bits.shape[1]] = edge_bits
    return little.view("<u8").astype(np.uint64, copy=False)  # the only copy: large graphs fill the memory


def _unpack(row: UInt64[np.ndarray, " v"], n: int) -> Bool[np.ndarray, " n"]:
    """Unpack a row of 64-bit words into a mask of n vertices."""
    little = row.astype("<u8", copy=False).view(np.uint8)
    return np.unpackbits(little, bitorder="little", count=n).astype(bool)


def load_kernels() -> bool:
    """Make the compiled loops ready; return False without numba. Say one line if they have to compile."""
    global _ready
    with _loading:
        if _ready:
            return True
        try:
            import numba  # noqa: F401
        except ImportError:
            log.warning("numba is not installed: hard cliques are searched by networkx, slowly")
            return False
        notice = threading.Timer(
            3.0, log.warning, ["compiling the clique search, once on this machine (about 10 s)"]
        )
        notice.daemon = True
        notice.start()
        try:
            # Later budgets time the search alone, because this one has run through every loop.
            nothing = Clique(np.zeros(10, bool), np.int32(10))
            _Search(two_pentagons(), nothing, nodes=10_000, seconds=float("inf")).run()
            _ready = True
        finally:
            notice.cancel()
        return True


def two_pentagons() -> UInt32[np.ndarray, "10 1"]:
    """Make a graph that no bound settles before the search branches: two pentagons, fully joined.

    Its largest cliques have 4 vertices, and it needs 6 colours.
    """
    ring = np.roll(np.eye(5, dtype=bool), 1, axis=1)
    pentagon, everything = ring | ring.T, np.ones((5, 5), bool)
    edges = np.block([[pentagon, everything], [everything, pentagon]])
    return (edges @ (1 << np.arange(10))).astype(np.uint32)[:, None]
