"""Compiled loops that colour and branch: the exact clique search itself; rows of 64-bit words."""

from __future__ import annotations

import numpy as np

from teaser_jax.stages.clique.reduction import ONE, ZERO, compiled, count_bits, lowest_bit


@compiled
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
                conflicts += np.int64(count_bits(both))
                if conflicts > 1:
                    break
                q = 64 * w + np.int64(lowest_bit(both))
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


@compiled
def colour(candidates, rows, skip, order, colours, classes, uncoloured, available):
    """Colour the candidates greedily; list only vertices whose colour exceeds ``skip``.

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
                bit = lowest_bit(available[w])
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


@compiled
def root_bounds(rows, lower, bounds, last, budget):
    """Bound by colouring, for each root, the cliques whose latest vertex in the order is that root.

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
            size += np.int64(count_bits(candidates[w]))
        if size < lower:
            bounds[v] = min(size + 1, lower)
            continue
        listed, used, more = colour(
            candidates, rows, lower - 1, order, colours, classes, uncoloured, available
        )
        work += more
        bounds[v] = lower if listed == 0 else used + 1
    return n


@compiled
def branch(rows, state, candidates, order, colours, listed, path, best, classes, scratch, budget):
    """Search for a clique larger than ``state[1]`` by branch and bound; resumable.

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
