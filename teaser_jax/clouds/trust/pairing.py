"""Which cells of one surface lie on the other under a pose, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.clouds.surface import Surface
from teaser_jax.ground.arrays import AnyArray, namespace

# In cells: how far a cell and the nearest one of the other surface lie apart in the overlap, how far where
# they fit, and how far along the normal; and the cosine between their normals.
NEAR, CLOSE, ACROSS, ALIGNED = 3.0, 1.5, 0.35, 0.85
DIRECTIONS = 49  # that normals are sorted into, without their sign
POSES_AT_ONCE = 256
MOST_WEIGHT = 200  # so many times the weight of a cell among all has one whose direction is rare


@dataclass(frozen=True, eq=False)
class Pairing:
    """The cells of one surface, moved onto the other, and what each of them meets there.

    Attributes:
        points: Cells of the first surface in the frame of the second [length].
        normals: Their normals there; zero where unknown.
        partner: The nearest cell of the second surface.
        partner_normals: Its normal, turned to the side of the first.
        distance: How far it is [length].
        residual: How far the cell lies before the plane of its partner [length].
        near: Which cells have one within three cells: the overlap.
        fits: Which cells lie on the other surface, with their normal along its own.
    """

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    partner: Int[np.ndarray, " n"]
    partner_normals: Float[np.ndarray, "n 3"]
    distance: Float[np.ndarray, " n"]
    residual: Float[np.ndarray, " n"]
    near: Bool[np.ndarray, " n"]
    fits: Bool[np.ndarray, " n"]

    @cached_property
    def weight(self) -> Float[np.ndarray, " n"]:
        """What each cell counts: every direction of normals the same, unless it is rare; 0 without one."""
        return direction_weights(self.normals)

    @property
    def fit(self) -> float:
        """Which part of the overlap fits, by weight [-]."""
        overlap = float(self.weight[self.near].sum())
        return float(self.weight[self.fits].sum()) / overlap if overlap > 0 else 0.0

    @property
    def count(self) -> int:
        """How many cells fit."""
        return int(np.count_nonzero(self.fits))

    @property
    def overlap(self) -> float:
        """Which part of the surface lies in the overlap [-]."""
        return float(np.mean(self.near))

    @property
    def support(self) -> float:
        """Which part of the surface fits [-]."""
        return float(np.mean(self.fits))


def pair(
    pose: Float[np.ndarray, "4 4"], src: Surface, dst: Surface, rows: Int[np.ndarray, " m"] | None = None
) -> Pairing:
    """Lay one surface onto another.

    Args:
        pose: From the source to the target frame, as both surfaces stand.
        src, dst: The surfaces, of one width of cells.
        rows: The cells of the source to ask about; None: all.
    """
    points, normals = (src.points, src.normals) if rows is None else (src.points[rows], src.normals[rows])
    there, across = moved(pose, points), normals @ pose[:3, :3].T
    return Pairing(there, across, *_compared(there, across, dst))


def _compared(
    there: Float[np.ndarray, "n 3"], across: Float[np.ndarray, "n 3"], dst: Surface
) -> tuple[np.ndarray, ...]:
    """Find the nearest cells of a surface: which, their normals, how far, and what fits there."""
    partner, distance = dst.tree.nearest(there, NEAR * dst.voxel_size)
    apart, theirs = there - dst.points[partner], dst.normals[partner]
    _, theirs, residual, fits = compared(apart, distance, across, theirs, dst.voxel_size)
    return partner, theirs, distance, residual, distance < NEAR * dst.voxel_size, fits


class Compared(NamedTuple):
    """How cells stand to the nearest ones of another surface.

    Attributes:
        cosine: Between both normals [-].
        theirs: The normal of the other surface, turned to the side of the first.
        residual: How far the cell lies before its plane [length].
        fits: Which cells lie on the other surface, with their normal along its own.
    """

    cosine: Float[AnyArray, " n"]
    theirs: Float[AnyArray, "n 3"]
    residual: Float[AnyArray, " n"]
    fits: Bool[AnyArray, " n"]


def compared(
    apart: Float[AnyArray, "n 3"],
    distance: Float[AnyArray, " n"],
    ours: Float[AnyArray, "n 3"],
    theirs: Float[AnyArray, "n 3"],
    cell: float | AnyArray,
) -> Compared:
    """Compare cells with the nearest ones of another surface. A pure function: works under jit and vmap.

    Args:
        apart: From the nearest cell to each [length].
        distance: How far that is [length].
        ours, theirs: The normals of the cells and of the nearest ones.
        cell: Width of the cells [length].
    """
    xp = namespace(apart)
    cosine = xp.sum(ours * theirs, axis=1)
    theirs = xp.where((cosine < 0)[:, None], -theirs, theirs)
    residual = xp.sum(apart * theirs, axis=1)
    fits = (distance < CLOSE * cell) & (xp.abs(residual) < ACROSS * cell) & (xp.abs(cosine) > ALIGNED)
    return Compared(cosine, theirs, residual, fits)


def moved(pose: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    """Move points by a pose."""
    return points @ pose[:3, :3].T + pose[:3, 3]


@dataclass(frozen=True, eq=False)
class Laid:
    """Two surfaces laid on one another; what is said of both ways is the smaller of the two.

    Attributes:
        pose: From the source to the target frame, as both surfaces stand.
        src, dst: The surfaces, of one width of cells.
        here, back: The source on the target, and the target on the source.
    """

    pose: Float[np.ndarray, "4 4"]
    src: Surface
    dst: Surface
    here: Pairing
    back: Pairing

    @property
    def fit(self) -> float:
        """Which part of the overlap fits, by weight [-]."""
        return min(self.here.fit, self.back.fit)

    @property
    def count(self) -> int:
        """How many cells fit."""
        return min(self.here.count, self.back.count)

    @property
    def overlap(self) -> float:
        """Which part of either surface lies in the overlap [-]."""
        return min(self.here.overlap, self.back.overlap)

    @property
    def residual(self) -> float:
        """How far the surfaces lie apart along their normals where the source fits [length]."""
        chosen = self.here.fits & (self.here.weight > 0)
        # Of the spread of a normal error, the median of its size is so small a part.
        return float(1.4826 * np.median(np.abs(self.here.residual[chosen]))) if chosen.any() else np.inf

    @property
    def support(self) -> float:
        """Which part of either surface fits [-]."""
        return min(self.here.support, self.back.support)


def lay(pose: Float[np.ndarray, "4 4"], src: Surface, dst: Surface, most: int | None = None) -> Laid:
    """Lay two surfaces on one another; ``most``: about so many cells of each, evenly chosen."""
    rows = lambda x: None if most is None else np.arange(0, len(x), max(1, len(x) // most))
    here, back = pair(pose, src, dst, rows(src)), pair(np.linalg.inv(pose), dst, src, rows(dst))
    return Laid(pose, src, dst, here, back)


def shares(
    poses: Float[np.ndarray, "k 4 4"], src: Surface, dst: Surface, rows: Int[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    """Tell which part of some cells fits under each of many poses, among those in the overlap [-].

    Where fewer than half of them lie in the overlap, half of them count.
    """
    found = []
    for some in np.split(poses, range(POSES_AT_ONCE, len(poses), POSES_AT_ONCE)):
        turns = np.swapaxes(some[:, :3, :3], 1, 2)
        there, across = src.points[rows] @ turns + some[:, None, :3, 3], src.normals[rows] @ turns
        *_, near, fits = _compared(there.reshape(-1, 3), across.reshape(-1, 3), dst)
        near, fits = near.reshape(len(some), -1), fits.reshape(len(some), -1)
        overlap = np.maximum(np.count_nonzero(near, axis=1), len(rows) / 2)
        found.append(np.count_nonzero(fits, axis=1) / overlap)
    return np.concatenate(found) if found else np.zeros(0)


def direction_weights(
    normals: Float[AnyArray, "n 3"], total: AnyArray | None = None
) -> Float[AnyArray, " n"]:
    """Weigh unit normals so that each direction counts the same: floors and roads would outvote all else.

    Normals and their opposites are one direction. Directions that few have do not count more than a
    two-hundredth of all normals would. ``total``: how many they are without padding; None: there is none.
    """
    xp = namespace(normals)
    kind = xp.argmax(xp.abs(normals @ LINES.T.astype(normals.dtype)), axis=1)
    some = xp.any(normals != 0, axis=1).astype(normals.dtype)
    length = {} if xp is np else {"length": DIRECTIONS}  # which JAX has to know
    count = xp.bincount(kind, some, minlength=DIRECTIONS, **length)
    return some / xp.maximum(count[kind], (len(normals) if total is None else total) / MOST_WEIGHT)


def _even_lines(count: int) -> Float[np.ndarray, "k 3"]:
    """Spread lines through the origin evenly: the upper half of a Fibonacci spiral."""
    height = (np.arange(count) + 0.5) / count
    angle, width = np.arange(count) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
    return np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)


LINES = _even_lines(DIRECTIONS)
