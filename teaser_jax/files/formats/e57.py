"""Clouds from E57, the exchange files of terrestrial scanners. All scans of a file make one cloud."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.files.cloud_file import CloudFile, as_colours
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import FileError, check_room, check_unpacked, or_file_error

POINT = 24  # bytes, unpacked
CHANNELS = ("colorRed", "colorGreen", "colorBlue")


def read_e57(path: Path) -> CloudFile:
    """Read all scans, each moved by its pose into the frame of the file; points marked invalid are left out.

    Raises:
        FileError: If it is broken, or holds no points.
        ImportError: If pye57 is missing.
    """
    pye57 = needed("pye57", "E57 needs pye57", "files")
    _check_length(path)
    return or_file_error(path, "is no E57 file, or is broken", lambda: _read(pye57, path))


def _check_length(path: Path) -> None:
    """Raise FileError unless the file is as long as its header says."""
    with path.open("rb") as file:
        start = file.read(48)
    if len(start) < 48:
        raise FileError(f"{path}: ends within its header: it is cut off.")
    declared = int.from_bytes(start[16:24], "little")
    check_room(path, declared, 1, path.stat().st_size, item="bytes")


def _read(pye57: Any, path: Path) -> CloudFile:
    with pye57.E57(str(path)) as file:
        headers = [file.get_header(k) for k in range(file.scan_count)]
        declared = sum(header.point_count for header in headers)
        if declared == 0:
            raise FileError(f"{path}: holds no points, in {len(headers)} scans.")
        check_unpacked(path, POINT * declared, path.stat().st_size)
        # A scan without them would leave rows without an intensity or a colour.
        fields_of = [set(header.point_fields) for header in headers]
        fields = set.intersection(*fields_of)
        bright, coloured = "intensity" in fields, set(CHANNELS) <= fields
        try:
            scans = _scans(file, headers, bright, coloured)
        except pye57.libe57.E57Exception:
            # Colours of 16 bits are no bytes, and pye57 reads only those. What else is wrong comes again.
            scans, coloured = _scans(file, headers, bright, False), False
    points = _stacked(scans, [f"cartesian{axis}" for axis in "XYZ"])
    lost = declared - len(points)
    any_colour = any("colorRed" in names for names in fields_of)
    ignored = [f"not read: {lost} point(s) marked invalid"] if lost else []
    if any_colour and not coloured:
        ignored.append("not read: colours, which not all scans have as bytes")
    return CloudFile(
        points,
        as_colours(_stacked(scans, CHANNELS)) if coloured else None,
        _stacked(scans, ["intensity"])[:, 0] if bright else None,
        tuple(ignored),
    )


def _scans(file: Any, headers: list[Any], bright: bool, coloured: bool) -> list[dict[str, np.ndarray]]:
    return [
        file.read_scan(k, intensity=bright, colors=coloured, ignore_missing_fields=True)
        for k, header in enumerate(headers)
        if header.point_count
    ]


def _stacked(scans: list[dict[str, np.ndarray]], names: Sequence[str]) -> Float[np.ndarray, "n k"]:
    """Take columns of all scans, one below the other."""
    blocks = [np.stack([scan[name] for name in names], axis=1) for scan in scans]
    return np.concatenate(blocks).astype(np.float64)
