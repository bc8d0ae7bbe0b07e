"""A cloud as it is given, and what of it can be used."""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.files.clouds import read_cloud
from teaser_jax.reading import coordinates_of, positive_number, real_numbers

FEWEST = 100  # points of which a shape can be told
# Strays lie further outside the box of the middle 98 % of the points than that box is long.
TAIL = 1.0  # percent, at each end
LEAST_EXTENT, MOST_EXTENT = 1e-100, 1e100  # squares of lengths are numbers still
ASKED = 50_000  # points that tell where the middle is
ODD = (0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9)  # numbers that mix bits well


@dataclass(frozen=True)
class LeftOut:
    """How many points of a cloud were left out, and why.

    Attributes:
        not_finite: NaN or infinity among the coordinates.
        zero: At the origin, all coordinates 0: what sensors write where they saw nothing.
        cropped: Outside ``crop`` or beyond ``max_range``.
        stray: Far away from all others.
        repeated: The same as an earlier one.
    """

    not_finite: int = 0
    zero: int = 0
    cropped: int = 0
    stray: int = 0
    repeated: int = 0

    def __str__(self) -> str:
        """Say in words what was left out."""
        words = [
            f"{getattr(self, field.name)} {field.name.replace('_', ' ')}"
            for field in fields(self)
            if getattr(self, field.name)
        ]
        return ", ".join(words) or "nothing"


@dataclass(frozen=True, eq=False)
class Cloud:
    """The points of a cloud that can be used, about their middle.

    Attributes:
        points: (n, 3) float64, less ``origin`` [length].
        origin: What was taken away from the points as given, so that no digits are lost [length].
        rows: Which rows of the cloud as given these are.
        viewpoint: Where the sensor stood, less ``origin``, too; None: unknown.
        given: How many rows the cloud had.
        left_out: How many of them were left out, and why.
    """

    points: Float[np.ndarray, "n 3"]
    origin: Float[np.ndarray, "3"]
    rows: np.ndarray
    viewpoint: Float[np.ndarray, "3"] | None
    given: int
    left_out: LeftOut

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        return f"Cloud({len(self)} of {self.given} points, left out: {self.left_out})"


def as_cloud(
    value: Any,
    name: str = "cloud",
    *,
    viewpoint: Any = None,
    crop: Any = None,
    max_range: float | None = None,
) -> Cloud:
    """Read a cloud, and leave out what cannot be used.

    Args:
        value: (n, 3) numbers or more columns, of which the first three count: an array of numpy, JAX or
            torch, a structured one with fields x, y, z, a cloud of Open3D, or the path of a file. A ``Cloud``
            is returned as it is.
        name: What to call it in errors.
        viewpoint: Where the sensor stood, (3,), in the frame of the cloud [length].
        crop: The lower and the upper corner of a box; points outside are left out [length].
        max_range: Points further away from the viewpoint (from the origin, if there is none) are left
            out [length].

    Raises:
        ValueError: If it cannot be read, or fewer than 100 points are left; of files a ``FileError``.
    """
    if isinstance(value, Cloud):
        if not (viewpoint is None and crop is None and max_range is None):
            raise ValueError(f"{name} was read already: give viewpoint, crop and max_range when it is read.")
        return value
    if isinstance(value, (str, PathLike)):
        value = read_cloud(value).points
    rows = real_numbers(coordinates_of(value), name)
    if rows.ndim != 2 or rows.shape[1] < 3:
        raise ValueError(f"{name} has shape {rows.shape}: expected (n, 3), one point a row.")
    points = np.asarray(rows[:, :3], np.float64)
    eye = None if viewpoint is None else _one_point(viewpoint, "viewpoint")
    keep, counts = np.ones(len(points), bool), {}

    def leave_out(reason: str, gone: Any) -> None:
        counts[reason] = int(np.count_nonzero(keep & gone))
        keep[gone] = False

    leave_out("not_finite", ~np.isfinite(points).all(axis=1))
    leave_out("zero", (points == 0).all(axis=1))
    if crop is not None or max_range is not None:
        leave_out("cropped", _outside(points, crop, max_range, eye))
    leave_out("stray", _strays(points, keep))
    leave_out("repeated", _repeated(points, keep))
    left_out = LeftOut(**counts)
    kept = np.flatnonzero(keep)
    if len(kept) < FEWEST:
        raise ValueError(
            f"{name} has {len(kept)} points that can be used, of {len(points)} (left out: {left_out}): at "
            f"least {FEWEST} are needed."
        )
    extent = float(np.ptp(points[kept], axis=0).max())
    if not LEAST_EXTENT < extent < MOST_EXTENT:
        raise ValueError(f"{name} is {extent:.3g} across: give it in a sensible unit.")
    # Nothing is rounded: what is taken away is of the size of what it is taken from, or both are small.
    origin = np.median(points[kept], axis=0)
    eye = None if eye is None else eye - origin
    return Cloud(points[kept] - origin, origin, kept, eye, len(points), left_out)


def _one_point(value: Any, name: str) -> Float[np.ndarray, "3"]:
    point = np.asarray(real_numbers(value, name), np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ValueError(f"{name} is {value}: expected three finite numbers, in the frame of its cloud.")
    return point


def _outside(
    points: Float[np.ndarray, "n 3"], crop: Any, max_range: float | None, eye: Float[np.ndarray, "3"] | None
) -> Bool[np.ndarray, " n"]:
    """Tell which points a box or a range leaves out."""
    gone = np.zeros(len(points), bool)
    if crop is not None:
        box = np.asarray(real_numbers(crop, "crop"), np.float64)
        if box.shape != (2, 3) or not (box[0] < box[1]).all():
            raise ValueError("crop: expected the lower and the upper corner of a box, (2, 3) numbers.")
        gone |= ((points < box[0]) | (points > box[1])).any(axis=1)
    if max_range is not None:
        positive_number(max_range, "max_range")
        gone |= np.sum((points - (0 if eye is None else eye)) ** 2, axis=1) > max_range**2
    return gone


def _strays(points: Float[np.ndarray, "n 3"], keep: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Tell which points lie far away from all others: outside three times the box of the middle 98 %."""
    rows = np.flatnonzero(keep)
    if len(rows) == 0:
        return np.zeros(len(points), bool)
    some = points[rows[:: max(1, len(rows) // ASKED)]]
    low, high = np.percentile(some, [TAIL, 100 - TAIL], axis=0)
    margin = (high - low).max()
    with np.errstate(invalid="ignore"):
        return ~((points >= low - margin) & (points <= high + margin)).all(axis=1)


def _repeated(points: Float[np.ndarray, "n 3"], keep: Bool[np.ndarray, " n"]) -> Bool[np.ndarray, " n"]:
    """Tell which points are the same as an earlier one, by sorting a number that mixes the coordinates."""
    rows, gone = np.flatnonzero(keep), np.zeros(len(points), bool)
    words = np.ascontiguousarray(points[rows] + 0.0).view(np.uint64)  # of two zeros one
    number = np.zeros(len(rows), np.uint64)
    for column, odd, shift in zip(words.T, ODD, (0, 7, 9), strict=True):
        number ^= ((column ^ (column >> np.uint64(29))) * np.uint64(odd)) >> np.uint64(shift)
    ordered = np.sort(number)  # many times faster than to find the order
    if (ordered[1:] != ordered[:-1]).all():
        return gone
    order = np.argsort(number, kind="stable")
    same = (words[order[1:]] == words[order[:-1]]).all(axis=1)
    gone[rows[order[1:][same]]] = True
    return gone
