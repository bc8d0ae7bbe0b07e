"""Clouds from archives and arrays: NPZ, NPY and Matlab."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from math import prod
from pathlib import Path

import numpy as np

from teaser_jax.files.cloud_file import CloudFile, as_colours, from_columns, not_read
from teaser_jax.ground.io import FileError, check_unpacked, or_file_error, read_archive, visible

POINTS = "points"
COLOURS, INTENSITY = ("colours", "colors", "rgb"), ("intensity", "intensities")
SMALLEST = 5  # rows of an array that is taken for points by its shape: poses have up to four


def read_npz(path: Path) -> CloudFile:
    """Read the array ``points`` of an archive, or the only one that can be points.

    Arrays ``colours`` (or ``colors``, ``rgb``) and ``intensity`` of as many rows are read, too.

    Raises:
        FileError: If it is broken, or holds no points, or several arrays that might be.
    """
    arrays, _ = read_archive(path)
    return _among(path, arrays, "numpy.savez(path, points=points)")


def read_npy(path: Path) -> CloudFile:
    """Read an array of three columns or more, or of records with fields x, y, z.

    Raises:
        FileError: If it is broken, or something else.
    """
    # A map of the file takes no memory, whatever the header declares, and fails if it declares too much.
    array = or_file_error(
        path, "is no .npy array, or is broken", lambda: np.load(path, mmap_mode="r", allow_pickle=False)
    )
    return _from_array(path, np.asarray(array))


def read_mat(path: Path) -> CloudFile:
    """Read the matrix ``points`` of a Matlab file, or the only one that can be points.

    Raises:
        FileError: If it is broken, or of version 7.3, or holds no points, or several matrices that might be.
    """
    with path.open("rb") as file:
        start = file.read(128)
    if b"MATLAB 7.3" in start or start.startswith(b"\x89HDF"):
        raise FileError(
            f"{path}: is of Matlab 7.3: save it there once more with save('{path.name}', 'points', '-v7')."
        )
    from scipy.io import loadmat, whosmat

    what = "is no Matlab file, or is broken"
    listed = or_file_error(path, what, lambda: whosmat(path))
    names = [
        name for name, shape, kind in listed if len(shape) == 2 and kind not in ("char", "cell", "struct")
    ]
    for name, shape, _ in listed:
        if name in names:
            check_unpacked(path, 8 * prod(int(n) for n in shape), path.stat().st_size)
    arrays = or_file_error(path, what, lambda: loadmat(path, variable_names=names)) if names else {}
    found = {name: np.asarray(arrays[name]) for name in names if name in arrays}
    others = {name: np.empty(0) for name, _, _ in listed if name not in found}
    return _among(path, found | others, f"save('{path.name}', 'points', '-v7')")


def _among(path: Path, arrays: Mapping[str, np.ndarray], advice: str) -> CloudFile:
    """Choose the points, the colours and the intensity among arrays with names."""
    chosen = [POINTS] if POINTS in arrays else [n for n, array in arrays.items() if _fits(array, SMALLEST)]
    extra = [name for name in chosen if name.lower() in COLOURS]
    if len(chosen) > 1 and len(chosen) - len(extra) == 1:
        chosen = [name for name in chosen if name not in extra]
    if len(chosen) != 1:
        found = visible(", ".join(f"{n} {a.shape}" for n, a in sorted(arrays.items())), 160) or "nothing"
        many = "several arrays that may be points" if chosen else "no array of three columns or more"
        raise FileError(f"{path}: holds {many} (found: {found}): save one as 'points', with {advice}.")
    name = chosen[0]
    cloud = _from_array(path, arrays[name])
    colours, c = _beside(arrays, COLOURS, (len(cloud), 3))
    intensity, i = _beside(arrays, INTENSITY, (len(cloud),))
    return replace(
        cloud,
        colours=cloud.colours if colours is None else as_colours(colours),
        intensity=cloud.intensity if intensity is None else intensity.astype(np.float64),
        ignored=(*cloud.ignored, *not_read(n for n in arrays if n not in (name, c, i))),
    )


def _beside(
    arrays: Mapping[str, np.ndarray], names: Collection[str], shape: tuple[int, ...]
) -> tuple[np.ndarray | None, str | None]:
    """Find an array by one of its names that has a row for each point."""
    for name, array in arrays.items():
        flat = array.reshape(-1) if len(shape) == 1 else array  # columns of Matlab
        if name.lower() in names and flat.shape == shape and flat.dtype.kind in "fiu":
            return flat, name
    return None, None


def _fits(array: np.ndarray, rows: int = 1) -> bool:
    if array.dtype.names:
        return set("xyz") <= {name.lower() for name in array.dtype.names}
    shaped = array.ndim == 2 and array.shape[1] >= 3 and len(array) >= rows and not _is_turned(array)
    return shaped and array.dtype.kind in "fiu"


def _is_turned(array: np.ndarray) -> bool:
    """Tell whether columns are points: there are far more of them than of coordinates."""
    return array.ndim == 2 and len(array) in (3, 4) and array.shape[1] > 6


def _from_array(path: Path, array: np.ndarray) -> CloudFile:
    if array.dtype.names:
        flat = array.reshape(-1)
        return from_columns(path, {name: flat[name] for name in array.dtype.names})
    if not _fits(array):
        advice = "save its transpose" if _is_turned(array) else "expected (n, 3), a point a row"
        raise FileError(f"{path}: holds an array of shape {array.shape} of {array.dtype}: {advice}.")
    more = array.shape[1] - 3
    ignored = (f"not read: the {more} column(s) behind x, y, z",) if more else ()
    return CloudFile(np.array(array[:, :3], np.float64), ignored=ignored)
