"""Matches from archives and text."""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np

from teaser_jax.files.tables import TEXT, Layout, read_table
from teaser_jax.ground.io import FileError, or_file_error, os_errors_named, read_archive, visible
from teaser_jax.pose import Pose, as_pose

ROWS = Layout("match", "six numbers", "six, x y z of the source point, then of the target", 6, 6)
CLOUDS = (".ply", ".pcd", ".las", ".laz", ".bin", ".obj", ".stl")  # known to newcomers
KNOWN = ("noise_bound", "scale", "cbar2", "mask", "confidence", "pairs")
TRUTH = "T_dst_src"
# What others call them.
ALSO = {"weights": "confidence", "scores": "confidence", "corr_scores": "confidence", "beta": "noise_bound"}
OF_A_STUDY = {"rotation", "translation", "inliers"}  # beside src and dst in a shard


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
            f"{path}: is a cloud: name a second one after it, as register_clouds takes two. Matches are one "
            f"of {kinds}."
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
            "then of the target. Two clouds are given by two files."
        )
    return MatchFile(table[:, :3], table[:, 3:], {})


def _read_text(path: Path) -> MatchFile:
    table = read_table(path, ROWS).rows
    return MatchFile(table[:, :3], table[:, 3:], {})


def _finite(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind not in "fiu" or not np.isfinite(array).all():
        raise ValueError("not all finite numbers")
    return array.astype(np.float64)
