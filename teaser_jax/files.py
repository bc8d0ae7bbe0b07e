"""Matches from files and poses to files. Whatever is wrong with a file is said in one line."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.pose import Pose

TEXT = (".txt", ".csv", ".tsv", ".dat", ".xyz")
CLOUDS = (".ply", ".pcd", ".las", ".laz", ".bin", ".npy", ".obj", ".stl")  # known to newcomers
KNOWN = ("noise_bound", "scale", "cbar2", "mask", "confidence", "pairs")
ZIP = (b"PK\x03\x04", b"PK\x05\x06")  # how archives begin, full and empty ones
PANDAS_HEADER = ["0", "1", "2", "3", "4", "5"]  # the column names of a table that was given none


class FileError(ValueError):
    """A file that cannot be used. The message is one line: what is wrong and what to do."""


@dataclass(frozen=True, eq=False)
class Matches:
    """What a file of matches holds; ``None`` where it says nothing.

    Attributes:
        src, dst: (n, 3) matched points, row i with row i.
        known: Further arguments of ``register``, those of ``KNOWN`` that the file holds.
        truth: The pose to compare with, from ``T_dst_src``.
    """

    src: np.ndarray
    dst: np.ndarray
    known: dict[str, np.ndarray]
    truth: Pose | None = None


def read_matches(path: str | PathLike[str]) -> Matches:
    """Matches from ``.npz`` (arrays ``src`` and ``dst``) or text (six columns).

    An archive may also hold ``noise_bound``, ``scale``, ``cbar2``, ``mask``, ``confidence``,
    ``pairs`` and ``T_dst_src``. Text has a row for each match, x y z of the source point, then of
    the target point, separated by white space, commas, semicolons, tabs or bars; one line of
    column names (also 0 to 5, which pandas writes) and ``#`` comments are skipped. The points are
    checked by ``register``.

    Raises:
        FileError: If there is no such file, or it is broken, or holds something else.
    """
    path = Path(path)
    readers = {".npz": _read_npz, **dict.fromkeys(TEXT, _read_text)}
    try:
        if path.is_dir():
            raise FileError(f"{path}: is a folder: name the file of matches in it.")
        if path.suffix.lower() not in readers:
            kinds = ", ".join(readers)
            if path.suffix.lower() in CLOUDS:
                raise FileError(
                    f"{path}: is a cloud, and matches are needed: match the two clouds first, and save row i "
                    f"of one with row i of the other as one of {kinds}."
                )
            raise FileError(f"{path}: unknown extension '{path.suffix}': give matches as one of {kinds}.")
        return readers[path.suffix.lower()](path)
    except FileNotFoundError:
        raise FileError(f"{path}: no such file: check the name.") from None
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror or one_line(error)}.") from error


def write_pose(path: str | PathLike[str], pose: Pose) -> None:
    """``T_dst_src`` as four lines of four numbers, which ``numpy.loadtxt`` reads back exactly.

    The file appears whole or not at all. Raises OSError if it cannot be written.
    """
    with whole(Path(path)) as partial:
        np.savetxt(partial, pose.matrix, fmt="%.17g")


@contextmanager
def whole(path: Path) -> Iterator[Path]:
    """A place to write, which becomes ``path`` at the end; after a failure ``path`` is as before."""
    partial = path.with_name(f".{path.stem}.partial{path.suffix}")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def one_line(message: object, limit: int = 300) -> str:
    """A message without line breaks and of bearable length."""
    text = "".join(c if c.isprintable() else " " for c in str(message))
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


def read_archive(path: Path) -> dict[str, np.ndarray]:
    """The arrays of an ``.npz``; FileError if it is none, and OSError if it cannot be read."""
    return _guarded(path, "is no .npz archive, or is broken", lambda: _arrays(path))


def _read_npz(path: Path) -> Matches:
    arrays = read_archive(path)
    for name in ("src", "dst"):
        if name not in arrays:
            found = ", ".join(sorted(arrays)) or "nothing"
            raise FileError(
                f"{path}: holds no array '{name}' (found: {one_line(found, 80)}): "
                "save one with numpy.savez(path, src=src, dst=dst)."
            )
    known = {name: arrays[name] for name in KNOWN if name in arrays}
    truth = None
    if "T_dst_src" in arrays:
        truth = _guarded(path, "T_dst_src is no pose", lambda: Pose.from_matrix(_real(arrays["T_dst_src"])))
    return Matches(arrays["src"], arrays["dst"], known, truth)


def _arrays(path: Path) -> dict[str, np.ndarray]:
    # numpy closes only files that it did not open; pickled objects would run code from the file.
    with path.open("rb") as file:
        start = file.read(6)
        if start == b"\x93NUMPY":
            raise ValueError("one array without a name")
        if not start.startswith(ZIP):  # numpy would take it for a pickle and advise to trust it
            raise ValueError("it does not begin as a zip file does")
        file.seek(0)
        archive = np.load(file, allow_pickle=False)
        return {name: archive[name] for name in archive.files}


def _read_text(path: Path) -> Matches:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise FileError(f"{path}: is not text: expected six columns of numbers.") from None
    numbered = ((number, line.split("#")[0]) for number, line in enumerate(lines, 1))
    rows = [(number, line) for number, line in numbered if line.strip()]
    delimiter = next((d for d in ";,\t|" if rows and d in rows[0][1]), None)
    if rows and _is_header(_fields(rows[0][1], delimiter)):
        rows = rows[1:]
    if not rows:
        raise FileError(f"{path}: holds no match: expected six numbers a row.")
    reason = ""
    try:
        table = np.loadtxt([line.replace('"', "") for _, line in rows], delimiter=delimiter, ndmin=2)
    except ValueError as error:
        table, reason = np.empty((0, 0)), str(error)
    if table.shape[1] != 6:
        for number, line in rows:
            _check_line(f"{path}: line {number}", _fields(line, delimiter))
        raise FileError(f"{path}: cannot be read ({one_line(reason)}): expected six numbers a row.")
    return Matches(table[:, :3], table[:, 3:], {})


def _fields(line: str, delimiter: str | None) -> list[str]:
    return [field.strip().strip('"') for field in line.split(delimiter)]


def _is_header(fields: list[str]) -> bool:
    """Column names; a first row that is partly numbers is an error instead."""
    return fields == PANDAS_HEADER or not any(_is_number(field) for field in fields)


def _check_line(where: str, fields: list[str]) -> None:
    if len(fields) != 6:
        raise FileError(
            f"{where} has {len(fields)} columns: expected six, x y z of the source point, then of the target."
        )
    for field in fields:
        if not _is_number(field):
            raise FileError(f"{where} holds '{one_line(field, 40)}': expected six numbers.")


def _guarded(path: Path, what: str, read: Callable[[], Any]) -> Any:
    """The result of reading, or a FileError.

    Broken files make zipfile, zlib, struct, ast and numpy raise nearly anything, in every
    version something else: so everything is caught here, and nowhere else.
    """
    try:
        return read()
    except OSError:
        raise
    except Exception as error:
        reason = one_line(error) or type(error).__name__
        raise FileError(f"{path}: {what} ({reason}).") from error


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _real(array: np.ndarray) -> Float[np.ndarray, "4 4"]:
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError("not all finite numbers")
    return array.astype(np.float64)
