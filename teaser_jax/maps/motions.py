"""Rigid motions in numpy, one or a stack: exponential, logarithm, adjoint, and how covariances travel.

A small motion is (w, v), rotation first, to the right of a pose: T' = T Exp(w, v). So do GTSAM's ``Pose3``
and ``covariance(convention="gtsam")``.
"""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

# Poses, and covariances of small motions to the right of them; one of each, or stacks.
Way: TypeAlias = tuple[Float[np.ndarray, "*n 4 4"], Float[np.ndarray, "*n 6 6"]]


def exp(motion: Float[np.ndarray, "*n 6"]) -> Float[np.ndarray, "*n 4 4"]:
    """Turn small motions (w, v) into poses."""
    turn, shift = motion[..., :3], motion[..., 3:]
    angle2 = np.sum(turn**2, axis=-1)
    small = angle2 < 1e-8  # the series is exact to the last digit there
    safe = np.where(small, 1.0, angle2)
    angle = np.sqrt(safe)
    a = np.where(small, 0.5 - angle2 / 24, (1 - np.cos(angle)) / safe)
    b = np.where(small, 1 / 6 - angle2 / 120, (angle - np.sin(angle)) / (safe * angle))
    once = np.cross(turn, shift)
    pose = np.zeros((*motion.shape[:-1], 4, 4))
    pose[..., :3, :3] = Rotation.from_rotvec(turn.reshape(-1, 3)).as_matrix().reshape(*turn.shape, 3)
    pose[..., :3, 3] = shift + a[..., None] * once + b[..., None] * np.cross(turn, once)
    pose[..., 3, 3] = 1
    return pose


def log(pose: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6"]:
    """Turn poses into the motions (w, v) that lead to them, the angle being at most pi."""
    flat = pose[..., :3, :3].reshape(-1, 3, 3)
    turn = Rotation.from_matrix(flat).as_rotvec().reshape(*pose.shape[:-2], 3)
    t = pose[..., :3, 3]
    angle2 = np.sum(turn**2, axis=-1)
    small = angle2 < 1e-8
    half = np.sqrt(np.where(small, 1.0, angle2)) / 2
    c = np.where(small, 1 / 12 + angle2 / 720, (1 - half / np.tan(half)) / (4 * half**2))
    once = np.cross(turn, t)
    return np.concatenate([turn, t - once / 2 + c[..., None] * np.cross(turn, once)], axis=-1)


def inverse(pose: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 4 4"]:
    """Invert poses."""
    back = np.zeros(pose.shape)
    back[..., :3, :3] = np.swapaxes(pose[..., :3, :3], -1, -2)
    back[..., :3, 3] = -np.einsum("...ij,...j->...i", back[..., :3, :3], pose[..., :3, 3])
    back[..., 3, 3] = 1
    return back


def adjoint(pose: Float[np.ndarray, "*n 4 4"]) -> Float[np.ndarray, "*n 6 6"]:
    """Find the matrices that take a motion to the right of a pose to its left: T Exp(x) = Exp(Ad x) T."""
    rotation = pose[..., :3, :3]
    found = np.zeros((*pose.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = rotation
    found[..., 3:, :3] = cross(pose[..., :3, 3]) @ rotation
    return found


def cross(v: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Write the cross product with a vector as a matrix."""
    return np.cross(v[..., None, :], -np.eye(3))


def right_covariance(
    pose: Float[np.ndarray, "4 4"], covariance: Float[np.ndarray, "6 6"], centroid: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 6"]:
    """Write the covariance of an answer to two clouds as that of a small motion to the right of its pose.

    Points x of the target move by s + r x (x - c), of which the covariance is given. To the left of the pose
    that is the motion (r, s + c x r), and to its right that same motion in the axes of the source.

    Args:
        pose: ``T_dst_src``.
        covariance: Of the shift s of a centroid and the turn r about it, in the target frame, shift first
            [length, rad]: ``CloudRegistration.covariance``.
        centroid: The centroid c in the target frame [length].

    Returns:
        The covariance of (w, v), rotation first, in the axes of the source [rad, length].
    """
    back = pose[:3, :3].T
    change = np.zeros((6, 6))
    change[:3, 3:] = change[3:, :3] = back
    change[3:, 3:] = back @ cross(centroid - pose[:3, 3])
    return change @ covariance @ change.T


def chained(first: Way, second: Way) -> Way:
    """Chain uncertain poses, T_ab and T_bc, whose errors are independent, to T_ac."""
    (T_ab, C_ab), (T_bc, C_bc) = first, second
    return T_ab @ T_bc, _carried(adjoint(inverse(T_bc)), C_ab) + C_bc


def turned_round(way: Way) -> Way:
    """Invert uncertain poses."""
    return inverse(way[0]), _carried(adjoint(way[0]), way[1])


def _carried(
    change: Float[np.ndarray, "*n 6 6"], covariance: Float[np.ndarray, "*n 6 6"]
) -> Float[np.ndarray, "*n 6 6"]:
    return change @ covariance @ np.swapaxes(change, -1, -2)
