"""The pairs of clouds that are asked about: real ones, plain scenes, and pairs that have no answer."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache, cached_property
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

import teaser_jax as tj
from benchmarks.clouds.scenes import NOISE, PLAIN, REPEATS, SLIDES, scenes
from benchmarks.problems import DATA
from teaser_jax import Pose, metrics

FOLDER = DATA / "cloud_pairs"
QUICK = 2  # pairs of each kind
OTHERS = 24  # pairs of other places, besides those of two streets
SOME = 2000  # points of a source that tell how far it is off
REVOLVED = {"cad_Round-Peg": np.array([0.0, 1.0, 0.0])}  # only where its axis lies can be asked
ROOM_OF = {"3dmatch_other": "3dmatch_kitchen"}  # another recording of the same room
OTHER, WRONG_MODEL, MIRRORED = "another place", "another model", "mirrored"


class Family(NamedTuple):
    """Real pairs of one kind.

    Attributes:
        name: In tables.
        rotation, translation: Errors below which an answer is right, as in the literature [deg, m].
        voxel: The width of cells that suits the peers [m].
        places: How many different places its pairs show.
    """

    name: str
    rotation: float
    translation: float
    voxel: float
    places: int


FAMILIES = {
    "3dmatch_kitchen": Family("3DMatch kitchen", 15.0, 0.3, 0.05, 1),
    "3dmatch_other": Family("3DMatch, other", 15.0, 0.3, 0.05, 0),
    "kitti00": Family("KITTI 00", 5.0, 0.6, 0.3, 1),
    "kitti07_submaps": Family("KITTI 07 submaps", 5.0, 0.6, 0.3, 1),
    "bunny_scans": Family("bunny scans", 5.0, 0.005, 0.0015, 1),
    "cranfield": Family("CAD to scan", 10.0, 0.005, 0.002, 9),
}
SCENE_NAMES = {
    SLIDES: "scenes that slide or turn", REPEATS: "scenes that repeat", PLAIN: "plain scenes",
    NOISE: "noise",
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class CloudPair:
    """Two clouds, and which answers are right.

    Attributes:
        kind: The line of the table.
        name: Which pair it is.
        src, dst: Points as recorded, NaN among them.
        truths: The accepted poses; none: no answer is right.
        rotation, translation: Errors below which an answer is right [deg, length].
        voxel: The width of cells that suits the peers best [length].
        seen_from_origin: Whether the sensor stood at the origin of both clouds.
        axis: Of a source that may be turned about it; None: it may not.
    """

    kind: str
    name: str
    src: np.ndarray
    dst: np.ndarray
    truths: tuple[Pose, ...]
    rotation: float
    translation: float
    voxel: float
    seen_from_origin: bool = False
    axis: np.ndarray | None = None

    def is_right(self, pose: Pose) -> bool:
        """Tell whether a pose is an accepted answer."""
        return any(self._is_near(pose, truth) for truth in self.truths)

    def _is_near(self, pose: Pose, truth: Pose) -> bool:
        if self.axis is None:
            angle = np.degrees(metrics.rotation_error(pose, truth))
            shift = metrics.translation_error(pose, truth)
        else:
            angle = np.degrees(np.arccos(np.clip(abs(self._axis(pose) @ self._axis(truth)), 0, 1)))
            middle = self.src[np.isfinite(self.src).all(axis=1)].mean(axis=0)[None]
            shift = np.linalg.norm(pose.apply(middle) - truth.apply(middle))
        return bool(angle < self.rotation and shift < self.translation)

    def _axis(self, pose: Pose) -> np.ndarray:
        return np.asarray(pose.rotation) @ self.axis

    @cached_property
    def overlaps(self) -> list[np.ndarray]:
        """Some source points that lie on the target, for each accepted pose."""
        src, dst = (x[np.isfinite(x).all(axis=1)] for x in (self.src, self.dst))
        some = np.random.default_rng(0).permutation(src)[:SOME]
        tree = cKDTree(dst)
        return [some[tree.query(truth.apply(some))[0] < 2 * self.voxel] for truth in self.truths]

    def displacement(self, pose: Pose) -> float:
        """Tell how far a pose has the points of the overlap from where they belong, on average [length]."""
        return min(
            float(np.linalg.norm(pose.apply(x) - truth.apply(x), axis=1).mean()) if len(x) else np.inf
            for x, truth in zip(self.overlaps, self.truths, strict=True)
        )


def pairs(quick: bool) -> list[CloudPair]:
    """Every pair; a few of each kind if quick. Without the folder of real pairs: the scenes."""
    kinds: dict[str, list[CloudPair]] = {}
    for pair in chain(_real(), _elsewhere(), _wrong_models(), _mirrored(), _scenes()):
        kinds.setdefault(pair.kind, []).append(pair)
    return [pair for some in kinds.values() for pair in some[: QUICK if quick else None]]


@cache
def _listed() -> list[dict]:
    path = FOLDER / "pairs.json"
    return json.loads(path.read_text()) if path.exists() else []


@cache
def _cloud(name: str) -> np.ndarray:
    return np.load(FOLDER / f"{name}.npz")["points"].astype(np.float64)


def _real() -> Iterator[CloudPair]:
    for one in _listed():
        family = FAMILIES[one["family"]]
        truths = one.get("symmetric") or [one["T_dst_src"]]
        yield CloudPair(
            family.name,
            f"{one['dst']} {one['src']}",
            _cloud(one["src"]),
            _cloud(one["dst"]),
            tuple(Pose.from_matrix(np.array(T)) for T in truths),
            family.rotation,
            family.translation,
            family.voxel,
            seen_from_origin=one["family"] != "cranfield",
            axis=REVOLVED.get(one["src"]),
        )


def _without(kind: str, src: str, dst: str, family: str, points: np.ndarray) -> CloudPair:
    """A pair to which no answer is right."""
    known = FAMILIES[family]
    seen = family != "cranfield"
    return CloudPair(kind, f"{dst} {src}", points, _cloud(dst), (), 0.0, 0.0, known.voxel, seen)


def _clouds_of() -> dict[str, list[str]]:
    """The clouds of each place, without the parts."""
    found: dict[str, list[str]] = {}
    for one in _listed():
        if one["family"] != "cranfield":
            place = ROOM_OF.get(one["family"], one["family"])
            found[place] = sorted({*found.get(place, []), one["dst"], one["src"]})
    return found


def _elsewhere() -> Iterator[CloudPair]:
    """Clouds of two places, the source as large as the target: nine of two streets, and others."""
    places, rng = _clouds_of(), np.random.default_rng(0)
    if not places:
        return
    for k, dst in enumerate(places["kitti07_submaps"] * 3):
        src = places["kitti00"][k]
        yield _without(OTHER, src, dst, "kitti07_submaps", _cloud(src))
    names = sorted(places)
    chosen: dict[tuple[str, str], str] = {}
    while len(chosen) < OTHERS:
        a, b = rng.choice(len(names), 2, replace=False)
        src, dst = (str(rng.choice(places[names[k]])) for k in (a, b))
        chosen[src, dst] = names[b]
    for (src, dst), place in chosen.items():
        finite = (x[np.isfinite(x).all(axis=1)] for x in (_cloud(src), _cloud(dst)))
        sizes = [np.ptp(x, axis=0).max() for x in finite]
        yield _without(OTHER, src, dst, place, _cloud(src) * (sizes[1] / sizes[0]))


def _wrong_models() -> Iterator[CloudPair]:
    """Each scan of a part with two other models, of the pegs with one another.

    Seen from some sides two parts differ by less than the noise: an ``ok`` there need not be a mistake.
    """
    parts = [one for one in _listed() if one["family"] == "cranfield"]
    models = sorted({one["src"] for one in parts})
    swapped = {"cad_Square-Peg": "cad_Round-Peg", "cad_Round-Peg": "cad_Square-Peg"}
    for k, one in enumerate(parts):
        others = [x for x in models if x != one["src"]]
        chosen = {swapped.get(one["src"], others[k % len(others)]), others[(3 * k + 4) % len(others)]}
        for src in sorted(chosen):
            yield _without(WRONG_MODEL, src, one["dst"], "cranfield", _cloud(src))


def _mirrored() -> Iterator[CloudPair]:
    """Every second real pair of places, with the source as a mirror shows it."""
    for one in [x for x in _listed() if x["family"] != "cranfield"][::2]:
        mirrored = _cloud(one["src"]) * [-1, 1, 1]
        yield _without(MIRRORED, one["src"], one["dst"], one["family"], mirrored)


def _scenes() -> Iterator[CloudPair]:
    """Procedural scenes, the source moved at random."""
    for seed, scene in enumerate(scenes()):
        src, dst = scene.clouds(seed)
        rng = np.random.default_rng(seed)
        truth = Pose(tj.synthetic.draw_rotation(rng), rng.uniform(-3, 3, 3), np.float64(1))
        voxel = float(np.ptp(dst, axis=0).max()) / 80
        pair = CloudPair(
            SCENE_NAMES[scene.kind],
            scene.name,
            truth.inverse().apply(src),
            dst,
            (truth,),
            5.0,
            3 * voxel,
            voxel,
        )
        yield pair if scene.kind == PLAIN else replace(pair, truths=())
