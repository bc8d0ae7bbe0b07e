"""Where a small part lies in a scan of it: all poses are tried, the best are aligned, and both clouds judge.

Smooth parts of which a scan shows one side have hardly a descriptor in common with it. They are small,
though, and so all rotations and places can be tried: by whole numbers looked up in the field of distances
from the part, then by rounds of alignment in the same field, then by what each cloud covers of the other.
What the camera could not see of the part need not be covered; where it stood is told by the user, or the
scan tells a line of sight.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Int

from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.parts.field import Field, field_of
from teaser_jax.clouds.parts.settle import settle
from teaser_jax.clouds.parts.sight import likely_eyes
from teaser_jax.clouds.parts.sweep import lattice_of, sweep
from teaser_jax.clouds.parts.turns import even_rotations
from teaser_jax.clouds.parts.weigh import Cells, Cover, FinePart, FineScan, cover, quick_covers
from teaser_jax.clouds.sizes import padded
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.symmetry import MARGIN, Axis, shared_axis, turned
from teaser_jax.clouds.voxel import LEAST_SPACINGS, downsample, spacing, voxel_size_for

ON_ACCELERATOR = 256  # poses side by side
# Cells of the part while it is searched for, and when the answers are ranked.
CELLS, FINE_CELLS = 3000, 12_000
MOST_POINTS = 30_000  # of a scan: more tell nothing new about a part
FAR_OFF = 3.0  # cells: how far matches may lie apart
ASKED = 100  # points of a part that tell poses apart
SAME, DIFFERENT = 0.02, 0.05  # of the size of the part: displacement on average
LONERS, LONELY = 10, 3.0  # neighbours, and how much further than usual they are about stray points
# What a part must reach in its own scan: see ``Searched.ok``.
LEAST_OF_SCAN, LEAST_OF_PART = 0.9, 0.65


@dataclass(frozen=True)
class Effort:
    """How many poses a search tries, and looks at more closely.

    One of 4096 rotations lies within 12 deg of any, and the alignment in the field reaches a tenth of the
    part.

    Attributes:
        rotations: That are tried, each at 729 places.
        points: Of the scan that are looked up for each pose.
        settled: Rotations that are aligned in the field, each at its best place.
        weighed: Different poses among those that both clouds weigh.
        aligned: The best of those, which are aligned with all cells.
    """

    rotations: int = 4096
    points: int = 192
    settled: int = 1024
    weighed: int = 256
    aligned: int = 40


@dataclass(frozen=True, eq=False)
class Found:
    """A pose in which a part may lie in a scan.

    Attributes:
        pose: From the part to the scan, each about its middle, as its ``Cloud`` holds it.
        cover: How well they cover one another.
    """

    pose: Float[np.ndarray, "4 4"]
    cover: Cover


@dataclass(frozen=True, eq=False)
class Searched:
    """The poses in which a part may lie in a scan, all different, the best first.

    Attributes:
        found: At least one.
        cell: Width of the cells that distances were measured by [length].
        axis: About which the part may be turned by any angle, in its frame; None: there is no such axis.
        knows_viewpoint: Whether the viewpoint of the scan was given, and not guessed.
        seconds: What each stage took [s].
    """

    found: tuple[Found, ...]
    cell: float
    axis: Axis | None
    knows_viewpoint: bool
    seconds: dict[str, float]

    @property
    def equivalent(self) -> tuple[Found, ...]:
        """The poses that are as good as the best, itself among them: the symmetry of what the scan shows."""
        return tuple(x for x in self.found if is_as_good(x, self.found[0]))

    @property
    def ok(self) -> bool:
        """Whether this is the part in the scan: then one of the equivalent poses is right."""
        best = self.found[0].cover
        return self.knows_viewpoint and best.scan > LEAST_OF_SCAN and best.part > LEAST_OF_PART


def search(
    part: Cloud,
    scan: Cloud,
    *,
    effort: Effort = Effort(),
    threads: int = 1,
    seconds: float | None = None,
) -> Searched:
    """Find the poses in which a part may lie in a scan of one of its sides.

    Where the scan has no viewpoint, two are guessed, one on either side of it.

    Args:
        part: The whole surface of the part.
        scan: What a camera saw of it, and little else.
        effort: How much to try.
        threads: How many threads to ask neighbours with: they change no answer.
        seconds: When they are over, no further pose is aligned [s].

    Raises:
        ValueError: If all points of a cloud are the same.
    """
    end = np.inf if seconds is None else time.perf_counter() + seconds
    task = _prepared(part, scan, threads)
    with task.timed("sweep"):
        poses = _swept(task, effort)
    with task.timed("covers"):
        poses = _ranked(poses, task, effort)
    with task.timed("alignment"):
        poses = _aligned(poses, task, end)
        poses = poses[different(poses, task.part.points, SAME * task.size, len(poses))]
    with task.timed("comparison"):
        found = _compared(poses, task)
    with task.timed("symmetry"):
        found, axis = _completed(found, task, end)
    return Searched(found, task.part.voxel_size, axis, scan.viewpoint is not None, task.seconds)


@dataclass(frozen=True, eq=False)
class _Task:
    """The clouds of a search as its stages need them; the scan without strays."""

    part: Surface
    scan: Surface
    fine_part: FinePart
    fine_scan: FineScan
    part_field: Field
    scan_field: Field
    eyes: Float[np.ndarray, "e 3"]
    seconds: dict[str, float]

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Note how long something took."""
        start = time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - start

    @property
    def size(self) -> float:
        """The diagonal of the part's box [length]."""
        return float(np.linalg.norm(np.ptp(self.part.points, axis=0)))


def _prepared(part: Cloud, scan: Cloud, threads: int) -> _Task:
    """Cut both clouds into cells of one width, measure their fields, and place the camera."""
    start = time.perf_counter()
    points = _thinned(scan.points)
    cell = max(
        voxel_size_for(part.points, CELLS),
        *(LEAST_SPACINGS * spacing(Tree(x)) for x in (part.points, points)),
    )
    a, b = (Surface(downsample(x, cell), cell, threads=threads) for x in (part.points, points))
    fields = [jax.device_put(field_of(x.tree)) for x in (a, b)]
    eyes = likely_eyes(b.points, cell) if scan.viewpoint is None else scan.viewpoint[None]
    fine = max(voxel_size_for(part.points, FINE_CELLS), LEAST_SPACINGS * spacing(Tree(part.points)))
    fine_part = FinePart(Tree(part.points, threads), downsample(part.points, fine), fine)
    fine_scan = FineScan(Tree(points, threads), b.points)
    return _Task(
        a, b, fine_part, fine_scan, fields[0], fields[1], eyes, {"fields": time.perf_counter() - start}
    )


def _thinned(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Leave out points without company, as between an edge and what lies behind it, and needless ones."""
    if len(points) > MOST_POINTS:
        points = downsample(points, voxel_size_for(points, MOST_POINTS))
    around = np.sqrt(Tree(points).neighbours(points, LONERS).squared[:, -1])
    return points[around <= LONELY * np.median(around)]


def _swept(task: _Task, effort: Effort) -> Float[np.ndarray, "k 4 4"]:
    """Try all rotations at all places, and let the best settle: poses from the part to the scan."""
    cells = task.scan.points
    order = np.random.default_rng(0).permutation(len(cells))
    some = cells[np.resize(order, effort.points)]
    middle = some.mean(axis=0)
    some = (some - middle).astype(np.float32)
    rotations = even_rotations(effort.rotations).astype(np.float32)
    lattice = lattice_of(task.part_field)
    total, place = (np.asarray(x) for x in sweep(lattice, some, rotations, at_once=_at_once()))
    best = np.argsort(total, kind="stable")[: effort.settled]
    shifts = lattice.places[place[best]].astype(np.float32)
    rows, _ = padded(task.part.points)
    settled = settle(task.part_field, rows, some, rotations[best], shifts)
    rotation, shift = (np.asarray(x, np.float64) for x in settled)
    poses = np.tile(np.eye(4), (len(best), 1, 1))
    poses[:, :3, :3] = np.swapaxes(rotation, 1, 2)
    poses[:, :3, 3] = middle - np.einsum("kji,kj->ki", rotation, shift)
    return poses


def _ranked(poses: Float[np.ndarray, "k 4 4"], task: _Task, effort: Effort) -> Float[np.ndarray, "m 4 4"]:
    """Keep of many poses the different ones, and of these the ones that cover best, the best first."""
    poses = poses[different(poses, task.part.points, SAME * task.size, effort.weighed)]
    rows = np.resize(poses, (effort.weighed, 4, 4))  # one program
    rotations = np.swapaxes(rows[:, :3, :3], 1, 2)
    shifts = -np.einsum("kij,kj->ki", rotations, rows[:, :3, 3])
    covers = quick_covers(
        task.part_field,
        task.scan_field,
        Cells(*padded(task.part.points)),
        Cells(*padded(task.scan.points)),
        task.eyes.astype(np.float32),
        np.float32(task.part.voxel_size),
        rotations.astype(np.float32),
        shifts.astype(np.float32),
        at_once=_at_once(),
    )
    poses = poses[np.argsort(np.asarray(covers.distance)[: len(poses)], kind="stable")]
    return poses[different(poses, task.part.points, DIFFERENT * task.size, effort.aligned)]


def _aligned(poses: Float[np.ndarray, "k 4 4"], task: _Task, end: float) -> Float[np.ndarray, "m 4 4"]:
    """Align poses while there is time, the first in any case."""
    done: list[Float[np.ndarray, "4 4"]] = []
    for pose in poses:
        if not done or time.perf_counter() < end:
            done.append(np.linalg.inv(align(np.linalg.inv(pose), task.scan, task.part, reach=FAR_OFF)))
    return np.stack(done)


def _compared(poses: Float[np.ndarray, "k 4 4"], task: _Task) -> tuple[Found, ...]:
    """Weigh poses by all points, the best first."""
    found = [
        Found(pose, cover(pose, task.fine_part, task.fine_scan, task.eyes, task.part.voxel_size))
        for pose in poses
    ]
    return tuple(sorted(found, key=lambda x: x.cover.distance))


def _completed(found: tuple[Found, ...], task: _Task, end: float) -> tuple[tuple[Found, ...], Axis | None]:
    """Turn the best pose about the axis that the equally good ones share, if they do.

    Returns:
        All poses that are different, the best first, and the axis if every turn about it is as good.
    """
    axis = shared_axis(np.stack([x.pose for x in found if is_as_good(x, found[0])]), task.size)
    if axis is not None and time.perf_counter() < end:
        around = turned(found[0].pose, axis)
        more = _compared(around, task)
        if not all(is_as_good(x, found[0]) for x in more):
            axis, more = None, _compared(_aligned(around, task, end), task)
        found = tuple(sorted((*found, *more), key=lambda x: x.cover.distance))
    else:
        axis = None
    poses = np.stack([x.pose for x in found])
    return tuple(
        found[k] for k in different(poses, task.part.points, DIFFERENT * task.size, len(poses))
    ), axis


def is_as_good(found: Found, best: Found) -> bool:
    """Tell whether a pose is as good as the best."""
    return found.cover.distance <= (1 + MARGIN) * best.cover.distance


def different(
    poses: Float[np.ndarray, "k 4 4"], points: Float[np.ndarray, "n 3"], least: float, most: int
) -> Int[np.ndarray, " m"]:
    """Choose poses that displace some points from where the ones before put them.

    Args:
        poses: The better ones first.
        points: That are moved [length].
        least: By how much, on average [length].
        most: How many to choose.
    """
    some = points[:: max(1, len(points) // ASKED)]
    spots = some @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    kept: list[int] = []
    for k, spot in enumerate(spots):
        if len(kept) < most and (np.linalg.norm(spots[kept] - spot, axis=2).mean(axis=1) > least).all():
            kept.append(k)
    return np.array(kept)


def _at_once() -> int | None:
    """Tell how many poses to try side by side: a CPU is fastest with one after the other."""
    return None if jax.default_backend() == "cpu" else ON_ACCELERATOR
