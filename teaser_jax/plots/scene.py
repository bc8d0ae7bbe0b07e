"""What pictures and pages of two clouds show: both of them, thinned, and how far they lie apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax import so3
from teaser_jax.clouds.cloud import Cloud, as_cloud
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.clouds.trust.pairing import NEAR
from teaser_jax.clouds.voxel import cells_of, voxel_size_for
from teaser_jax.plots.panels import reach_of
from teaser_jax.pose import Pose

SATURATED = 2.0  # voxels between clouds from which on the color stays the same: what ok promises
MOST_RIVALS = 3
FEWEST = 10  # points of an overlap that has a direction
APART = 1.15  # reaches between the middles of two clouds that stand side by side
# Of a distance, from touching to two voxels: darker and redder, and to no eye the blue of the target.
RAMP = ("#f0bf3a", "#e2702c", "#8e1b45")
ALONE = "#8d939d"  # a point without a partner


class Laid(NamedTuple):
    """The source as a pose lays it onto the target.

    Attributes:
        points: Its points, about the middle of the target [length].
        distance: How far each is from the nearest point of the target; infinite beyond three voxels [length].
        words: How the pose differs from the answer; empty: it is the answer.
    """

    points: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    words: str = ""

    @property
    def paired(self) -> Bool[np.ndarray, " n"]:
        """Which points have a partner in the target."""
        return np.isfinite(self.distance)


class Matches(NamedTuple):
    """The matches that led to a pose: where they begin beside the target, where they end, which are right."""

    src: Float[np.ndarray, "m 3"]
    dst: Float[np.ndarray, "m 3"]
    inliers: Bool[np.ndarray, " m"]


class Scene(NamedTuple):
    """What is drawn of an answer; all points are about the middle of the target.

    Attributes:
        target: Points of the target.
        before: Those of the source, turned as given, and moved beside the target.
        after: The source under the pose; None: there is none.
        rivals: The source under other poses that fit nearly as well.
        matches: Those that led to the pose.
        axes: Principal axes of the overlap, longest first: rows that point right, back and up.
        voxel_size: Width of the cells of the verdict [length].
    """

    target: Float[np.ndarray, "n 3"]
    before: Float[np.ndarray, "k 3"]
    after: Laid | None
    rivals: tuple[Laid, ...]
    matches: Matches
    axes: Float[np.ndarray, "3 3"]
    voxel_size: float


def scene_of(result: CloudRegistration, most: int, src: Any = None, dst: Any = None) -> Scene:
    """Lay out what is drawn of an answer.

    Args:
        result: The answer of ``register_clouds``.
        most: How many points of each cloud to draw; they are thinned evenly, always to the same ones.
        src, dst: Clouds to draw in place of those of the answer, in the same frames.
    """
    source = result.src if src is None else as_cloud(src, "src")
    target = result.dst if dst is None else as_cloud(dst, "dst")
    some, voxel = thinned(source.points, most), result.voxel_size
    after: Laid | None = None
    rivals: tuple[Laid, ...] = ()
    if result.evidence is not None:
        lay = _layer(some, source, target, NEAR * voxel)
        after = lay(result.pose)
        others = [(pose, lay(pose)) for pose in result.equivalent[:MOST_RIVALS]]
        rivals = tuple(x._replace(words=_differs(result.pose, pose, after, x)) for pose, x in others)
    overlap = target.points if after is None else after.points[after.paired]
    axes = principal_axes(overlap if len(overlap) >= FEWEST else target.points)
    scale = float(result.pose.scale)
    reach = sum(reach_of(x @ axes.T)[0] for x in (target.points, scale * some))
    beside = -APART * reach * axes[0]
    return Scene(
        target=thinned(target.points, most),
        before=scale * some + beside,
        after=after,
        rivals=rivals,
        matches=_matches(result, lambda x: scale * (x - source.origin) + beside, target.origin),
        axes=axes,
        voxel_size=voxel,
    )


def thinned(points: Float[np.ndarray, "n 3"], most: int) -> Float[np.ndarray, "m 3"]:
    """Choose at most so many points, one in each cell of a grid, so that no part of a cloud is left bare."""
    if len(points) <= most:
        return points
    number = cells_of(points, voxel_size_for(points, most))
    first = np.sort(np.unique(number, return_index=True)[1])
    # The number of cells is met within a few percent only: some more are left out, evenly.
    return points[first[np.linspace(0, len(first) - 1, min(most, len(first))).astype(int)]]


def principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    """Find the principal axes of points, longest first: rows that point right, back and up.

    Right and up point where most of their own coordinates grow, so that two answers look alike.
    """
    right, _, up = np.linalg.svd(np.cov(points.T))[2]
    right, up = (axis * np.sign(axis[np.argmax(np.abs(axis))]) for axis in (right, up))
    return np.stack([right, np.cross(up, right), up])


def _layer(
    points: Float[np.ndarray, "n 3"], source: Cloud, target: Cloud, near: float
) -> Callable[[Pose], Laid]:
    """Make the function that lays points of the source onto the target."""
    tree = Tree(target.points)

    def lay(pose: Pose) -> Laid:
        there = np.asarray(pose.apply(points + source.origin), np.float64) - target.origin
        distance = tree.nearest(there, near)[1]
        return Laid(there, np.where(distance < near, distance, np.inf))

    return lay


def _differs(pose: Pose, other: Pose, here: Laid, there: Laid) -> str:
    """Say how another pose differs from the answer."""
    degrees = np.degrees(so3.rotation_angle(other.rotation @ pose.rotation.T))
    length = np.linalg.norm(there.points.mean(axis=0) - here.points.mean(axis=0))
    return f"turned by {degrees:.3g} deg, middle moved by {length:.3g}"


def _matches(
    result: CloudRegistration,
    place: Callable[[Float[np.ndarray, "m 3"]], Float[np.ndarray, "m 3"]],
    middle: Float[np.ndarray, "3"],
) -> Matches:
    """Take the matches from the answer that rests on them, the source's ends where it stands before."""
    found = result.registration
    if found is None:
        return Matches(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0, bool))
    src, dst = (np.asarray(x, np.float64) for x in (found.problem.src, found.problem.dst))
    return Matches(place(src), dst - middle, np.asarray(found.inliers))
