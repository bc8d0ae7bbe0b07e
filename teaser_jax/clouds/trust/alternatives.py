"""Motions after which an overlap may fit as well: a door further on, a room the other way round."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float

from teaser_jax import so3
from teaser_jax.clouds.trust.observability import Observability
from teaser_jax.clouds.trust.pairing import LINES

SLIDES = (-6.0, -3.0, 3.0, 6.0)  # cells, along motions that the normals hardly see
TURNS = np.radians([60.0, 90.0, 120.0, 180.0, 270.0])
FIRST_SHIFT, STEP, MOST_SHIFTS = 4.0, 0.7, 150  # cells, along each axis up to half of the overlap
PARALLEL, ACROSS = 0.95, 0.3  # cosines between normals of one wall, and of walls that meet


def alternatives(
    points: Float[np.ndarray, "n 3"],
    normals: Float[np.ndarray, "n 3"],
    seen: Observability,
    cell: float,
) -> Float[np.ndarray, "k 4 4"]:
    """List motions of an overlap that may leave it fitting.

    These are slides along the three motions that the normals see least, turns about its principal axes and
    those of its walls, through its centroid and the middle of its box, and shifts along all of them.

    Args:
        points, normals: Of the cells that fit, in the target frame [length].
        seen: What their normals see.
        cell: Width of a cell [length].

    Returns:
        Motions in the target frame, to be made after the pose.
    """
    found = [*_slides(seen, cell)]
    for axes in (_principal_axes(points), _wall_axes(points, normals)):
        along = points @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
        for axis, length in zip(axes, high - low, strict=True):
            for centre in (seen.centroid, ((low + high) / 2) @ axes):
                found += [turn(axis * angle, centre) for angle in TURNS]
            found += [shift(way * axis) for way in _shifts(length, cell)]
    return np.stack(found)


def shift(by: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Make the motion that shifts points."""
    motion = np.eye(4)
    motion[:3, 3] = by
    return motion


def turn(by: Float[np.ndarray, "3"], centre: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    """Make the motion that turns points about an axis through a centre, by the length of the axis [rad]."""
    angle = float(np.linalg.norm(by))
    motion = np.eye(4)
    if angle > 0:
        quat = np.append(np.sin(angle / 2) * by / angle, np.cos(angle / 2))
        motion[:3, :3] = so3.rotation_from_quat(quat)
    motion[:3, 3] = centre - motion[:3, :3] @ centre
    return motion


def _slides(seen: Observability, cell: float) -> Iterator[Float[np.ndarray, "4 4"]]:
    for motion in seen.motions[:, :3].T:
        for cells in SLIDES:
            step = cells * cell * motion
            yield shift(step[:3]) @ turn(step[3:], seen.centroid)


def _shifts(length: float, cell: float) -> Iterator[float]:
    steps = np.arange(FIRST_SHIFT, max(length / (2 * cell), FIRST_SHIFT + 0.1), STEP)[:MOST_SHIFTS]
    for step in steps * cell:
        yield -step
        yield step


def _principal_axes(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3 3"]:
    return np.linalg.eigh(np.cov(points.T))[1].T


def _wall_axes(
    points: Float[np.ndarray, "n 3"], normals: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "3 3"]:
    """Find the directions in which walls stand: a cube has no principal axes of its own."""
    first = _commonest(normals)
    side = normals[np.abs(normals @ first) < ACROSS]
    if len(side) > 20:
        second = _commonest(side)
    else:
        principal = _principal_axes(points)
        second = principal[np.argmin(np.abs(principal @ first))]
    second = second - (second @ first) * first
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _commonest(normals: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Find the commonest direction among unit normals, whatever their sign."""
    kind = np.argmax(np.abs(normals @ LINES.T), axis=1)
    direction = LINES[np.argmax(np.bincount(kind))]
    for _ in range(5):
        cosine = normals @ direction
        close = np.abs(cosine) > PARALLEL
        if not close.any():
            break
        mean = (normals[close] * np.sign(cosine[close])[:, None]).sum(axis=0)
        direction = mean / np.linalg.norm(mean)
    return direction
