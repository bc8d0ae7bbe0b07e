"""How far the nearest point of a cloud is from anywhere near it, looked up instead of searched for."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, UInt8

from teaser_jax.clouds.neighbours import Tree
from teaser_jax.ground.arrays import AnyArray

# A box of the cloud and a margin as wide as the distances that count: the number of voxels is largest for a
# cube, 62 a side, and a program for so many serves all clouds. Bytes of distance then stay in a cache.
VOXELS_ALONG = 76  # of the diagonal of the cloud's box
REACH = 7.6  # voxels: a tenth of the diagonal; further away is as good as nowhere
LEVELS = 255  # of distance, up to the reach
CAPACITY = 62**3


class Field(NamedTuple):
    """Distances from a cloud on a grid of voxels, with the nearest point of each.

    Attributes:
        level: The distance of each voxel's middle, ``LEVELS`` standing for the reach or more [-].
        nearest: Which point of the cloud is the nearest one.
        shape: How many voxels there are along each axis; at the sides they are out of reach.
        low: The lower corner of the grid [length].
        width: Of a voxel [length].
    """

    level: UInt8[AnyArray, "capacity"]
    nearest: Int[AnyArray, "capacity"]
    shape: Int[AnyArray, "3"]
    low: Float[AnyArray, "3"]
    width: Float[AnyArray, ""]


def field_of(tree: Tree) -> Field:
    """Measure the field of a cloud.

    Raises:
        ValueError: If all points are one.
    """
    low, high = tree.points.min(axis=0), tree.points.max(axis=0)
    diagonal = float(np.linalg.norm(high - low))
    if not diagonal > 0:
        raise ValueError("All points are the same: they have no shape.")
    width = diagonal / VOXELS_ALONG
    reach = REACH * width
    low = low - reach
    shape = np.floor((high + reach - low) / width).astype(np.int32) + 1
    axes = [low[k] + width * (np.arange(shape[k]) + 0.5) for k in range(3)]
    middles = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    nearest, distance = tree.nearest(middles)
    level = np.full(CAPACITY, LEVELS, np.uint8)
    rows = np.zeros(CAPACITY, np.int32)
    level[: len(middles)] = np.rint(np.minimum(distance / reach, 1) * LEVELS)
    rows[: len(middles)] = nearest
    return Field(level, rows, shape, low.astype(np.float32), np.float32(width))


def voxel_of(field: Field, points: Float[Array, "*k 3"]) -> Int[Array, "*k"]:
    """Find the number of the voxel in which each point lies; outside of the grid, the one at its side."""
    x, y, z = (
        jnp.clip(
            jnp.floor((points[..., k] - field.low[k]) / field.width).astype(jnp.int32), 0, field.shape[k] - 1
        )
        for k in range(3)
    )
    return (x * field.shape[1] + y) * field.shape[2] + z


def distances(field: Field, points: Float[Array, "*k 3"]) -> Float[Array, "*k"]:
    """Look up how far the cloud is, at most the reach [length]."""
    unit = field.width * np.float32(REACH / LEVELS)
    return field.level[voxel_of(field, points)].astype(jnp.float32) * unit
