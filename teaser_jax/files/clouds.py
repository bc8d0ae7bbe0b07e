"""Clouds from files of many kinds, and to PLY."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.files.cloud_file import CloudFile, as_colours
from teaser_jax.files.formats.arrays import read_mat, read_npy, read_npz
from teaser_jax.files.formats.bare import read_scan, read_text
from teaser_jax.files.formats.e57 import read_e57
from teaser_jax.files.formats.las import read_las
from teaser_jax.files.formats.meshes import read_mesh
from teaser_jax.files.formats.pcd import read_pcd
from teaser_jax.files.formats.ply import read_ply
from teaser_jax.files.kinds import SUFFIXES, kind_of
from teaser_jax.ground.io import FileError, or_file_error, os_errors_named, replacing
from teaser_jax.reading import real_numbers

READERS: dict[str, Callable[[Path], CloudFile]] = {
    "PLY": read_ply, "PCD": read_pcd, "text": read_text, "NPZ": read_npz, "NPY": read_npy, "MAT": read_mat,
    "KITTI": read_scan, "LAS": read_las, "E57": read_e57,
    **{kind: partial(read_mesh, kind=kind.lower()) for kind in ("STL", "OBJ", "OFF")},
}  # fmt: skip
LOUD = ("trimesh", "laspy")  # libraries that log what they find odd
ROUNDED = 1e-6  # of the extent of a cloud: what single precision may cost


def read_cloud(path: str | PathLike[str]) -> CloudFile:
    """Read a cloud; what begins as another kind of file than its name says is read as what it is.

    - ``.ply``: x, y, z of the vertices, red, green, blue and intensity, text or binary. Vertices are the
      cloud, unless the file is clearly a model: with fewer than 5000 of them, or with most of its
      surface in few large triangles, 100 000 points are drawn evenly from the triangles, always the same.
    - ``.pcd``: text, binary or compressed. Its viewpoint is not applied.
    - ``.txt``, ``.csv``, ``.tsv``, ``.dat``, ``.xyz``, ``.asc``, ``.pts``: x y z in the first three columns,
      or in columns with these names; named columns of colours and intensity are read, too.
    - ``.npz``: the array ``points``, or the only one of three columns or more; ``colours`` and ``intensity``
      beside it. ``.mat`` likewise. ``.npy``: an array of three columns or more, or records with x, y, z.
    - ``.bin``: scans of KITTI, x y z and reflectance in float32; ``.pcd.bin``: those of nuScenes.
    - ``.las``, ``.laz``: scaled and shifted in float64, with colours and intensity.
    - ``.e57``: all scans of the file, in its frame. The extra ``files`` brings its library.
    - ``.stl``, ``.obj``, ``.off``: points drawn from the triangles as above.

    Args:
        path: The file.

    Returns:
        The points as they stand in the file, NaN and zeros included; ``register`` leaves those out.

    Raises:
        FileError: If there is no such file, or it is broken, or holds no points. Sizes that a header declares
            are checked against the size of the file before anything is read.
        ImportError: If the library of its kind is missing, with the line that installs it.
    """
    path = Path(path)
    with os_errors_named(path, "cannot be read"):
        if path.is_dir():
            raise FileError(f"{path}: is a folder: name the file of a cloud in it.")
        if not path.exists():
            raise FileError(f"{path}: no such file: check the name.")
        if not path.is_file():
            raise FileError(f"{path}: is no ordinary file.")
        kind = kind_of(path)
        with _silence():
            what = f"is broken, or no {kind} file that can be read"
            cloud = or_file_error(path, what, lambda: READERS[kind](path))
    if len(cloud) == 0:
        raise FileError(f"{path}: holds no points.")
    if SUFFIXES.get(path.suffix.lower()) == kind:
        return cloud
    renamed = f"the extension '{path.suffix}' is ignored: the file begins as {kind} does"
    return replace(cloud, ignored=(*cloud.ignored, renamed))


@contextmanager
def _silence() -> Iterator[None]:
    """Keep libraries from writing to the terminal; who set up logging still receives what they log."""
    handler = logging.NullHandler()  # without any, Python prints warnings itself
    for name in LOUD:
        logging.getLogger(name).addHandler(handler)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for name in LOUD:
            logging.getLogger(name).removeHandler(handler)


def write_cloud(
    path: str | PathLike[str], points: Any, *, colours: Any = None, intensity: Any = None
) -> None:
    """Write a cloud as binary PLY, little-endian, which ``read_cloud`` and other programs read.

    Coordinates are single where that moves no point by more than a millionth of the extent of the cloud, and
    double otherwise. The file appears whole or not at all.

    Args:
        path: Where to, ending in .ply.
        points: (n, 3) [length].
        colours: (n, 3) red, green, blue, 0 to 255, or 0 to 1 in floating point.
        intensity: (n,).

    Raises:
        OSError: If it cannot be written.
        ValueError: If shapes do not fit, or the name ends otherwise; then no file changes.
    """
    path = Path(path)
    if path.suffix.lower() != ".ply":
        raise ValueError(f"{path}: clouds are written as PLY: give a name that ends in .ply.")
    xyz = np.asarray(real_numbers(points, "points"), np.float64)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise ValueError(f"points has shape {xyz.shape}: expected (n, 3), one point a row.")
    columns = [(axis, _precision(xyz), xyz[:, k]) for k, axis in enumerate("xyz")]
    if colours is not None:
        rgb = real_numbers(colours, "colours")
        _check_shape("colours", rgb, (len(xyz), 3))
        bytes_ = as_colours(rgb)
        columns += [(name, "<u1", bytes_[:, k]) for k, name in enumerate(("red", "green", "blue"))]
    if intensity is not None:
        bright = real_numbers(intensity, "intensity")
        _check_shape("intensity", bright, (len(xyz),))
        columns.append(("intensity", "<f4", bright))
    table = np.empty(len(xyz), np.dtype([(name, kind) for name, kind, _ in columns]))
    for name, _, values in columns:
        table[name] = values
    words = {"<f4": "float", "<f8": "double", "<u1": "uchar"}
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(xyz)}"]
    lines += [f"property {words[kind]} {name}" for name, kind, _ in columns]
    with replacing(path) as unfinished:
        unfinished.write_bytes("\n".join([*lines, "end_header\n"]).encode() + table.tobytes())


def _check_shape(name: str, array: Any, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}: expected {shape}, a row for each point.")


def _precision(points: Float[np.ndarray, "n 3"]) -> str:
    """Choose single or double precision for coordinates."""
    finite = points[np.isfinite(points).all(axis=1)]
    if len(finite) == 0:
        return "<f4"
    with np.errstate(over="ignore"):
        error = np.abs(finite.astype(np.float32) - finite).max()
    return "<f4" if error <= ROUNDED * np.ptp(finite, axis=0).max() else "<f8"
