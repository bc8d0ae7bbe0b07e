"""``teaser-jax map FOLDER``: from a folder of clouds to their poses in one map, and words about them."""

from __future__ import annotations

import argparse
import json
import re
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import teaser_jax as tj
from teaser_jax.cli.endings import OK, UNTRUSTED, BadInput
from teaser_jax.cli.places import check_places, failures_named, tell_unwritten, write_merged, writing
from teaser_jax.cli.report import map_as_plain_data
from teaser_jax.files.cloud_file import CloudFile
from teaser_jax.files.clouds import read_cloud
from teaser_jax.files.kinds import SUFFIXES
from teaser_jax.files.poses import Format, write_poses
from teaser_jax.ground.io import one_line
from teaser_jax.pose import Pose

OPTIONS = (
    "pairs", "workers", "ordered", "engine", "seconds", "voxel_size", "tolerance", "max_range", "viewpoint",
    "threads",
)  # fmt: skip
FORMATS: dict[str, Format] = {".json": "json", ".tum": "tum", ".kitti": "kitti"}


def run(arguments: argparse.Namespace) -> int:
    """Register the clouds of a folder, write what is asked for, print the answer, and return the exit code.

    Raises:
        BadInput: If something cannot be read or written; then no file has changed but those of pairs.
        FileError: If a file cannot be used.
    """
    output, merged = arguments.output, arguments.merged
    paths = clouds_in(arguments.folder)
    for path in (output, merged):
        _check_apart(path, arguments.folder)
    check_places(paths, {"output": output, "merged": merged})
    result = _answer(arguments, paths)
    older = output is not None and output.exists()
    _write(result, paths, output, merged)
    if not result.placed.any():
        tell_unwritten(output, older, "no cloud is placed")
    elif output is not None and not result.placed.all() and output.suffix.lower() != ".json":
        gone = ", ".join(result.names[k] for k in np.flatnonzero(~result.placed))
        print(f"teaser-jax: {one_line(output)}: holds no line of {one_line(gone)}", file=sys.stderr)
    print(json.dumps(map_as_plain_data(result), allow_nan=False) if arguments.json else result)
    return OK if result.ok else UNTRUSTED


def clouds_in(folder: Path) -> list[Path]:
    """List the clouds of a folder in the natural order of their names: scan2 before scan10.

    Text is left out beside clouds of other kinds, as poses and times lie there.

    Raises:
        BadInput: If it is no folder, or holds fewer than two clouds.
    """
    if not folder.exists():
        raise BadInput(f"{folder}: no such folder: check the name")
    if not folder.is_dir():
        raise BadInput(f"{folder}: is no folder: give that of the clouds; register takes two files")
    with failures_named(folder):
        found = [path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES and path.is_file()]
    found = [path for path in found if not path.name.startswith(".")]
    others = [path for path in found if SUFFIXES[path.suffix.lower()] != "text"]
    found = others or found
    if len(found) < 2:
        raise BadInput(
            f"{folder}: holds {len(found)} cloud{'s' * (len(found) != 1)}, and a map needs two or more: "
            f"as {', '.join(SUFFIXES)}"
        )
    numbers = lambda name: [(0, int(x), "") if x.isdecimal() else (1, 0, x) for x in re.split(r"(\d+)", name)]
    return sorted(found, key=lambda path: (numbers(path.name), path.name))


def _check_apart(path: Path | None, folder: Path) -> None:
    """Raise BadInput if what is written would be a scan to the next run, or takes the place of one."""
    if path is None or path.suffix.lower() not in SUFFIXES:
        return
    if path.resolve().parent == folder.resolve():
        raise BadInput(f"{path}: lies among the scans, and would be taken for one: name another folder")


def _answer(arguments: argparse.Namespace, paths: list[Path]) -> tj.CloudMap:
    given, work = vars(arguments), arguments.work
    known: dict[str, Any] = {name: given[name] for name in OPTIONS if name in given}
    if "crop" in given:
        known["crop"] = np.reshape(given["crop"], (2, 3))
    if "align" in given:
        known["refine"] = None if given["align"] == "none" else given["align"]
    if work is None and arguments.output is not None:
        work = arguments.output.with_name(f"{arguments.output.name}.pairs")
    try:
        return tj.register_many(paths, folder=work, progress=True, **known)
    except (ValueError, ImportError, RuntimeError) as error:
        raise BadInput(f"{arguments.folder}: {error}") from error
    except MemoryError as error:
        few = "take fewer workers, or smaller clouds"
        raise BadInput(f"{arguments.folder}: more memory is needed than there is: {few}") from error


def _write(result: tj.CloudMap, paths: list[Path], output: Path | None, merged: Path | None) -> None:
    """Write poses and the merged cloud, or neither; those of an earlier run go if no cloud is placed."""
    there = np.flatnonzero(result.placed)
    if len(there) == 0:
        for path in (output, merged):
            if path is not None:
                with failures_named(path):
                    path.unlink(missing_ok=True)
        return
    poses = [Pose.from_matrix(result.poses[k]) for k in there]
    with ExitStack() as until_all_is_well:
        if merged is not None:
            partial = until_all_is_well.enter_context(writing(merged))
            clouds = [_used(read_cloud(paths[k]), result.rows_used(int(k))) for k in there]
            write_merged(partial, list(zip(clouds, poses, strict=True)))
        if output is not None:
            format = FORMATS.get(output.suffix.lower(), "matrix")
            more: dict[str, Any] = {}
            if format == "json":
                more["names"] = [result.names[k] for k in there]
            if format == "tum":
                more["times"] = there.astype(float)
            with failures_named(output):
                write_poses(output, poses, format=format, **more)


def _used(cloud: CloudFile, rows: np.ndarray) -> CloudFile:
    """Keep the points of a file that the map used: strays and zeros are none of it."""
    column = lambda x: None if x is None else x[rows]
    return CloudFile(cloud.points[rows], column(cloud.colours), column(cloud.intensity))
