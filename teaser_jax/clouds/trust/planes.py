"""How much of an overlap is more than a few large planes: corners of rooms fit one another all too well."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

PLANES = 5  # floor, ceiling and three walls: what a camera sees of a room or a corridor
TRIED = 100  # cells whose tangent planes are tried
THICK, ALIGNED = 1.0, 0.7  # cells on either side that belong to a plane; cosine to their normals
ROUNDS = 3  # in which a plane is fitted to what it holds
LEAST = 0.02  # of the cells: less is no large plane


def beyond_planes(points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], cell: float) -> float:
    """Tell which share of cells lies off the five largest planes through them [-].

    Args:
        points: One a cell [length].
        normals: Unit vectors.
        cell: Width of a cell [length].
    """
    left = np.ones(len(points), bool)
    for _ in range(PLANES):
        held = _largest(points[left], normals[left], THICK * cell)
        if np.count_nonzero(held) < LEAST * len(points):
            break
        left[np.flatnonzero(left)[held]] = False
    return float(np.mean(left)) if len(left) else 0.0


def _largest(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"], thick: float
) -> Bool[np.ndarray, " n"]:
    """Find the cells of the plane that holds most of them."""
    some = slice(None, None, max(1, len(points) // TRIED))
    height = points @ normals[some].T - np.sum(points[some] * normals[some], axis=1)
    along = np.abs(normals @ normals[some].T) > ALIGNED
    held = (np.abs(height) < thick) & along
    if held.size == 0:
        return np.zeros(len(points), bool)
    best = held[:, np.argmax(np.count_nonzero(held, axis=0))]
    for _ in range(ROUNDS):
        if np.count_nonzero(best) < 3:
            return best
        middle = points[best].mean(axis=0)
        normal = np.linalg.svd(points[best] - middle, full_matrices=False)[2][-1]
        best = (np.abs((points - middle) @ normal) < thick) & (np.abs(normals @ normal) > ALIGNED)
    return best
