"""The sizes that programs are compiled for: few, so that nothing compiles anew for every cloud."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

# A little above the 3 000, 6 000 and 12 000 cells that clouds are cut into.
LEAST_ROWS = 3328


def rows_for(count: int) -> int:
    """Find the number of rows that a program for ``count`` points is compiled for."""
    rows = LEAST_ROWS
    while rows < count:
        rows *= 2
    return rows


def padded(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "r 3"], Bool[np.ndarray, " r"]]:
    """Fill up points with rows of zeros, as single-precision numbers, and tell which rows hold one."""
    rows = np.zeros((rows_for(len(points)), 3), np.float32)
    rows[: len(points)] = points
    return rows, np.arange(len(rows)) < len(points)
