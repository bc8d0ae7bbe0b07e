"""Where a command writes: looked at before the work, and written whole or not at all."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from teaser_jax.cli.endings import BadInput
from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.files.cloud_file import CloudFile
from teaser_jax.files.clouds import write_cloud
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import one_line, replacing
from teaser_jax.pose import Pose
from teaser_jax.register import Registration

# What the options that name files are for.
WORDS = {"output": "pose", "plot": "picture", "html": "page", "merged": "merged cloud"}


def check_places(sources: Sequence[Path], places: Mapping[str, Path | None]) -> None:
    """Raise BadInput before the work, not after it, if its answer has no place to go.

    Args:
        sources: Files that are read, which must not be written over.
        places: Where to write, by the option that names it; None: nowhere.
    """
    asked = {name: path for name, path in places.items() if path is not None}
    for path in asked.values():
        for source in sources:
            check_writable(path, source)
    if "plot" in asked:
        check_matplotlib()
    if "html" in asked:
        check_plotly()
    seen: dict[str, str] = {}
    for name, path in asked.items():
        place = os.path.realpath(path)
        if place in seen:
            first = asked[seen[place]]
            raise BadInput(
                f"{first}: is named for the {WORDS[seen[place]]} and for the {WORDS[name]}: name two files"
            )
        seen[place] = name


def tell_unwritten(output: Path | None, older: bool, status: str) -> None:
    """Say on stderr that a pose that cannot be trusted was not written."""
    if output is not None:
        what = "not written, and the older file removed" if older else "not written"
        print(f"teaser-jax: {one_line(output)} {what}: {status}", file=sys.stderr)


def check_writable(path: Path, source: Path | None = None) -> None:
    """Raise BadInput if a file cannot be written, or is the one that is read."""
    with failures_named(path):
        path.exists()  # raises if the name is too long
    folder = path.parent
    if path.is_dir():
        raise BadInput(f"{path}: is a folder: name a file to write")
    if path.exists() and not path.is_file():
        raise BadInput(f"{path}: is no ordinary file: name one to write")
    if not folder.is_dir():
        raise BadInput(f"{path}: the folder {folder} does not exist: make it first")
    if not all(os.access(place, os.W_OK) for place in (folder, path) if place.exists()):
        raise BadInput(f"{path}: cannot be written: no permission")
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        raise BadInput(f"{path}: is a file that is read: name another one to write")


def check_matplotlib() -> None:
    """Raise BadInput if no picture can be drawn."""
    _check_library("matplotlib.figure", "pictures need matplotlib")


def check_plotly() -> None:
    """Raise BadInput if no page can be written."""
    _check_library("plotly.graph_objects", "pages need plotly")


def _check_library(module: str, what: str) -> None:
    try:
        needed(module, what, "viz")
    except ImportError as error:
        raise BadInput(str(error)) from None


def draw(path: Path, src: np.ndarray, dst: np.ndarray, result: Registration) -> None:
    """Write the picture of an answer."""
    from teaser_jax.plots import plot_registration

    plot_registration(src, dst, result).savefig(path)


def draw_clouds(path: Path, result: CloudRegistration) -> None:
    """Write the picture of an answer to two clouds."""
    from teaser_jax.plots import plot

    plot(result).savefig(path)


def write_page(path: Path, result: CloudRegistration, title: str) -> None:
    """Write the page of an answer to two clouds."""
    from teaser_jax.plots import write_view

    write_view(path, result, title=title)


def write_merged(path: Path, clouds: Sequence[tuple[CloudFile, Pose]]) -> None:
    """Write clouds in one frame, with colours and intensity where all have them.

    Args:
        path: Where to.
        clouds: Each with the pose that brings it there.
    """
    finite = [np.isfinite(cloud.points).all(axis=1) for cloud, _ in clouds]
    points = [pose.apply(cloud.points[rows]) for (cloud, pose), rows in zip(clouds, finite, strict=True)]
    shared: dict[str, np.ndarray] = {}
    for name in ("colours", "intensity"):
        columns = [getattr(cloud, name) for cloud, _ in clouds]
        if all(column is not None for column in columns):
            kept = [column[rows] for column, rows in zip(columns, finite, strict=True)]
            shared[name] = np.concatenate(kept)
    write_cloud(path, np.concatenate(points), **shared)


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """Give a place to write, which becomes the file at the end of the block if nothing failed there."""
    with failures_named(path), replacing(path) as partial:
        yield partial


@contextmanager
def failures_named(path: Path) -> Iterator[None]:
    """Turn an OSError of the block into a BadInput that says in one line why a file cannot be written."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror or error}") from error
