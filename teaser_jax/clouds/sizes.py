"""The sizes that programs are compiled for: few, so that nothing compiles anew for every cloud."""

from __future__ import annotations

# A little above the 3 000, 6 000 and 12 000 cells that clouds are cut into.
LEAST_ROWS = 3328


def rows_for(count: int) -> int:
    """Find the number of rows that a program for ``count`` points is compiled for."""
    rows = LEAST_ROWS
    while rows < count:
        rows *= 2
    return rows
