"""Models from files: points, or triangles to sample points from."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Real

from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import FileError, or_file_error, os_errors_named
from teaser_jax.synthetic.models import Triangles


def read_shape(path: str | PathLike[str], *, kind: str | None = None) -> Real[np.ndarray, "m 3"] | Triangles:
    """Read points from ``.npy``, or points or triangles from what trimesh reads (PLY, OBJ, STL, OFF, ...).

    Args:
        path: The file. One with triangles gives ``Triangles``, from which any number of points can be drawn.
        kind: What it is, as in "ply"; None: what its name says.

    Raises:
        FileError: If the file is missing or broken or holds no points.
        ImportError: Without the extra ``clouds``, for anything but ``.npy``.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f"{path}: is a folder: name the file of a model in it.")
    if not path.is_file():
        raise FileError(f"{path}: no such file: give a model with triangles or points, or 'procedural'.")
    by_us = kind is None and path.suffix == ".npy"
    if not by_us:
        needed("trimesh", "reading models needs trimesh", "clouds")
    what = "cannot be read as a model"
    # What trimesh says of a broken file speaks of its own insides.
    advice = (
        f"{what}: it is broken, or no {path.suffix or 'file'} that trimesh reads; PLY, OBJ, STL and OFF are"
    )
    with os_errors_named(path, what):
        read = (lambda: _by_numpy(path)) if by_us else (lambda: _by_trimesh(path, kind))
        shape = or_file_error(path, what if by_us else advice, read, quoting=by_us)
    points = np.asarray(shape.vertices if isinstance(shape, Triangles) else shape)
    if len(points) == 0 and not by_us:
        raise FileError(f"{path}: {advice}.")
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu" or len(points) < 4:
        raise FileError(f"{path}: holds an array of shape {points.shape}: expected (m, 3) points.")
    if not np.isfinite(points).all():
        raise FileError(f"{path}: holds points that are not finite numbers.")
    return shape


def _by_numpy(path: Path) -> np.ndarray:
    return np.load(path, allow_pickle=False)


def _by_trimesh(path: Path, kind: str | None) -> np.ndarray | Triangles:
    import trimesh

    found: Any = trimesh.load(path, file_type=kind, process=False, skip_materials=True)
    if isinstance(found, trimesh.Scene):
        found = found.to_geometry()
    vertices, faces = np.asarray(found.vertices, np.float64), getattr(found, "faces", None)
    return vertices if faces is None or not len(faces) else Triangles(vertices, np.asarray(faces, np.int64))
