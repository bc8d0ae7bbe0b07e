"""Where a command writes: looked at before the work, and written whole or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from teaser_jax.cli.endings import BadInput
from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import replacing
from teaser_jax.register import Registration


def check_places(source: Path, output: Path | None, plot: Path | None) -> None:
    """Raise BadInput before the work, not after it, if its answer has no place to go.

    Args:
        source: The file of matches, which must not be written over.
        output: Where the pose goes, or None.
        plot: Where the picture goes, or None.
    """
    for path in (output, plot):
        if path is not None:
            check_writable(path, source)
    if plot is not None:
        check_matplotlib()
    if output is not None and plot is not None and os.path.realpath(output) == os.path.realpath(plot):
        raise BadInput(f"{output}: is named for the pose and for the picture: name two files")


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
    try:
        needed("matplotlib.figure", "pictures need matplotlib", "viz")
    except ImportError as error:
        raise BadInput(str(error)) from None


def check_plotly() -> None:
    """Raise BadInput if no page can be written."""
    try:
        needed("plotly.graph_objects", "pages need plotly", "viz")
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
