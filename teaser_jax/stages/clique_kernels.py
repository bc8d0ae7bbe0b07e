"""Compiled loops of the exact clique search, on graphs packed as rows of 64-bit words.

Every loop that can run long takes a budget of *word operations* and says when it is spent, so that
the caller can look at the clock every few milliseconds. Kernels are compiled by numba on first
use and cached on disk. Importing this module imports numba.
"""

from __future__ import annotations

import numpy as np
from numba import njit, types
from numba.extending import intrinsic

ONE = np.uint64(1)
ZERO = np.uint64(0)
LOW6 = np.uint64(63)


@intrinsic
def _popcount(_, word):
    def emit(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), emit


@intrinsic
def _lowest(_, word):
    """Index of the lowest set bit of a nonzero word."""

    def emit(context, builder, signature, args):
        from llvmlite import ir

        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), emit


_compiled = njit(cache=True, nogil=True)


@_compiled
def degrees(rows):
    """Number of neighbours of each vertex."""
    n, width = rows.shape
    out = np.zeros(n, np.int64)
    for v in range(n):
        for w in range(width):
            out[v] += np.int64(_popcount(rows[v, w]))
    return out


@_compiled
def induced(rows, keep):
    """The subgraph on ``keep``, renumbered in that order."""
    m = len(keep)
    out = np.zeros((m, max((m + 63) >> 6, 1)), np.uint64)
    for i in range(m):
        row = rows[keep[i]]
        for j in range(m):
            v = np.uint64(keep[j])
            out[i, j >> 6] |= ((row[v >> np.uint64(6)] >> (v & LOW6)) & ONE) << np.uint64(j & 63)
    return out


@_compiled
def degeneracy_order(rows):
    """Vertices by repeated removal of the smallest degree, and their core numbers (Matula, Beck)."""
    n, width = rows.shape
    degree = degrees(rows)
    top = 0
    for v in range(n):
        top = max(top, degree[v])
    start = np.zeros(top + 2, np.int64)  # first position of each degree in `order`
    for v in range(n):
        start[degree[v] + 1] += 1
    for d in range(top + 1):
        start[d + 1] += start[d]
    order, position, fill = np.empty(n, np.int64), np.empty(n, np.int64), start.copy()
    for v in range(n):
        position[v] = fill[degree[v]]
        order[position[v]] = v
        fill[degree[v]] += 1
    removed = np.zeros(width, np.uint64)
    for i in range(n):
        v = order[i]
        removed[v >> 6] |= ONE << np.uint64(v & 63)
        for w in range(width):
            rest = rows[v, w] & ~removed[w]
            while rest != ZERO:
                u = 64 * w + np.int64(_lowest(rest))
                rest &= rest - ONE
                d = degree[u]
                if d > degree[v]:  # swap u with the first of its degree, then lower it
                    first = start[d]
                    other = order[first]
                    if other != u:
                        order[position[u]], order[first] = other, u
                        position[other], position[u] = position[u], first
                    start[d] += 1
                    degree[u] -= 1
    return order, degree


@_compiled
def grow_clique(rows, seed, share, clique):
    """A greedy clique through ``seed`` into ``clique``; returns its size.

    Starts from all neighbours and drops those that know fewest of the rest, the lowest ``share`` of
    the range of degrees at a time, until all know each other; then takes in whoever fits.
    """
    n, width = rows.shape
    m = 0
    for w in range(width):
        m += np.int64(_popcount(rows[seed, w]))
    vertices = np.empty(m, np.int64)
    m = 0
    for w in range(width):
        rest = rows[seed, w]
        while rest != ZERO:
            vertices[m] = 64 * w + np.int64(_lowest(rest))
            rest &= rest - ONE
            m += 1
    sub = induced(rows, vertices)
    short = sub.shape[1]
    inside, going = np.zeros(short, np.uint64), np.zeros(short, np.uint64)
    for i in range(m):
        inside[i >> 6] |= ONE << np.uint64(i & 63)
    degree, size = degrees(sub), m
    while size > 0:
        lowest, highest = size, -1
        for i in range(m):
            if (inside[i >> 6] >> np.uint64(i & 63)) & ONE:
                lowest, highest = min(lowest, degree[i]), max(highest, degree[i])
        if lowest >= size - 1:
            break
        cut = lowest + np.int64(share * (highest - lowest))
        alone = lowest == highest  # equals: one goes at a time
        going[:] = ZERO
        for i in range(m):
            if (inside[i >> 6] >> np.uint64(i & 63)) & ONE and degree[i] <= cut:
                going[i >> 6] |= ONE << np.uint64(i & 63)
                size -= 1
                if alone:
                    break
        for w in range(short):
            inside[w] &= ~going[w]
        for w in range(short):
            gone = going[w]
            while gone != ZERO:
                i = 64 * w + np.int64(_lowest(gone))
                gone &= gone - ONE
                for x in range(short):
                    left = sub[i, x] & inside[x]
                    while left != ZERO:
                        degree[64 * x + np.int64(_lowest(left))] -= 1
                        left &= left - ONE
    clique[0] = seed
    size = 1
    fitting = np.full(short, ~ZERO, np.uint64)
    for i in range(m):
        if (inside[i >> 6] >> np.uint64(i & 63)) & ONE:
            clique[size] = vertices[i]
            size += 1
            for w in range(short):
                fitting[w] &= sub[i, w]
    for i in range(m):
        known = (inside[i >> 6] >> np.uint64(i & 63)) & ONE
        if not known and (fitting[i >> 6] >> np.uint64(i & 63)) & ONE:
            clique[size] = vertices[i]
            size += 1
            for w in range(short):
                fitting[w] &= sub[i, w]
    return size


@_compiled
def peel(rows, degree, alive, least):
    """Drop vertices of fewer than ``least`` living neighbours, repeatedly; returns how many live."""
    n, width = rows.shape
    stack, height, living = np.empty(n, np.int64), 0, 0
    for v in range(n):
        if alive[v]:
            living += 1
            if degree[v] < least:
                alive[v] = False
                stack[height] = v
                height += 1
    while height > 0:
        height -= 1
        living -= 1
        v = stack[height]
        for w in range(width):
            rest = rows[v, w]
            while rest != ZERO:
                u = 64 * w + np.int64(_lowest(rest))
                rest &= rest - ONE
                if alive[u]:
                    degree[u] -= 1
                    if degree[u] < least:
                        alive[u] = False
                        stack[height] = u
                        height += 1
    return living


@_compiled
def drop_weak_edges(rows, degree, least, first, budget):
    """Remove edges with fewer than ``least - 1`` common neighbours: no clique of least + 1 has them.

    Works on the rows from ``first`` until the budget is spent.

    Returns:
        Edges removed, and the row to go on with (n when the pass is complete).
    """
    n, width = rows.shape
    removed, work = 0, 0
    for u in range(first, n):
        if work > budget:
            return removed, u
        for w in range(u >> 6, width):
            rest = rows[u, w]
            while rest != ZERO:
                v = 64 * w + np.int64(_lowest(rest))
                rest &= rest - ONE
                if v <= u:
                    continue
                common = 0
                if degree[u] >= least and degree[v] >= least:
                    for x in range(width):
                        common += np.int64(_popcount(rows[u, x] & rows[v, x]))
                    work += width
                if common < least - 1:
                    rows[u, w] &= ~(ONE << np.uint64(v & 63))
                    rows[v, u >> 6] &= ~(ONE << np.uint64(u & 63))
                    degree[u] -= 1
                    degree[v] -= 1
                    removed += 1
    return removed, n


@_compiled
def _recolour(rows, classes, v, skip):
    """Find v a place in a class up to ``skip`` by moving one vertex; returns (found, work).

    If v has a single neighbour q in one class and q has none in a later one, q moves there and v
    takes its place (the Re-NUMBER step of Tomita and Seki's MCS).
    """
    width = rows.shape[1]
    work = 0
    for k in range(1, skip):
        conflicts, q = 0, -1
        for w in range(width):
            both = classes[k, w] & rows[v, w]
            if both != ZERO:
                conflicts += np.int64(_popcount(both))
                if conflicts > 1:
                    break
                q = 64 * w + np.int64(_lowest(both))
        work += width
        if conflicts == 0:
            classes[k, v >> 6] |= ONE << np.uint64(v & 63)
            return True, work
        if conflicts == 1:
            for other in range(k + 1, skip + 1):
                free = True
                for w in range(width):
                    if classes[other, w] & rows[q, w] != ZERO:
                        free = False
                        break
                work += width
                if free:
                    classes[k, q >> 6] &= ~(ONE << np.uint64(q & 63))
                    classes[other, q >> 6] |= ONE << np.uint64(q & 63)
                    classes[k, v >> 6] |= ONE << np.uint64(v & 63)
                    return True, work
    return False, work


@_compiled
def colour(candidates, rows, skip, order, colours, classes, uncoloured, available):
    """Greedy colouring; lists only vertices whose colour exceeds ``skip``.

    A clique has at most one vertex of each colour, so only listed vertices can extend a clique by
    more than ``skip``.

    Returns:
        How many vertices are listed in ``order`` with their ``colours``, the number of colours
        used, and the work done.
    """
    width = rows.shape[1]
    listed, k, work = 0, 0, 0
    left = False
    for w in range(width):
        uncoloured[w] = candidates[w]
        left = left or candidates[w] != ZERO
    while left:
        k += 1
        for w in range(width):
            available[w] = uncoloured[w]
            if k <= skip:
                classes[k, w] = ZERO
        for w in range(width):
            while available[w] != ZERO:
                bit = _lowest(available[w])
                v = 64 * w + np.int64(bit)
                available[w] &= available[w] - ONE
                uncoloured[w] &= ~(ONE << bit)
                for x in range(w, width):
                    available[x] &= ~rows[v, x]
                work += width - w
                if k <= skip:
                    classes[k, w] |= ONE << bit
                else:
                    placed, more = _recolour(rows, classes, v, skip)
                    work += more
                    if not placed:
                        order[listed], colours[listed] = v, k
                        listed += 1
        left = False
        for w in range(width):
            if uncoloured[w] != ZERO:
                left = True
                break
    return listed, k, work


@_compiled
def root_bounds(rows, lower, bounds, last, budget):
    """Colouring bound of each root: cliques whose latest vertex in the order is that root.

    Vertices come with the largest cores first. A root that cannot beat ``lower`` gets ``lower``.
    Works from vertex 0 upwards, starting at ``last``; returns the vertex to go on with.
    """
    n, width = rows.shape
    candidates, uncoloured, available = (
        np.empty(width, np.uint64), np.empty(width, np.uint64), np.empty(width, np.uint64),
    )  # fmt: skip
    classes = np.zeros((lower + 2, width), np.uint64)
    order, colours = np.empty(n, np.int64), np.empty(n, np.int64)
    work = 0
    for v in range(last, n):
        if work > budget:
            return v
        size = 0
        for w in range(width):
            earlier = ZERO
            if w < v >> 6:
                earlier = ~ZERO
            elif w == v >> 6:
                earlier = (ONE << np.uint64(v & 63)) - ONE
            candidates[w] = rows[v, w] & earlier
            size += np.int64(_popcount(candidates[w]))
        if size < lower:
            bounds[v] = min(size + 1, lower)
            continue
        listed, used, more = colour(
            candidates, rows, lower - 1, order, colours, classes, uncoloured, available
        )
        work += more
        bounds[v] = lower if listed == 0 else used + 1
    return n


@_compiled
def branch(rows, state, candidates, order, colours, listed, path, best, classes, scratch, budget):
    """Branch and bound for a clique larger than ``state[1]``; resumable.

    ``state`` holds depth, size of the best clique, nodes visited, and whether the search began.
    ``best`` receives the members of every improvement.

    Returns:
        True when the tree is exhausted, False when the budget of word operations is.
    """
    n, width = rows.shape
    depth, lower, work = state[0], state[1], 0
    if state[3] == 0:
        state[3] = 1
        for w in range(width):
            candidates[0, w] = ZERO
        for v in range(n):
            candidates[0, v >> 6] |= ONE << np.uint64(v & 63)
        listed[0], _, work = colour(
            candidates[0], rows, lower, order[0], colours[0], classes, scratch[0], scratch[1]
        )
    while depth >= 0:
        last = listed[depth] - 1
        if last < 0 or depth + colours[depth, last] <= lower:
            depth -= 1
            continue
        if work > budget:
            state[0], state[1] = depth, lower
            return False
        state[2] += 1
        listed[depth] = last
        v = order[depth, last]
        path[depth] = v
        candidates[depth, v >> 6] &= ~(ONE << np.uint64(v & 63))
        empty = True
        for w in range(width):
            candidates[depth + 1, w] = candidates[depth, w] & rows[v, w]
            empty = empty and candidates[depth + 1, w] == ZERO
        work += width
        if empty:
            if depth + 1 > lower:
                lower = depth + 1
                for i in range(lower):
                    best[i] = path[i]
            continue
        listed[depth + 1], _, more = colour(
            candidates[depth + 1], rows, max(lower - depth - 1, 0), order[depth + 1],
            colours[depth + 1], classes, scratch[0], scratch[1],
        )  # fmt: skip
        work += more
        if listed[depth + 1] > 0:
            depth += 1
    state[0], state[1] = -1, lower
    return True
