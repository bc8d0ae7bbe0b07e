"""Recall by scene on a public set, ours and the peers: for whoever has the set.

Every answer is kept as soon as it is there, so that a run that ended goes on where it was.
"""

from __future__ import annotations

import csv
import zlib
from collections.abc import Callable, Iterator
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from tqdm import tqdm

import teaser_jax as tj
from benchmarks.clouds.cases import CloudPair
from benchmarks.clouds.kept import Kept, code
from benchmarks.clouds.lists import ListedPair
from benchmarks.clouds.methods import Answer, Method, asked
from teaser_jax.files import read_cloud
from teaser_jax.ground.io import os_errors_named, replacing
from teaser_jax.pose import Pose

KEPT, TABLE = "answers.jsonl", "table.csv"
FIT = 0.2  # [m]: 3DMatch's own bound on the root mean square error of the overlap's points
CLOUDS = 4  # that are held: a scene asks for the same ones again


class Criterion(NamedTuple):
    """Errors below which an answer is right [deg, m]."""

    rotation: float
    translation: float

    @property
    def name(self) -> str:
        """In tables."""
        return f"{self.rotation:g} deg {self.translation:g} m"


class Kind(NamedTuple):
    """What is usual for a kind of set: criteria, the first for the errors; the width of the peers' cells."""

    criteria: tuple[Criterion, ...]
    voxel: float


KINDS = {
    "3dmatch": Kind((Criterion(15, 0.3), Criterion(10, 0.3)), 0.05),
    "lidar": Kind((Criterion(5, 0.6), Criterion(5, 2)), 0.3),
}


def evaluate(
    listed: list[ListedPair], kind: Kind, methods: dict[str, Method], output: Path
) -> list[dict[str, str | float]]:
    """Ask every method about every pair, and write ``table.csv`` by scene.

    Args:
        listed: The pairs.
        kind: Their criteria.
        methods: By name.
        output: Made if it does not exist; answers that it holds are not asked for again.

    Returns:
        The rows of the table.

    Raises:
        FileError: If a cloud cannot be read, or the folder cannot be written or answers other pairs.
    """
    with os_errors_named(output, "cannot be written"):
        output.mkdir(parents=True, exist_ok=True)
        kept = Kept(output / KEPT, _origin(listed))
        cloud = lru_cache(CLOUDS)(lambda path: read_cloud(path).points.astype(np.float64))
        with tqdm(total=len(listed), disable=None) as bar:
            for one in listed:
                bar.set_description(f"{one.scene}: {one.name}")
                for name, method in methods.items():
                    if (key := (one.scene, one.name, name)) not in kept.rows:
                        kept.add(key, asked(method, _pair(one, kind, cloud)).as_row())
                bar.update()
        rows = list(_table(listed, kind, list(methods), kept))
        _write(output / TABLE, rows)
    return rows


def _origin(listed: list[ListedPair]) -> dict:
    """What answers belong to: the pairs, and this code."""
    text = "\n".join(f"{x.scene} {x.name} {np.asarray(x.truth.matrix).tolist()}" for x in listed)
    return {"pairs": zlib.crc32(text.encode()), "code": code()}


def _pair(one: ListedPair, kind: Kind, cloud: Callable[[Path], np.ndarray]) -> CloudPair:
    limits = kind.criteria[0]
    return CloudPair(
        one.scene, one.name, cloud(one.src), cloud(one.dst), (one.truth,), *limits, kind.voxel,
        seen_from_origin=True,
    )  # fmt: skip


def fit_error(pose: Pose, one: ListedPair) -> float:
    """Root mean square error of the overlap's points, by its information, as 3DMatch counts [m].

    The information belongs to a shift and the vector of the quaternion of what is left of the pose after the
    true one is undone; its first entry is the number of points.
    """
    left = one.truth.inverse() @ pose
    step = np.concatenate([left.translation, np.sign(left.quat[3] or 1) * left.quat[:3]])
    return float(np.sqrt(step @ one.information @ step / one.information[0, 0]))


def _table(
    listed: list[ListedPair], kind: Kind, methods: list[str], kept: Kept
) -> Iterator[dict[str, str | float]]:
    """A row a method and scene, and one for all pairs."""
    scenes = list(dict.fromkeys(one.scene for one in listed))
    for method in methods:
        for scene in [*scenes, "all"]:
            own = [one for one in listed if scene in (one.scene, "all")]
            said = (Answer.of_row(kept.rows[one.scene, one.name, method]) for one in own)
            yield _row(scene, method, kind, list(zip(own, said, strict=True)))


def _row(
    scene: str, method: str, kind: Kind, answers: list[tuple[ListedPair, Answer]]
) -> dict[str, str | float]:
    errors = np.array([_errors(one, said) for one, said in answers])
    row: dict[str, str | float] = {"scene": scene, "method": method, "pairs": len(answers)}
    within = [(errors < limits).all(axis=1) for limits in kind.criteria]
    for limits, right in zip(kind.criteria, within, strict=True):
        row[f"recall {limits.name}"] = float(right.mean())
    counted = [(one, said) for one, said in answers if one.information is not None and not one.is_next]
    if counted:
        fits = [said.pose is not None and fit_error(said.pose, one) < FIT for one, said in counted]
        row |= {"not neighbours": len(counted), f"recall {FIT} m rms": float(np.mean(fits))}
    if any(said.ok is not None for _, said in answers):
        ok = np.array([bool(said.ok) for _, said in answers])
        row |= {"ok": int(ok.sum()), "wrong ok": int((ok & ~within[0]).sum())}
    right = errors[within[0]]
    middle = np.median(right, axis=0) if len(right) else (np.nan, np.nan)
    row |= {"rotation [deg]": float(middle[0]), "translation [m]": float(middle[1])}
    wall, cpu = np.median([(said.wall, said.cpu) for _, said in answers], axis=0)
    return {**row, "wall [s]": float(wall), "cpu [s]": float(cpu)}


def _errors(one: ListedPair, said: Answer) -> tuple[float, float]:
    if said.pose is None:
        return np.inf, np.inf
    off = tj.metrics.errors(said.pose, one.truth)
    return float(off.rotation_deg), float(off.translation)


def _write(path: Path, rows: list[dict]) -> None:
    names = list(dict.fromkeys(name for row in rows for name in row))
    with replacing(path) as partial, partial.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


def as_text(rows: list[dict]) -> str:
    """The table for a terminal."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    cells = [names, *([_shown(row.get(name, "")) for name in names] for row in rows)]
    widths = [max(len(line[k]) for line in cells) for k in range(len(names))]
    return "\n".join(
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)) for line in cells
    )


def _shown(value: str | float) -> str:
    return f"{value:.3f}" if isinstance(value, float) else str(value)
