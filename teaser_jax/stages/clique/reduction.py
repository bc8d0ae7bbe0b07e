"""Compiled loops that shrink a graph before the exact clique search; rows of 64-bit words.

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
def count_bits(_, word):
    """Count the set bits of a word."""

    def emit(context, builder, signature, args):
        return builder.ctpop(args[0])

    return types.uint64(types.uint64), emit


@intrinsic
def lowest_bit(_, word):
    """Find the index of the lowest set bit of a nonzero word."""

    def emit(context, builder, signature, args):
        from llvmlite import ir

        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 0))

    return types.uint64(types.uint64), emit


compiled = njit(cache=True, nogil=True)


@compiled
def degrees(rows):
    """Count the neighbours of each vertex."""
    n, width = rows.shape
    out = np.zeros(n, np.int64)
    for v in range(n):
        for w in range(width):
            out[v] += np.int64(count_bits(rows[v, w]))
    return out


@compiled
def induced(rows, keep):
    """Make the subgraph on ``keep``, renumbered in that order."""
    m, (n, width) = len(keep), rows.shape
    out = np.zeros((m, max((m + 63) >> 6, 1)), np.uint64)
    place, kept = np.empty(n, np.int64), np.zeros(width, np.uint64)
    for i in range(m):
        place[keep[i]] = i
        kept[keep[i] >> 6] |= ONE << np.uint64(keep[i] & 63)
    for i in range(m):
        for w in range(width):
            rest = rows[keep[i], w] & kept[w]
            while rest != ZERO:
                j = place[64 * w + np.int64(lowest_bit(rest))]
                rest &= rest - ONE
                out[i, j >> 6] |= ONE << np.uint64(j & 63)
    return out


@compiled
def degeneracy_order(rows):
    """Order vertices by repeated removal of the smallest degree; find their core numbers (Matula, Beck)."""
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
                u = 64 * w + np.int64(lowest_bit(rest))
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


@compiled
def neighbours(rows, vertex):
    """List the neighbours of a vertex, in order."""
    width = rows.shape[1]
    m = 0
    for w in range(width):
        m += np.int64(count_bits(rows[vertex, w]))
    vertices = np.empty(m, np.int64)
    m = 0
    for w in range(width):
        rest = rows[vertex, w]
        while rest != ZERO:
            vertices[m] = 64 * w + np.int64(lowest_bit(rest))
            rest &= rest - ONE
            m += 1
    return vertices


@compiled
def drop_strangers(rows, share, inside):
    """Take vertices that know fewest of the rest out of ``inside`` until all know each other.

    The lowest ``share`` of the range of degrees goes at a time; of equals, one.
    """
    m, width = rows.shape
    going = np.zeros(width, np.uint64)
    degree, size = degrees(rows), m
    while size > 0:
        lowest, highest = size, -1
        for i in range(m):
            if (inside[i >> 6] >> np.uint64(i & 63)) & ONE:
                lowest, highest = min(lowest, degree[i]), max(highest, degree[i])
        if lowest >= size - 1:
            break
        cut = lowest + np.int64(share * (highest - lowest))
        alone = lowest == highest
        going[:] = ZERO
        for i in range(m):
            if (inside[i >> 6] >> np.uint64(i & 63)) & ONE and degree[i] <= cut:
                going[i >> 6] |= ONE << np.uint64(i & 63)
                size -= 1
                if alone:
                    break
        for w in range(width):
            inside[w] &= ~going[w]
        for w in range(width):
            gone = going[w]
            while gone != ZERO:
                i = 64 * w + np.int64(lowest_bit(gone))
                gone &= gone - ONE
                for x in range(width):
                    left = rows[i, x] & inside[x]
                    while left != ZERO:
                        degree[64 * x + np.int64(lowest_bit(left))] -= 1
                        left &= left - ONE


@compiled
def grow_clique(rows, seed, share, clique):
    """Grow a greedy clique through ``seed`` into ``clique``; return its size.

    Starts from all neighbours, drops those that know fewest of the rest until all know each other, then takes
    in whoever fits.
    """
    vertices = neighbours(rows, seed)
    sub, m = induced(rows, vertices), len(vertices)
    width = sub.shape[1]
    inside = np.zeros(width, np.uint64)
    for i in range(m):
        inside[i >> 6] |= ONE << np.uint64(i & 63)
    drop_strangers(sub, share, inside)
    clique[0] = seed
    size = 1
    fitting = np.full(width, ~ZERO, np.uint64)
    for i in range(m):
        if (inside[i >> 6] >> np.uint64(i & 63)) & ONE:
            clique[size] = vertices[i]
            size += 1
            for w in range(width):
                fitting[w] &= sub[i, w]
    for i in range(m):
        known = (inside[i >> 6] >> np.uint64(i & 63)) & ONE
        if not known and (fitting[i >> 6] >> np.uint64(i & 63)) & ONE:
            clique[size] = vertices[i]
            size += 1
            for w in range(width):
                fitting[w] &= sub[i, w]
    return size


@compiled
def peel(rows, degree, alive, least):
    """Drop vertices of fewer than ``least`` living neighbours, repeatedly; return how many live."""
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
                u = 64 * w + np.int64(lowest_bit(rest))
                rest &= rest - ONE
                if alive[u]:
                    degree[u] -= 1
                    if degree[u] < least:
                        alive[u] = False
                        stack[height] = u
                        height += 1
    return living


@compiled
def drop_weak_edges(rows, degree, least, last, budget):
    """Remove edges with fewer than ``least - 1`` common neighbours: no clique of least + 1 has them.

    Works on the rows from ``last`` down to 0 until the budget is spent: vertices come with the largest
    cores first, and what the small ones lose, the large ones need not be asked for.

    Returns:
        Edges removed, and the row to go on with (-1 when the pass is complete).
    """
    width = rows.shape[1]
    removed, work = 0, 0
    for u in range(last, -1, -1):
        if work > budget:
            return removed, u
        for w in range((u >> 6) + 1):
            rest = rows[u, w]
            while rest != ZERO:
                v = 64 * w + np.int64(lowest_bit(rest))
                rest &= rest - ONE
                if v >= u:
                    break
                common = 0
                if degree[u] >= least and degree[v] >= least:
                    for x in range(width):
                        common += np.int64(count_bits(rows[u, x] & rows[v, x]))
                    work += width
                if common < least - 1:
                    rows[u, w] &= ~(ONE << np.uint64(v & 63))
                    rows[v, u >> 6] &= ~(ONE << np.uint64(u & 63))
                    degree[u] -= 1
                    degree[v] -= 1
                    removed += 1
    return removed, -1
