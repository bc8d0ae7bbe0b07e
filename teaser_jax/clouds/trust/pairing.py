"""Which cells of one surface lie on the other under a pose, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.clouds.surface import Surface

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
    """Compare cells with the nearest ones of a surface: which, their normals, how far, and what fits."""
    partner, distance = dst.tree.nearest(there, NEAR * dst.voxel_size)
    theirs = dst.normals[partner]
    cosine = np.sum(across * theirs, axis=1)
    theirs = np.where((cosine < 0)[:, None], -theirs, theirs)
    residual = np.sum((there - dst.points[partner]) * theirs, axis=1)
    cell = dst.voxel_size
    fits = (distance < CLOSE * cell) & (np.abs(residual) < ACROSS * cell) & (np.abs(cosine) > ALIGNED)
    return partner, theirs, distance, residual, distance < NEAR * cell, fits


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


def direction_weights(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, " n"]:
    """Weigh unit normals so that each direction counts the same: floors and roads would outvote all else.

    Normals and their opposites are one direction. Directions that few have do not count more than two
    hundredths of all normals would.
    """
    kind = np.argmax(np.abs(normals @ LINES.T), axis=1)
    some = np.any(normals != 0, axis=1)
    count = np.bincount(kind[some], minlength=DIRECTIONS)
    return np.where(some, 1 / np.maximum(count[kind], len(normals) / MOST_WEIGHT), 0)


def _even_lines(count: int) -> Float[np.ndarray, "k 3"]:
    """Spread lines through the origin evenly: the upper half of a Fibonacci spiral."""
    height = (np.arange(count) + 0.5) / count
    angle, width = np.arange(count) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
    return np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)


LINES = _even_lines(DIRECTIONS)
