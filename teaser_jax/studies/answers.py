"""Answers of another program to the problems of a study, which become one more method."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError, one_line, os_errors_named, read_archive
from teaser_jax.pose import Pose
from teaser_jax.studies.looks import KNOWN
from teaser_jax.studies.methods import Method, Row, errors
from teaser_jax.studies.shards import ORIGIN, read_origin
from teaser_jax.studies.study import Study
from teaser_jax.studies.table import written
from teaser_jax.studies.trials import Origin, StudyError, Trial

COPIED = (*ORIGIN, "value", "trial")  # from the shard into the file of answers
PARTS = {"rotation": (3, 3), "translation": (3,), "scale": ()}  # of a pose
MEASURED_BY = {"rotation": "rotation_deg", "translation": "translation", "scale": "scale_error"}
SQUARE_WITHIN = 1e-3  # how far R R^T may be from I: room for rotations in few digits

Place: TypeAlias = tuple[str, int]  # the value of a problem's cell as tables hold it, and its number there
Cells: TypeAlias = Iterable[tuple[Number, Iterable[int]]]


class Answer(NamedTuple):
    """An ``Answer`` is a pose, or None where there is none, and how long it took, or NaN."""

    pose: Pose | None
    seconds: float


def read_answers(paths: Sequence[str | Path], study: Study, origin: Origin, cells: Cells) -> list[Method]:
    """Read answers of other programs to the problems of a study; each program becomes a method.

    A file is an ``.npz`` with the arrays ``method``, the name of the program; ``rotation`` (b, 3, 3),
    ``translation`` (b, 3) and ``scale`` (b,) of T_dst_src, those of them that the study measures; maybe
    ``seconds`` (b,), NaN where nobody looked; and ``study``, ``seed``, ``model``, ``model_crc32``,
    ``protocol``, ``value`` and ``trial``, copied from the shard of ``save_trials`` that is answered, in its
    order. A pose whose numbers are all NaN is no answer: it counts as a wrong one. Answers to several shards
    stand in one file, or in several that name one method.

    Args:
        paths: The files.
        study: The study, whose measures judge the answers.
        origin: What its problems are drawn from.
        cells: The problems that are asked, as from ``Study.cells``: each must have its answer.

    Raises:
        FileError: If a file is missing or broken, holds arrays of other shapes, poses that are none, or
            answers to other problems; the message says what to do.
        StudyError: If the study measures no poses.
    """
    needed = [part for part in PARTS if MEASURED_BY[part] in study.columns]
    if study.scale is not None and "scale" in needed:
        needed.remove("scale")
    if paths and not needed:
        raise StudyError(f"{study.name} measures no poses: score the answers to another study.")
    found: dict[str, dict[Place, Answer]] = {}
    files: dict[str, list[str]] = {}
    for path in map(Path, paths):
        method, answers = _read(path, study, origin, needed)
        mine = found.setdefault(method, {})
        if twice := mine.keys() & answers.keys():
            raise FileError(
                f"{path}: {method!r} answers {_said(study, min(twice))} twice: name each file once."
            )
        mine |= answers
        files.setdefault(method, []).append(str(path))
    asked = {(written(value), k) for value, numbers in cells for k in numbers}
    for method, mine in found.items():
        _check_complete(", ".join(files[method]), study, mine.keys(), asked)
    return [Method(method, partial(_scored, answers=mine)) for method, mine in found.items()]


def _scored(trials: list[Trial], mesh: Any, answers: dict[Place, Answer]) -> list[Row]:
    """Measure the answers to some trials as those of all other methods."""
    rows = []
    for trial in trials:
        pose, seconds = answers[written(trial.value), trial.number]
        row = {} if pose is None else errors(trial, pose)
        rows.append(row if np.isnan(seconds) else row | {"seconds": seconds})
    return rows


def _read(path: Path, study: Study, origin: Origin, needed: list[str]) -> tuple[str, dict[Place, Answer]]:
    """Read one file: the name of the method, and its answers by problem."""
    if not path.exists():
        raise FileError(f"{path}: no such file.")
    with os_errors_named(path, "cannot be read"):
        arrays = read_archive(path, {"method", "seconds", *PARTS, *COPIED}).arrays
        theirs = read_origin(path)
    if missing := [name for name in ("method", *needed, *COPIED) if name not in arrays]:
        raise FileError(
            f"{path}: is no file of answers to {study.name}: it lacks {', '.join(missing)}. Write method and "
            f"{', '.join(needed)}, and copy {', '.join(COPIED)} from the shard."
        )
    method = _name(path, arrays["method"], study)
    _check_origin(path, theirs, origin)
    poses = [part for part in PARTS if part in arrays and (part in needed or part != "scale")]
    _check_shapes(path, arrays, poses)
    places = [(written(float(v)), int(k)) for v, k in zip(arrays["value"], arrays["trial"], strict=True)]
    known_scale = np.nan if study.scale is None else study.scale
    answers = {}
    for row, place in enumerate(places):
        said = f"{path}: the answer to {_said(study, place)}"
        if place in answers:
            raise FileError(f"{said} is there twice: leave one of them out.")
        parts = {part: np.asarray(arrays[part][row], np.float64) for part in poses}
        seconds = float(arrays["seconds"][row]) if "seconds" in arrays else np.nan
        if seconds < 0 or np.isinf(seconds):
            raise FileError(f"{said} has seconds {seconds:g}: give a time, or NaN where there is none.")
        whole = {"rotation": np.eye(3), "translation": np.zeros(3), "scale": np.asarray(known_scale)} | parts
        answers[place] = Answer(Pose(**whole) if _is_pose(said, parts) else None, seconds)
    return method, answers


def _name(path: Path, array: np.ndarray, study: Study) -> str:
    """Read the name of a method, which no other in the figure may have."""
    if array.size != 1 or array.dtype.kind != "U" or not (name := one_line(array.item(), 80)):
        raise FileError(f"{path}: method is no name: give one text, as in method='mine'.")
    if name in KNOWN or name in {method.name for method in study.methods}:
        raise FileError(f"{path}: {name!r} is a method of the studies: give yours another name in the file.")
    return name


def _check_origin(path: Path, theirs: Origin | None, origin: Origin) -> None:
    differs = theirs and origin.unlike(asdict(theirs))
    if differs:
        raise FileError(
            "{}: answers problems of {} {!r}, and {!r} is asked for: ask for that {}, or export anew.".format(
                path, *differs, differs[0]
            )
        )


def _check_shapes(path: Path, arrays: dict[str, np.ndarray], poses: list[str]) -> None:
    """Raise FileError unless there is a number of each kind for each problem."""
    count = arrays["trial"].size
    shapes: dict[str, tuple[int, ...]] = {"trial": (), "value": (), **{part: PARTS[part] for part in poses}}
    shapes |= {"seconds": ()} if "seconds" in arrays else {}
    for name, shape in shapes.items():
        array, expected = arrays[name], (count, *shape)
        if array.shape != expected:
            raise FileError(
                f"{path}: {name} has shape {array.shape}: expected {expected}, as trial has {count}."
            )
        if array.dtype.kind not in "fiu":
            raise FileError(f"{path}: {name} holds {array.dtype}: expected real numbers.")
    if not np.all(np.isfinite(arrays["value"])) or np.any(arrays["trial"] % 1 != 0):
        raise FileError(f"{path}: value or trial names no problem: copy both from the shard.")


def _is_pose(said: str, parts: dict[str, np.ndarray]) -> bool:
    """Tell whether parts of a pose are there; all NaN, it is not. FileError if they are no pose."""
    if all(np.all(np.isnan(part)) for part in parts.values()):
        return False
    for name, part in parts.items():
        if not np.all(np.isfinite(part)):
            raise FileError(f"{said} has a {name} that is not finite: no answer is NaN in all its numbers.")
    if "rotation" in parts:
        rotation = parts["rotation"]
        away = float(np.max(np.abs(rotation @ rotation.T - np.eye(3))))
        if away > SQUARE_WITHIN or np.linalg.det(rotation) < 0:
            raise FileError(
                f"{said} has a rotation that is none (R R^T differs from I by {away:.2g}, det R = "
                f"{np.linalg.det(rotation):.2g}): give R without the scale, with det R = 1."
            )
    if "scale" in parts and parts["scale"] <= 0:
        raise FileError(f"{said} has scale {parts['scale']:g}: a scale is above zero.")
    return True


def _check_complete(files: str, study: Study, answered: Iterable[Place], asked: set[Place]) -> None:
    """Raise FileError unless every problem that is asked has its answer, and no other has one."""
    answered = set(answered)
    for places, what in ((asked - answered, "lacks {} of them"), (answered - asked, "answers {} others")):
        if places:
            first = _said(study, min(places, key=lambda place: (float(place[0]), place[1])))
            raise FileError(
                f"{files}: {len(asked)} problems are asked; it {what.format(len(places))}, first {first}: "
                "answer all that are asked (NaN where there is no answer), or ask with the runs and quick of "
                "the export."
            )


def _said(study: Study, place: Place) -> str:
    return f"{study.sweep} {place[0]}, trial {place[1]}"
