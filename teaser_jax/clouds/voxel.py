"""One point for each cell of a grid, and how wide the cells should be."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from teaser_jax.clouds.extra import small_gicp
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.ground.checks import check_positive

MOST_CELLS = 1 << 20  # along one axis, each way: what the library can number
ASKED = 2000  # points whose nearest neighbour tells how densely a cloud is sampled
NEAR_ENOUGH = 0.03  # of the number of cells that is wanted
ROUNDS = 12
LEAST_SPACINGS = 1.6  # of the sampling: cells finer than this hold one point each
POINTS_A_CELL = 3  # at the least, or normals mean nothing


def downsample(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Float[np.ndarray, "m 3"]:
    """Replace the points of each cell of a grid by their mean.

    Args:
        points: About their middle, at most a million cells away from it [length].
        voxel_size: Width of a cell [length].

    Raises:
        ValueError: If the width is not above 0, or so small that the cells cannot be numbered.
    """
    check_positive(voxel_size=voxel_size)
    if len(points) and np.abs(points).max() >= (MOST_CELLS - 1) * voxel_size:
        raise ValueError(
            f"voxel_size is {voxel_size:.3g} in a cloud that reaches {np.abs(points).max():.3g}: more than a "
            "million cells a side. Give a larger one, or leave it out."
        )
    # In units of a cell, as the library takes small widths for none at all.
    found = small_gicp().voxelgrid_sampling(points / voxel_size, 1.0)
    return voxel_size * np.array(found.points()[:, :3])


def cells_of(points: Float[np.ndarray, "n 3"], voxel_size: float) -> Int[np.ndarray, " n"]:
    """Number the cell of a grid that each point lies in."""
    cell = np.floor((points - points.min(axis=0)) / voxel_size).astype(np.int64)
    size = cell.max(axis=0) + 1
    return (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]


def count_cells(points: Float[np.ndarray, "n 3"], voxel_size: float) -> int:
    """Count the cells of a grid that hold points."""
    number = cells_of(points, voxel_size)
    number.sort()
    return 1 + int(np.count_nonzero(number[1:] != number[:-1]))


def spacing(tree: Tree) -> float:
    """Find the usual distance between a point and its nearest neighbour [length]; 0 of a single point."""
    points = tree.points
    if len(points) < 2:
        return 0.0
    some = points[:: max(1, len(points) // ASKED)]
    return float(np.sqrt(np.median(tree.neighbours(some, 2).squared[:, 1])))


def voxel_size_for(points: Float[np.ndarray, "n 3"], count: int) -> float:
    """Find the width of cells that leaves about ``count`` of them with points [length].

    The number of cells falls like a power of their width, so a line through the last two trials, both
    as logarithms, meets the wanted number after a few.
    """
    extent = float(np.ptp(points, axis=0).max())
    if extent == 0 or count <= 1:
        return extent if extent > 0 else 1.0
    low, high = extent / MOST_CELLS, 2 * extent  # too many cells; too few
    size, power, last = extent / np.sqrt(count), -2.0, None
    for _ in range(ROUNDS):
        cells = count_cells(points, size)
        if abs(cells - count) <= NEAR_ENOUGH * count:
            break
        low, high = (size, high) if cells > count else (low, size)
        if last is not None and cells != last[1]:
            power = np.log(cells / last[1]) / np.log(size / last[0])
        last = size, cells
        step = size * (count / cells) ** (1 / np.clip(power, -4, -0.5))
        size = step if low < step < high else float(np.sqrt(low * high))
    return float(size)
