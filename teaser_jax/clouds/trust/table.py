"""A cloud in a table: the nearest cell to any point is looked up, so that a device can do it for many poses.

The nodes of a grid around the surface stand one cell apart, and each knows the cell nearest to it. Of the
cells known to the eight nodes around a point, the nearest is taken.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.sizes import rows_for
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.space import PIXELS, RangeImage
from teaser_jax.ground.arrays import AnyArray

NODES_AROUND = 4  # cells: so far from a surface are nodes kept
MOST_NODES_ALONG = 1 << 10  # so that their numbers fit into 31 bits
NO_NODE = np.iinfo(np.int32).max


class Table(NamedTuple):
    """One cloud in cells about its middle, as a program takes it; lengths in cells.

    Attributes:
        points, normals: Of the cells; zero in rows without one.
        mask: Rows that hold a cell.
        nodes: The numbers of the nodes near the surface, in order.
        nearest: The cell that is nearest to each.
        low, shape: The first node, and how many there are along each axis.
        image: What its sensor saw; nothing, if it is not known where that stood.
        has_viewpoint: Whether that is known.
    """

    points: Float[AnyArray, "r 3"]
    normals: Float[AnyArray, "r 3"]
    mask: Bool[AnyArray, " r"]
    nodes: Int[AnyArray, " n"]
    nearest: Int[AnyArray, " n"]
    low: Float[AnyArray, "3"]
    shape: Int[AnyArray, "3"]
    image: RangeImage
    has_viewpoint: Bool[AnyArray, ""]


def table_of(surface: Surface, image: RangeImage | None = None) -> Table:
    """Write a surface as programs take it, with the nearest cell of each node around it.

    Args:
        surface: The cells [length].
        image: What the sensor of the cloud saw; None: it is not known where that stood.

    Raises:
        ValueError: If it is more than a thousand cells long.
    """
    unit = surface.voxel_size
    points = surface.points / unit
    low = np.floor(points.min(axis=0)) - NODES_AROUND
    shape = (np.ceil(points.max(axis=0)) + NODES_AROUND - low).astype(np.int64) + 1
    if shape.max() > MOST_NODES_ALONG:
        raise ValueError(
            f"a cloud is {shape.max()} cells long, and at most {MOST_NODES_ALONG} can be looked up: cut out "
            "what matters with crop, or give a larger voxel_size."
        )
    node = _nodes_around(np.floor(points - low).astype(np.int64), shape)
    middles = np.stack(np.unravel_index(node, shape), axis=1) + low
    nearest, _ = Tree(points, surface.threads).nearest(middles)
    nodes, rows = (rows_for(len(x)) for x in (node, points))
    fill = lambda x, size, value: np.concatenate([x, np.full((size - len(x), *x.shape[1:]), value, x.dtype)])
    eye, depth = np.zeros(3), np.full(PIXELS, np.inf)
    if image is not None:
        eye, depth = image.eye / unit, image.depth / unit
    return Table(
        points=fill(points.astype(np.float32), rows, 0),
        normals=fill(surface.normals.astype(np.float32), rows, 0),
        mask=np.arange(rows) < len(points),
        nodes=fill(node.astype(np.int32), nodes, NO_NODE),
        nearest=fill(nearest.astype(np.int32), nodes, 0),
        low=low.astype(np.float32),
        shape=shape.astype(np.int32),
        image=RangeImage(eye.astype(np.float32), depth.astype(np.float32)),
        has_viewpoint=np.array(image is not None),
    )


def _nodes_around(cells: Int[np.ndarray, "n 3"], shape: Int[np.ndarray, "3"]) -> Int[np.ndarray, " k"]:
    """Number the nodes around some cells, in order: one axis after the other, each node once."""
    number = np.unique(np.ravel_multi_index(tuple(cells.T), tuple(shape)))
    around = np.arange(-NODES_AROUND + 1, NODES_AROUND + 1)
    for step in (1, shape[2], shape[1] * shape[2]):
        number = np.unique(number[:, None] + step * around)
    return number


def nearest_cell(points: Float[Array, "n 3"], table: Table) -> tuple[Int[Array, " n"], Float[Array, " n"]]:
    """Find the nearest cell of a table, and how far it is [cells]; far away of most, infinity."""
    corner = jnp.floor(points - table.low[None]).astype(jnp.int32)
    steps = jnp.asarray(list(product((0, 1), repeat=3)), jnp.int32)
    node = corner[:, None] + steps[None]
    inside = jnp.all((node >= 0) & (node < table.shape[None, None]), axis=2)
    number = (node[..., 0] * table.shape[1] + node[..., 1]) * table.shape[2] + node[..., 2]
    row = jnp.minimum(jnp.searchsorted(table.nodes, number), len(table.nodes) - 1)
    known = inside & (table.nodes[row] == number)
    cell = table.nearest[row]
    squared = jnp.sum((points[:, None] - table.points[cell]) ** 2, axis=2)
    squared = jnp.where(known, squared, jnp.inf)
    best = jnp.argmin(squared, axis=1)[:, None]
    take = lambda x: jnp.take_along_axis(x, best, axis=1)[:, 0]
    distance = take(squared)
    # The slope of a root is infinite at 0.
    return take(cell), jnp.where(distance > 0, jnp.sqrt(jnp.where(distance > 0, distance, 1)), 0)
