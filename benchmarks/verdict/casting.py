"""Scans of made-up places: rays of a sensor, and the first face that each meets."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.clouds.scenes import Face

FAR = 120.0  # m, that a ray reaches


def scan(
    faces: Sequence[Face], eye: np.ndarray, directions: np.ndarray, noise: float, rng: np.random.Generator
) -> np.ndarray:
    """Scan faces from a place; what a ray does not meet is left out.

    Args:
        faces: Rectangles.
        eye: Where the sensor stands [m].
        directions: (n, 3), unit vectors.
        noise: Standard deviation of each range [m].
        rng: Draws the errors.

    Returns:
        (k, 3) points, in the frame of the sensor.
    """
    nearest = np.full(len(directions), np.inf)
    for face in faces:
        normal = np.cross(face.u, face.v)
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (face.corner - eye) @ normal / (directions @ normal)
            there = eye + reach[:, None] * directions - face.corner
            along = [there @ side / (side @ side) for side in (face.u, face.v)]
            hit = (reach > 1e-6) & np.all([(a >= 0) & (a <= 1) for a in along], axis=0)
        nearest = np.where(hit & (reach < nearest), reach, nearest)
    seen = nearest < FAR
    ranges = nearest[seen] + noise * rng.standard_normal(np.count_nonzero(seen))
    return ranges[:, None] * directions[seen]


def lidar(rings: int = 48, steps: int = 720, low: float = -24.0, high: float = 10.0) -> np.ndarray:
    """Directions of a laser that turns about z, rings between two angles [deg]."""
    up, around = np.radians(np.linspace(low, high, rings)), np.linspace(0, 2 * np.pi, steps, endpoint=False)
    up, around = (x.ravel() for x in np.meshgrid(up, around))
    return np.stack([np.cos(up) * np.cos(around), np.cos(up) * np.sin(around), np.sin(up)], axis=1)


def camera(heading: float, tilt: float, width: int = 220, height: int = 165) -> np.ndarray:
    """Directions of a depth camera with a field of 100 by 84 degrees, level but for a tilt upwards [rad]."""
    across, up = np.meshgrid(np.linspace(1.2, -1.2, width), np.linspace(0.9, -0.9, height))
    rays = np.stack([np.ones_like(across), across, up], axis=-1).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    c, s = np.cos(tilt), np.sin(tilt)
    rays = rays @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    c, s = np.cos(heading), np.sin(heading)
    return rays @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
