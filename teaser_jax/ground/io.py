"""Files: read without trust, written whole or not at all, and what is wrong said in one line."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from math import prod
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import ZipFile

import numpy as np
from numpy.lib import format as npy

from teaser_jax.ground.extras import MissingExtra

ZIP = (b"PK\x03\x04", b"PK\x05\x06")  # how archives begin, full and empty ones

# Sizes that a file declares are not trusted.
MOST_UNPACKED = 100  # times the size of the file: clouds are packed into a tenth
ALWAYS_UNPACKED = 2**26  # bytes, which do no harm


class FileError(ValueError):
    """A file that cannot be used. The message is one line: what is wrong and what to do."""


def one_line(message: object, limit: int = 300) -> str:
    """Turn a message into one line of bearable length."""
    text = "".join(c if c.isprintable() else " " for c in str(message))
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def visible(text: str, limit: int = 40) -> str:
    """Write a text so that every character of it can be seen."""
    return one_line(
        "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text), limit
    )


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a place to write, which becomes ``path`` at the end; after a failure ``path`` is as before."""
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def check_room(path: Path, count: int, size: int, room: int, *, item: str = "points") -> None:
    """Raise FileError unless so many items of so many bytes fit into what is left of a file."""
    if count < 0 or count * size > room:
        raise FileError(
            f"{path}: declares {count} {item} and has room for {max(room, 0) // size}: it is cut off, or its "
            "header is wrong."
        )


def check_unpacked(path: Path, unpacked: int, packed: int) -> None:
    """Raise FileError if a file declares that far more is packed into it than clouds can be."""
    if unpacked > max(MOST_UNPACKED * packed, ALWAYS_UNPACKED):
        raise FileError(
            f"{path}: declares {unpacked / 2**20:.0f} MB packed into {packed / 2**20:.3g} MB, which no cloud "
            "is: its header is wrong, or it is made to do harm."
        )


class Archive(NamedTuple):
    """What an ``.npz`` holds: the arrays that were asked for, and the names of all."""

    arrays: dict[str, np.ndarray]
    names: tuple[str, ...]


def read_archive(path: Path, wanted: Collection[str] | None = None) -> Archive:
    """Read arrays of an ``.npz`` by name; others are not even unpacked.

    Args:
        path: Where it is.
        wanted: The names to read; None: all.

    Raises:
        FileError: If the file is no archive, or is broken.
        OSError: If it cannot be read.
    """
    return or_file_error(path, "is no .npz archive, or is broken", lambda: _arrays(path, wanted))


def or_file_error(path: Path, what: str, read: Callable[[], Any], *, quoting: bool = True) -> Any:
    """Return what ``read`` returns; whatever it raises becomes a FileError that says ``what``.

    An OSError, a FileError and a MissingExtra say more by themselves, and pass.

    With ``quoting`` the words of whoever raised it follow in brackets.

    Broken files make zipfile, zlib, struct, ast and numpy raise nearly anything, in every
    version something else: so everything is caught here, and nowhere else.
    """
    try:
        return read()
    except (OSError, FileError, MissingExtra):
        raise
    except Exception as error:
        reason = one_line(error) or type(error).__name__
        raise FileError(f"{path}: {what} ({reason})." if quoting else f"{path}: {what}.") from error


@contextmanager
def os_errors_named(path: Path, what: str) -> Iterator[None]:
    """Turn an OSError of the block into a FileError that names the path and says ``what`` is wrong."""
    try:
        yield
    except OSError as error:
        raise FileError(f"{path}: {what}: {error.strerror or one_line(error)}.") from error


def _arrays(path: Path, wanted: Collection[str] | None) -> Archive:
    # numpy closes only files that it did not open; pickled objects would run code from the file.
    with path.open("rb") as file:
        start = file.read(6)
        if start == b"\x93NUMPY":
            raise ValueError("one array without a name")
        if not start.startswith(ZIP):  # numpy would take it for a pickle and advise to trust it
            raise ValueError("it does not begin as a zip file does")
        file.seek(0)
        archive = np.load(file, allow_pickle=False)
        names = tuple(archive.files)
        for name in names:
            if wanted is None or name in wanted:
                _check_member(path, archive.zip, name)
        return Archive({name: archive[name] for name in names if wanted is None or name in wanted}, names)


def _check_member(path: Path, archive: ZipFile, name: str) -> None:
    """Raise FileError if an array of an archive declares more than there is."""
    member = f"{name}.npy" if f"{name}.npy" in archive.namelist() else name
    size = archive.getinfo(member).file_size
    check_unpacked(path, size, path.stat().st_size)
    with archive.open(member) as file:
        version = npy.read_magic(file)
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
        if read is not None:  # others hold names that are not Latin
            shape, _, kind = read(file)
            check_room(path, prod(shape), max(kind.itemsize, 1), size - file.tell(), item="numbers")
