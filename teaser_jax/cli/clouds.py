"""``teaser-jax register A B``: from two files of clouds to a pose, pictures, and words about them."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Collection
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

import teaser_jax as tj
from teaser_jax.cli.endings import OK, UNTRUSTED, BadInput
from teaser_jax.cli.places import (
    check_places,
    draw_clouds,
    failures_named,
    tell_unwritten,
    write_merged,
    write_page,
    writing,
)
from teaser_jax.cli.report import clouds_as_plain_data
from teaser_jax.files.cloud_file import CloudFile
from teaser_jax.files.clouds import read_cloud
from teaser_jax.files.poses import read_poses, write_pose
from teaser_jax.ground.io import one_line
from teaser_jax.pose import as_pose

OPTIONS = (
    "voxel_size", "tolerance", "src_viewpoint", "dst_viewpoint", "initial_error", "max_range", "threads",
    "seconds",
)  # fmt: skip
CLOUDS_ONLY = (*OPTIONS, "initial", "crop", "align", "html", "merged")
MATCHES_ONLY = (
    "noise_bound", "cbar2", "certify", "clique", "rotation", "clique_seconds", "clique_nodes", "tim_graph",
    "vote", "refine",
)  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Register two clouds, write what is asked for, print the answer, and return the exit code.

    Raises:
        BadInput: If something cannot be registered or written; then no file has changed.
        FileError: If a file cannot be used.
    """
    check_kind(arguments, MATCHES_ONLY, "a file of matches")
    given = vars(arguments)
    places = {name: given.get(name) for name in ("output", "plot", "html", "merged")}
    check_places((arguments.source, arguments.target), places)
    src, dst = _read(arguments.source), _read(arguments.target)
    result = _answer(arguments, src, dst)
    older = places["output"] is not None and places["output"].exists()
    _write(result, src, dst, places, f"{arguments.source.name} in the frame of {arguments.target.name}")
    if not result.ok:
        tell_unwritten(places["output"], older, result.status.name)
    print(json.dumps(clouds_as_plain_data(result), allow_nan=False) if arguments.json else result)
    return OK if result.ok else UNTRUSTED


def check_kind(arguments: argparse.Namespace, others: Collection[str], what: str) -> None:
    """Raise BadInput if an option is given that belongs to another kind of input."""
    for name in others:
        if name in vars(arguments):
            option = "no-refine" if name == "refine" else name.replace("_", "-")
            raise BadInput(f"--{option} belongs to {what}, see teaser-jax register --help")


def _read(path: Path) -> CloudFile:
    try:
        cloud = read_cloud(path)
    except ImportError as error:
        raise BadInput(f"{path}: {error}") from error
    for sentence in cloud.ignored:
        print(f"teaser-jax: {one_line(path)}: {sentence}", file=sys.stderr)
    return cloud


def _answer(arguments: argparse.Namespace, src: CloudFile, dst: CloudFile) -> tj.CloudRegistration:
    given = vars(arguments)
    known: dict[str, Any] = {name: given[name] for name in OPTIONS if name in given}
    if "scale" in given:
        if given["scale"] is None:
            raise BadInput("--scale estimate belongs to matches: of two clouds give the known scale")
        known["scale"] = given["scale"]
    if "crop" in given:
        known["crop"] = np.reshape(given["crop"], (2, 3))
    if "align" in given:
        known["refine"] = None if given["align"] == "none" else given["align"]
    if "initial" in given:
        known["initial"] = read_poses(given["initial"]).poses[0]
    try:
        return tj.register_clouds(src.points, dst.points, progress=True, **known)
    except (ValueError, ImportError) as error:
        raise BadInput(f"{arguments.source}, {arguments.target}: {error}") from error
    except MemoryError as error:
        few = "give fewer points, or a larger --voxel-size"
        raise BadInput(f"{arguments.source}: more memory is needed than there is: {few}") from error


def _write(
    result: tj.CloudRegistration, src: CloudFile, dst: CloudFile, places: dict[str, Path | None], title: str
) -> None:
    """Write pictures, merged cloud and pose, or none of them if one fails.

    A pose or a merged cloud of an earlier run must not pass for this run's answer: they go if there is none.
    """
    with ExitStack() as until_all_is_well:
        if places["plot"] is not None:
            draw_clouds(until_all_is_well.enter_context(writing(places["plot"])), result)
        if places["html"] is not None:
            write_page(until_all_is_well.enter_context(writing(places["html"])), result, title)
        if result.ok and places["merged"] is not None:
            there = until_all_is_well.enter_context(writing(places["merged"]))
            write_merged(there, [(src, result.pose), (dst, as_pose(np.eye(4)))])
        if result.ok and places["output"] is not None:
            with failures_named(places["output"]):
                write_pose(places["output"], result.pose)
    for path in (places["output"], places["merged"]):
        if path is not None and not result.ok:
            with failures_named(path):
                path.unlink(missing_ok=True)
