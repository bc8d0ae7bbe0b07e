"""Graphs of poses for the tests of maps: a loop of clouds, the pairs between them, and false ones."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from teaser_jax.maps.motions import exp, inverse
from teaser_jax.maps.pair import MapPair
from teaser_jax.solution import Status

SIGMA_SHIFT, SIGMA_TURN = 0.03, 0.003


def loop_of_poses(count: int, radius: float = 20.0) -> np.ndarray:
    """``T_map_cloud`` of clouds around a circle, each looking along it, with some hills."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for k, angle in enumerate(np.linspace(0, 2 * np.pi, count, endpoint=False)):
        poses[k, :3, :3] = Rotation.from_euler("ZYX", [angle, 0.1 * np.sin(2 * angle), 0.05]).as_matrix()
        poses[k, :3, 3] = radius * np.cos(angle), radius * np.sin(angle), np.sin(3 * angle)
    return poses


def measured(truth: np.ndarray, i: int, j: int, rng: np.random.Generator, wrong=None) -> MapPair:
    """A trusted pair: the truth with noise as its covariance says, or another pose."""
    shift, turn = SIGMA_SHIFT * rng.normal(size=3), SIGMA_TURN * rng.normal(size=3)
    T = inverse(truth[i]) @ truth[j]
    centroid = T[:3, 3] / 2
    # Points x of the target move by shift + turn x (x - centroid).
    left = np.concatenate([turn, shift + np.cross(centroid, turn)])
    T = exp(left) @ T if wrong is None else wrong
    covariance = np.diag([SIGMA_SHIFT**2] * 3 + [SIGMA_TURN**2] * 3)
    return MapPair(i, j, Status.OK, None, T, covariance, centroid, 0.06, 0.3, 0.5, 1.0)


def untrusted(i: int, j: int) -> MapPair:
    wide = np.where(np.eye(6, dtype=bool), np.inf, 0.0)
    return MapPair(
        i, j, Status.NO_CONSENSUS, "fit", np.eye(4), wide, np.full(3, np.nan), np.inf, np.nan, 0.0, 1.0
    )


def loop_of_pairs(truth: np.ndarray, rng: np.random.Generator, reach: int = 2, closed: bool = True):
    """Pairs of clouds that are up to ``reach`` apart."""
    n = len(truth)
    ends = {(min(i, j % n), max(i, j % n)) for i in range(n) for j in range(i + 1, i + 1 + reach)}
    return [measured(truth, i, j, rng) for i, j in sorted(ends) if closed or j - i <= reach]


def errors_of(poses: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Distances between where clouds are and where they should be, after the frames of the first agree."""
    return np.linalg.norm(
        (inverse(truth[0]) @ truth)[:, :3, 3] - (inverse(poses[0]) @ poses)[:, :3, 3], axis=1
    )
