"""What poses that are equally good have in common: an axis about which a part may be turned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.clouds.trust.alternatives import turn

MARGIN = 0.10  # of the distance of the best: symmetric poses of real parts differ by 2 - 7 %
# A motion turns about an axis if it leaves it where it was.
SAME_DIRECTION, SAME_PLACE = np.radians(10.0), 0.05  # [rad], and of the size of the part
LEAST_TURN, MOST_TURN = np.radians(10.0), np.radians(170.0)  # that tell an axis: half turns are many things
FEWEST = 3  # poses about an axis, before it is worth a look
STEPS = 16  # all the way round: nuts and square pegs fit at some of them, what is round at all


class Axis(NamedTuple):
    """An axis in the frame of a part.

    Attributes:
        point: Where it passes nearest to the origin [length].
        direction: Of unit length; either way.
    """

    point: Float[np.ndarray, "3"]
    direction: Float[np.ndarray, "3"]


def shared_axis(poses: Float[np.ndarray, "k 4 4"], size: float) -> Axis | None:
    """Find the axis about which most poses differ from the first by a turn.

    Args:
        poses: From a part to a scan.
        size: Of the part [length].

    Returns:
        The axis in the frame of the part; None: fewer than three poses, the first among them, share one.
    """
    motions = np.linalg.inv(poses[0]) @ poses
    angle = np.arccos(np.clip((np.trace(motions[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    best, most = None, FEWEST - 1
    for k in np.flatnonzero((angle > LEAST_TURN) & (angle < MOST_TURN)):
        keeps = _keep(motions, _axis_of(motions[k : k + 1]), size)
        if np.count_nonzero(keeps) > most:
            best, most = keeps, int(np.count_nonzero(keeps))
    return None if best is None else _axis_of(motions[best])


def turned(pose: Float[np.ndarray, "4 4"], axis: Axis) -> Float[np.ndarray, "steps 4 4"]:
    """Turn a part about its axis, all the way round in equal steps, before a pose."""
    angles = 2 * np.pi * np.arange(STEPS) / STEPS
    return np.stack([pose @ turn(angle * axis.direction, axis.point) for angle in angles])


def _axis_of(motions: Float[np.ndarray, "k 4 4"]) -> Axis:
    """Find the axis that motions move least, by least squares."""
    moved = motions[:, :3, :3] - np.eye(3)
    direction = np.linalg.eigh(np.einsum("kji,kjl->il", moved, moved))[1][:, 0]
    # Along the axis nothing is asked of the point, and it shall be nearest to the origin.
    rows = np.concatenate([moved.reshape(-1, 3), direction[None]])
    across = motions[:, :3, 3] - (motions[:, :3, 3] @ direction)[:, None] * direction
    point = np.linalg.lstsq(rows, -np.append(across, 0.0), rcond=None)[0]
    return Axis(point, direction)


def _keep(motions: Float[np.ndarray, "k 4 4"], axis: Axis, size: float) -> Bool[np.ndarray, " k"]:
    """Tell which motions leave an axis where it is."""
    kept = motions[:, :3, :3] @ axis.direction
    place = motions[:, :3, :3] @ axis.point + motions[:, :3, 3]
    same = kept @ axis.direction > np.cos(SAME_DIRECTION)
    return same & (np.linalg.norm(place - axis.point, axis=1) < SAME_PLACE * size)
