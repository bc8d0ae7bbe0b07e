"""Clouds from LAS and LAZ, the files of airborne and mobile scanners."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.files.cloud_file import CloudFile, as_colours
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import FileError, check_room, check_unpacked, or_file_error

SHORTEST_HEADER, SHORTEST_RECORD = 227, 54  # bytes: of version 1.0; of a record before the points
SHORTEST_POINT = 20
PACKED = 0x80  # the bit of the kind of point that says so


def read_las(path: Path) -> CloudFile:
    """Read points, scaled and shifted in float64, with intensity, and colours if the kind of point has them.

    Raises:
        FileError: If it is broken, or holds no points.
        ImportError: If laspy is missing, or lazrs for LAZ.
    """
    laspy = needed("laspy", "LAS needs laspy", "clouds")
    if _check_header(path):
        needed("lazrs", "LAZ needs lazrs", "clouds")
    las = or_file_error(path, "is no LAS or LAZ file, or is broken", lambda: _read(laspy, path))
    names = set(las.point_format.dimension_names)
    coloured = {"red", "green", "blue"} <= names
    points = np.stack([np.asarray(axis, np.float64) for axis in (las.x, las.y, las.z)], axis=1)
    return CloudFile(
        points,
        as_colours(np.stack([las.red, las.green, las.blue], axis=1)) if coloured else None,
        np.asarray(las.intensity, np.float64),
    )


def _read(laspy: Any, path: Path) -> Any:
    with laspy.open(path, read_evlrs=False) as file:
        return file.read()


def _check_header(path: Path) -> bool:
    """Check what the header declares against the size of the file, and tell whether points are packed."""
    size = path.stat().st_size
    with path.open("rb") as file:
        start = file.read(375)
    if len(start) < SHORTEST_HEADER:
        raise FileError(f"{path}: ends within its header: it is cut off.")
    major, minor = start[24], start[25]
    first, records, kind, length, points = struct.unpack_from("<IIBHI", start, 96)
    if (major, minor) >= (1, 4) and len(start) == 375:
        (points,) = struct.unpack_from("<Q", start, 247)
    if points == 0:
        raise FileError(f"{path}: holds no points: its header declares none.")
    if length < SHORTEST_POINT:
        raise FileError(f"{path}: declares points of {length} bytes, and no kind of point is as short.")
    check_room(path, records, SHORTEST_RECORD, min(first, size), item="records")
    if kind & PACKED:
        check_unpacked(path, points * length, size - first)
        check_room(path, _chunks(path, first, size), SHORTEST_POINT, size - first, item="chunks")
    else:
        check_room(path, points, length, size - first)
    return bool(kind & PACKED)


def _chunks(path: Path, first: int, size: int) -> int:
    """Read how many chunks LAZ declares, each of which begins with a whole point."""
    with path.open("rb") as file:
        for place in (first, size - 8):  # what was written in one go has the place of the table at its end
            file.seek(place)
            table = int.from_bytes(file.read(8), "little", signed=True)
            if table >= 0:
                break
        if not first < table <= size - 8:
            raise FileError(f"{path}: has no table of its chunks: it is cut off.")
        file.seek(table + 4)
        return int.from_bytes(file.read(4), "little")
