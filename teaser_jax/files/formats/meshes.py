"""Clouds from meshes: points are drawn evenly from triangles, and are always the same ones."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from teaser_jax.files.cloud_file import CloudFile
from teaser_jax.files.models import read_shape
from teaser_jax.ground.io import FileError
from teaser_jax.synthetic.models import Triangles, sample_triangles

DRAWN = 100_000  # points
SEED = 0
FEWEST_VERTICES = 5000  # that can stand for a surface
EVEN = 0.1  # the share of triangles that would have the surface of all, were all as large as the large ones


def read_mesh(path: Path, kind: str) -> CloudFile:
    """Draw points from the triangles of a mesh; a file without triangles is a cloud of its vertices.

    Raises:
        FileError: If it cannot be read, or holds neither.
        ImportError: If trimesh is missing.
    """
    shape = read_shape(path, kind=kind)
    return sampled(path, shape) if isinstance(shape, Triangles) else CloudFile(shape.astype(np.float64))


def sampled(path: Path, shape: Triangles) -> CloudFile:
    """Draw points evenly from triangles. Raises FileError if these have no area."""
    if not area_of(shape).sum() > 0:
        raise FileError(f"{path}: its triangles have no area.")
    points = sample_triangles(np.random.default_rng(SEED), DRAWN, shape)
    return CloudFile(points, triangles=len(shape.faces))


def is_a_model(shape: Triangles) -> bool:
    """Tell whether the vertices of a mesh are too few, or too unevenly spread, to stand for its surface."""
    area = area_of(shape)
    if len(shape.vertices) < FEWEST_VERTICES:
        return True
    return bool(area.sum() ** 2 < EVEN * len(area) * np.sum(area**2))


def area_of(shape: Triangles) -> np.ndarray:
    """Measure each triangle [length^2]."""
    a, b, c = np.moveaxis(shape.vertices[shape.faces], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
