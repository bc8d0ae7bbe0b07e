"""Pairs of scans: of one place, with a known pose, thinned or not; and of two places, without an answer."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.verdict.places import Place, Scan, places
from teaser_jax import Pose
from teaser_jax.synthetic.protocol import draw_rotation

THINNED = 4000  # points
LITTLE = 0.05  # of a cloud in the other: less is no overlap
RIGHT = 2.0  # voxels that a right answer displaces the overlap by, at most
SOME = 2000


class Pair(NamedTuple):
    """Two scans, each in a frame of its own.

    Attributes:
        kind, place: Where they were made; a fold leaves out whole places.
        name: Which pair it is.
        src, dst: Points [m].
        src_viewpoint, dst_viewpoint: Where the sensors stood [m].
        truth: ``T_dst_src``; None: they show two places.
    """

    kind: str
    place: str
    name: str
    src: np.ndarray
    dst: np.ndarray
    src_viewpoint: np.ndarray
    dst_viewpoint: np.ndarray
    truth: Pose | None

    def overlap(self, near: float) -> np.ndarray:
        """Some points of the source that have one of the target near, in the true pose."""
        if self.truth is None:
            return np.zeros((0, 3))
        some = self.src[:: max(1, len(self.src) // SOME)]
        return some[cKDTree(self.dst).query(self.truth.apply(some))[0] < near]

    def displacement(self, pose: Pose, near: float) -> float:
        """Tell how far a pose has the points of the overlap from where they belong; infinite without one."""
        points = self.overlap(near)
        if self.truth is None or len(points) < LITTLE * min(len(self.src), SOME):
            return np.inf
        return float(np.linalg.norm(pose.apply(points) - self.truth.apply(points), axis=1).mean())


def pairs(count: int) -> Iterator[Pair]:
    """All pairs of so many places of each kind."""
    last: dict[str, Place] = {}
    for place in places(count):
        for i, j in combinations(range(len(place.scans)), 2):
            yield _pair(place, place, i, j, thin=(i + j + place.seed) % 4 == 0)
        if place.kind in last:
            yield _pair(last[place.kind], place, 0, 1, thin=False)
        last[place.kind] = place


def _pair(a: Place, b: Place, i: int, j: int, *, thin: bool) -> Pair:
    rng = np.random.default_rng((a.seed, b.seed, i, j))
    (src, here), (dst, there) = _moved(rng, a.scans[i], thin), _moved(rng, b.scans[j], thin)
    same = a.seed == b.seed
    word = "thinned" if thin else "whole"
    return Pair(
        kind=a.kind,
        place=f"{a.kind} {a.seed}",
        name=f"{a.kind} {a.seed}-{b.seed}, scans {i} and {j}, {word}",
        src=src,
        dst=dst,
        src_viewpoint=np.asarray(here.translation),
        dst_viewpoint=np.asarray(there.translation),
        truth=_between(a.scans[i], b.scans[j], here, there) if same else None,
    )


def _between(a: Scan, b: Scan, here: Pose, there: Pose) -> Pose:
    """The pose between two frames, from where the sensors stood."""
    shift = Pose(np.eye(3), a.position - b.position, np.ones(()))
    return there @ shift @ here.inverse()


def _moved(rng: np.random.Generator, one: Scan, thin: bool) -> tuple[np.ndarray, Pose]:
    """Put a scan into a frame of its own."""
    frame = Pose(draw_rotation(rng), rng.uniform(-20, 20, 3), np.ones(()))
    points = rng.permutation(one.points)[: THINNED if thin else None]
    return frame.apply(points), frame
