"""A cloud at one width of cells, with all that is asked of it more than once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from teaser_jax.clouds.extra import small_gicp
from teaser_jax.clouds.features.fpfh import Descriptors, fpfh
from teaser_jax.clouds.features.normals import across, oriented
from teaser_jax.clouds.neighbours import Neighbours, Tree
from teaser_jax.clouds.sizes import rows_for

NEIGHBOURS = 120  # of each point, for descriptors, of which those within the radius count
FEW_NEIGHBOURS = 40  # for normals alone
NORMAL_RADIUS, FEATURE_RADIUS = 2.5, 5.0  # in cells
COVARIANCE_NEIGHBOURS = 20
ROWS_OF_NORMALS = 4096


@dataclass(frozen=True, eq=False)
class Surface:
    """Points of a surface, one a cell.

    Attributes:
        points: About the middle of their cloud [length].
        voxel_size: Width of a cell [length].
        viewpoint: Where the sensor stood; None: unknown.
        threads: How many threads to ask neighbours with.
        quick: Whether normals may be rougher, those of the library of alignment, which it needs in any case.
    """

    points: Float[np.ndarray, "n 3"]
    voxel_size: float
    viewpoint: Float[np.ndarray, "3"] | None = None
    threads: int = 1
    quick: bool = False

    def __len__(self) -> int:
        return len(self.points)

    @cached_property
    def tree(self) -> Tree:
        """The points, to ask for the nearest."""
        return Tree(self.points, self.threads)

    @cached_property
    def normals(self) -> Float[np.ndarray, "n 3"]:
        """Unit normals, zero where the points make no surface."""
        if self.quick:
            return np.array(self.for_alignment[0].normals())[:, :3]
        return self._normals(self.tree.neighbours(self.points, FEW_NEIGHBOURS))

    @cached_property
    def descriptors(self) -> Descriptors:
        """What the surroundings of each point look like."""
        # One question serves both. What it finds is not kept: nothing else of a cloud is as large.
        neighbours = self.tree.neighbours(self.points, NEIGHBOURS)
        if "normals" not in self.__dict__:  # where cached_property keeps it
            self.__dict__["normals"] = self._normals(neighbours)
        orientation = "local" if self.viewpoint is None else "given"
        found = fpfh(*self._padded(neighbours), np.float32(FEATURE_RADIUS), orientation=orientation)
        return Descriptors(*(x[: len(self)] for x in jax.device_get(found)))

    @cached_property
    def for_alignment(self) -> Any:
        """The points with their covariances, and their tree, as the library of alignment holds them."""
        small_gicp().estimate_normals_covariances(*self.tree.held, COVARIANCE_NEIGHBOURS, self.threads)
        return self.tree.held

    def _normals(self, neighbours: Neighbours) -> Float[np.ndarray, "n 3"]:
        found = []
        for start in range(0, len(self), ROWS_OF_NORMALS):
            rows = slice(start, start + ROWS_OF_NORMALS)
            near = neighbours.squared[rows, :FEW_NEIGHBOURS]
            there = self.points[neighbours.rows[rows, :FEW_NEIGHBOURS]]
            apart = (there - self.points[rows, None]) / self.voxel_size
            missing = ROWS_OF_NORMALS - len(near)  # one program for clouds of any size
            apart = np.pad(apart.astype(np.float32), ((0, missing), (0, 0), (0, 0)))
            squared = np.pad((near / self.voxel_size**2).astype(np.float32), ((0, missing), (0, 0)))
            found.append(np.asarray(across(apart, squared, np.float32(NORMAL_RADIUS)))[: len(near)])
        return oriented(np.concatenate(found).astype(np.float64), self.points, self.viewpoint)

    def _padded(self, neighbours: Neighbours) -> tuple[Array, Array, Neighbours]:
        """Points, normals and neighbours in units of a cell, in as many rows as a program is compiled for."""
        n, rows = len(self), rows_for(len(self))
        points, normals = np.zeros((2, rows, 3), np.float32)
        points[:n], normals[:n] = self.points / self.voxel_size, self.normals
        index = np.zeros((rows, NEIGHBOURS), np.int32)
        squared = np.full((rows, NEIGHBOURS), np.inf, np.float32)
        index[:n], squared[:n] = neighbours.rows, neighbours.squared / self.voxel_size**2
        return jnp.asarray(points), jnp.asarray(normals), Neighbours(jnp.asarray(index), jnp.asarray(squared))
