"""Matches from archives and text."""

from __future__ import annotations

import difflib
import re
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from teaser_jax.ground.io import (
    FileError,
    one_line,
    or_file_error,
    os_errors_named,
    read_archive,
    visible,
)
from teaser_jax.pose import Pose, as_pose

TEXT = (".txt", ".csv", ".tsv", ".dat", ".xyz")
CLOUDS = (".ply", ".pcd", ".las", ".laz", ".bin", ".obj", ".stl")  # known to newcomers
KNOWN = ("noise_bound", "scale", "cbar2", "mask", "confidence", "pairs")
TRUTH = "T_dst_src"
# What others call them.
ALSO = {"weights": "confidence", "scores": "confidence", "corr_scores": "confidence", "beta": "noise_bound"}
OF_A_STUDY = {"rotation", "translation", "inliers"}  # beside src and dst in a shard
DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
PANDAS_HEADER = ["0", "1", "2", "3", "4", "5"]  # the column names of a table that was given none


@dataclass(frozen=True, eq=False)
class MatchFile:
    """A ``MatchFile`` holds what a file of matches says, as it stands there: nothing is checked yet.

    Attributes:
        src, dst: (n, 3) matched points, row i with row i [length].
        known: Further arguments of ``register``, those of ``KNOWN`` that the file holds.
        truth: The pose to compare with, from ``T_dst_src``; None: the file has none.
        ignored: A sentence for each array that was not read.
    """

    src: np.ndarray
    dst: np.ndarray
    known: dict[str, np.ndarray]
    truth: Pose | None = None
    ignored: tuple[str, ...] = ()


def read_matches(path: str | PathLike[str]) -> MatchFile:
    """Read matches from ``.npz`` (arrays ``src`` and ``dst``), ``.npy`` or text (six columns).

    An archive may also hold ``noise_bound``, ``scale``, ``cbar2``, ``mask``, ``confidence``,
    ``pairs`` and ``T_dst_src``, (4, 4) or (3, 4); other arrays are not read, and named in ``ignored``.
    Columns are x y z of the source point, then of the target point, a row for each match. Those of text are
    separated by white space, commas, semicolons, tabs or bars; decimal commas are understood where commas
    separate nothing; one line of column names (also 0 to 5, which pandas writes) and ``#`` comments are
    skipped. The points are checked by ``register``.

    Args:
        path: A file that ends in .npz, .npy, .txt, .csv, .tsv, .dat or .xyz.

    Raises:
        FileError: If there is no such file, or it is broken, or holds something else.
    """
    path = Path(path)
    with os_errors_named(path, "cannot be read"):
        try:
            return _reader(path)(path)
        except FileNotFoundError:
            raise FileError(f"{path}: no such file: check the name.") from None


def _reader(path: Path) -> Callable[[Path], MatchFile]:
    """Choose the reader of a file by its extension, or raise FileError."""
    if path.is_dir():
        raise FileError(f"{path}: is a folder: name the file of matches in it.")
    readers = {".npz": _read_npz, ".npy": _read_npy, **dict.fromkeys(TEXT, _read_text)}
    suffix, kinds = path.suffix.lower(), ", ".join(readers)
    if suffix in CLOUDS:
        raise FileError(
            f"{path}: is a cloud, and matches are needed: match the two clouds first, and save row i "
            f"of one with row i of the other as one of {kinds}."
        )
    if suffix == ".mat":
        raise FileError(
            f"{path}: is of Matlab: save its arrays as .npz, as in "
            f"numpy.savez('{path.stem}.npz', **scipy.io.loadmat('{path.name}'))."
        )
    if suffix not in readers:
        raise FileError(f"{path}: unknown extension '{path.suffix}': give matches as one of {kinds}.")
    return readers[suffix]


def _read_npz(path: Path) -> MatchFile:
    arrays, names = read_archive(path, ("src", "dst", *KNOWN, TRUTH))
    for name in ("src", "dst"):
        if name not in arrays:
            found = ", ".join(sorted(names)) or "nothing"
            raise FileError(
                f"{path}: holds no array '{name}' (found: {visible(found, 80)}): "
                "save one with numpy.savez(path, src=src, dst=dst)."
            )
    if arrays["src"].ndim == 3 and set(names) >= OF_A_STUDY:
        raise FileError(
            f"{path}: is a shard of a study, {len(arrays['src'])} problem(s): read them with "
            "teaser_jax.studies.read_trials, and solve them with solve_batch."
        )
    known = {name: arrays[name] for name in KNOWN if name in arrays}
    truth = None
    if TRUTH in arrays:
        truth = or_file_error(path, f"{TRUTH} is no pose", lambda: as_pose(_finite(arrays[TRUTH])))
    ignored = tuple(_ignored(name) for name in names if name not in arrays)
    return MatchFile(arrays["src"], arrays["dst"], known, truth, ignored)


def _ignored(name: str) -> str:
    """Say that an array is not read, and which name may be meant."""
    near = ALSO.get(name.lower()) or next(iter(difflib.get_close_matches(name, (*KNOWN, TRUTH), n=1)), None)
    return f"array '{visible(name)}' is ignored" + (f": call it '{near}' to have it read" if near else "")


def _read_npy(path: Path) -> MatchFile:
    table = or_file_error(path, "is no .npy array, or is broken", lambda: np.load(path, allow_pickle=False))
    shape = getattr(table, "shape", ())
    if shape[1:] != (6,):
        raise FileError(
            f"{path}: holds an array of shape {shape}: expected matches, (n, 6): x y z of the source point, "
            "then of the target. Of two clouds, match them first."
        )
    return MatchFile(table[:, :3], table[:, 3:], {})


def _read_text(path: Path) -> MatchFile:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise FileError(f"{path}: is not text: expected six columns of numbers.") from None
    numbered = ((number, line.split("#")[0].replace('"', "")) for number, line in enumerate(lines, 1))
    rows = [(number, line) for number, line in numbered if line.strip()]
    delimiter = next((d for d in ";,\t|" if rows and d in rows[0][1]), None)
    if rows and _is_header(_fields(rows[0][1], delimiter)):
        rows = rows[1:]
    if rows and _has_decimal_commas(rows[0][1], delimiter):
        delimiter = None if delimiter == "," else delimiter
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    if not rows:
        raise FileError(f"{path}: holds no match: expected six numbers a row.")
    reason = ""
    try:
        table = np.loadtxt([line for _, line in rows], delimiter=delimiter, ndmin=2)
    except ValueError as error:
        table, reason = np.empty((0, 0)), str(error)
    if table.shape[1] != 6:
        for number, line in rows:
            _check_line(f"{path}: line {number}", _fields(line, delimiter))
        raise FileError(f"{path}: cannot be read ({one_line(reason)}): expected six numbers a row.")
    return MatchFile(table[:, :3], table[:, 3:], {})


def _fields(line: str, delimiter: str | None) -> list[str]:
    return [field.strip() for field in line.split(delimiter)]


def _is_header(fields: list[str]) -> bool:
    """Tell whether a first row holds column names: anything else that is no number is an error instead."""
    return fields == PANDAS_HEADER or all(
        any(c.isalpha() for c in field) and not _is_number(field) for field in fields
    )


def _has_decimal_commas(line: str, delimiter: str | None) -> bool:
    """Tell whether commas are decimal points: six numbers with commas, and something else between them."""
    fields = _fields(line, None if delimiter == "," else delimiter)
    return "," in line and len(fields) == 6 and all(DECIMAL_COMMA.fullmatch(field) for field in fields)


def _check_line(where: str, fields: list[str]) -> None:
    if len(fields) != 6:
        raise FileError(
            f"{where} has {len(fields)} columns: expected six, x y z of the source point, then of the target."
        )
    for column, field in enumerate(fields, 1):
        if not field:
            raise FileError(f"{where} has nothing in column {column}: leave the row out, or write nan there.")
        if not _is_number(field):
            raise FileError(f"{where} holds '{visible(field)}' in column {column}: expected six numbers.")


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True


def _finite(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError("not all finite numbers")
    return array.astype(np.float64)
