"""Exact maximum clique on the host, within a budget and with a proved bound at every moment.

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

import numpy as np

from teaser_jax.stages.clique import CUT

log = logging.getLogger("teaser_jax")

SLICE = 2_000_000  # word operations between two looks at the clock: one or two milliseconds
# A better clique before the edges are thinned saves more than it costs, the more so the more edges
# there are. Seeds are tried until so many in a row gave nothing larger: these, or the square of the
# edges in units of EDGES. On real graphs of 0.7, 1.6 and 2.8 million edges 8, 8 - 32 and 128 were best.
PATIENCE, EDGES = 8, 250_000
_ready = False
_loading = threading.Lock()


def search(
    edge_bits: np.ndarray,
    members: np.ndarray,
    upper: int,
    *,
    nodes: int = 100_000_000,
    seconds: float = 60.0,
) -> tuple[np.ndarray, int]:
    """The maximum clique of a packed graph, or the best found within the budget.

    Args:
        edge_bits: (n, w) uint32 rows, symmetric, no loops.
        members: (n,) a clique to start from; must be one.
        upper: A bound that is known already.
        nodes: Budget of search nodes.
        seconds: Budget of time; compiling the kernels is not counted.

    Returns:
        (n,) members of the best clique, and a proved bound on every clique: they are maximum if
        ``members.sum() == upper``.

    Where numba cannot be had, networkx searches instead, exactly but slowly and without budget.
    """
    if not load_kernels():
        from teaser_jax.stages.clique import Clique, search_on_host

        found = Clique(members, np.int32(upper))
        exact = search_on_host(edge_bits, members | np.any(edge_bits, axis=1), found, method="networkx")
        return exact.members, int(exact.upper_bound)
    return _Search(edge_bits, members, upper, nodes, seconds).run()


class _OutOfBudget(Exception):
    """Raised inside the search when time or nodes are spent; never leaves this module."""


class _Search:
    """One search. ``best`` (original numbers) and ``upper`` are valid at any moment."""

    def __init__(self, edge_bits, members, upper, nodes, seconds):
        # Not above: they import numba, which takes its time.
        from teaser_jax.stages import clique_branching, clique_reduction

        self.reduction, self.branching = clique_reduction, clique_branching
        self.deadline = time.perf_counter() + seconds
        self.nodes_left = nodes
        self.n = members.shape[0]
        self.best = np.flatnonzero(members).astype(np.int64)
        self.upper = max(int(upper), len(self.best))
        self.rows = _as_words(edge_bits)
        self.names = np.arange(self.n)  # original number of each vertex of `rows`

    def run(self) -> tuple[np.ndarray, int]:
        try:
            self.reduce()
            self.order_and_branch()
        except _OutOfBudget:
            pass  # best and upper say how far it came
        members = np.zeros(self.n, bool)
        members[self.best] = True
        return members, self.upper

    def check_budget(self) -> None:
        if time.perf_counter() >= self.deadline or self.nodes_left <= 0:
            raise _OutOfBudget

    def lower_upper(self, bound: int) -> bool:
        """Record a proved bound; True if it closes the search."""
        self.upper = max(len(self.best), min(self.upper, bound))
        return self.upper == len(self.best)

    def keep(self, chosen: np.ndarray) -> None:
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
        """Colours that do for the whole graph: half the bound of the cores, for next to nothing."""
        n, width = self.rows.shape
        everyone = np.zeros(64 * width, bool)
        everyone[:n] = True
        candidates = np.packbits(everyone, bitorder="little").view("<u8").astype(np.uint64)
        listed = np.empty((2, n + 1), np.int64)
        scratch, classes = np.empty((2, width), np.uint64), np.zeros((2, width), np.uint64)
        _, used, _ = self.branching.colour(candidates, self.rows, 0, *listed, classes, *scratch)
        return int(used)

    def grow(self, *, patience: float) -> bool:
        """Greedy cliques from vertices in no clique so far, until ``patience`` of them are no larger."""
        clique = np.empty(len(self.names) + 1, np.int64)
        covered = np.zeros(len(self.names), bool)
        improved, idle = False, 0
        for seed in range(len(self.names)):
            if covered[seed]:
                continue
            size = self.reduction.grow_clique(self.rows, seed, CUT, clique)
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
        degree = self.reduction.degrees(self.rows)
        removed, row = 0, len(self.names) - 1
        while row >= 0:
            gone, row = self.reduction.drop_weak_edges(self.rows, degree, len(self.best), row, SLICE)
            removed += gone
            self.check_budget()
        return removed

    def order_and_branch(self) -> None:
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
            self.branch_root(root)
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
        """A root that closed the search must not be reported as out of budget."""
        if len(self.best) < self.upper:
            self.check_budget()


def _as_words(edge_bits: np.ndarray) -> np.ndarray:
    """uint32 rows as uint64 rows: the same bits, lower half first."""
    bits = np.ascontiguousarray(edge_bits, np.uint32)
    bits = np.pad(bits, ((0, 0), (0, bits.shape[1] % 2)))
    low, high = bits[:, 0::2].astype(np.uint64), bits[:, 1::2].astype(np.uint64)
    return np.ascontiguousarray(low | (high << np.uint64(32)))


def _unpack(row: np.ndarray, n: int) -> np.ndarray:
    little = row.astype("<u8", copy=False).view(np.uint8)
    return np.unpackbits(little, bitorder="little", count=n).astype(bool)


def load_kernels() -> bool:
    """Make the compiled loops ready; False without numba. Says one line if it has to compile."""
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
            # Two triangles sharing an edge exercise every loop, so later budgets time the search.
            square = np.array([0b1110, 0b1101, 0b0011, 0b0011], np.uint64)[:, None]
            tiny = _Search(np.zeros((4, 1), np.uint32), np.zeros(4, bool), 4, 100, 60.0)
            tiny.rows = square
            tiny.best = np.zeros(1, np.int64)
            tiny.grow(patience=1)
            tiny.best = np.zeros(1, np.int64)
            tiny.peel()
            tiny.truss()
            tiny.order_and_branch()
            _ready = True
        finally:
            notice.cancel()
        return True
