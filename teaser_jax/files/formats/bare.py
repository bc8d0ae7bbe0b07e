"""Clouds from files without a header: tables of text, and the scans of KITTI."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from teaser_jax.files.cloud_file import CloudFile, from_columns, not_read, wanted_columns
from teaser_jax.files.tables import Layout, read_table
from teaser_jax.ground.io import FileError

ROWS = Layout("point", "at least three numbers", "at least three, x y z", 3)
FURTHEST = 1e7  # of a coordinate; sensors see 500 m
MOST_BEYOND = 0.01  # of the numbers


def read_text(path: Path) -> CloudFile:
    """Read a table of text, x y z a row; named columns may stand anywhere and hold colours and an intensity.

    Raises:
        FileError: If it is no table of three columns or more, with the line.
    """
    table = read_table(path, ROWS, wanted_columns)
    if set("xyz") <= set(table.names):
        cloud = from_columns(path, dict(zip(table.names, table.rows.T, strict=True)))
        return replace(cloud, ignored=not_read(table.others))
    more = table.rows.shape[1] - 3
    ignored = "not read: the columns behind the third; name them in a first line, as in x y z red green blue"
    return CloudFile(table.rows[:, :3], ignored=(ignored,) if more else ())


def read_scan(path: Path) -> CloudFile:
    """Read a scan of KITTI, x y z and reflectance in float32; of nuScenes, .pcd.bin, with the ring behind.

    Raises:
        FileError: If its size or its numbers are not those of a scan.
    """
    width = 5 if path.name.lower().endswith(".pcd.bin") else 4
    size = path.stat().st_size
    if size % (4 * width):
        raise FileError(
            f"{path}: has {size} bytes, which are no scan of {width} numbers of four bytes a point: it "
            "is cut off, or of another kind."
        )
    rows = np.fromfile(path, "<f4").reshape(-1, width)
    with np.errstate(invalid="ignore"):
        beyond = np.mean(np.abs(rows) > FURTHEST)
    if beyond > MOST_BEYOND:
        raise FileError(
            f"{path}: holds no coordinates: {beyond:.0%} of its numbers, read as float32, are beyond "
            f"{FURTHEST:g}. Scans of KITTI are x y z reflectance in float32."
        )
    return CloudFile(rows[:, :3].astype(np.float64), intensity=rows[:, 3].astype(np.float64))
