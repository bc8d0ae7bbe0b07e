"""Partial, noisy scans of a model, as a depth camera would make them, and pairs of such scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from teaser_jax.pose import Pose
from teaser_jax.synthetic.models import Points, Seed
from teaser_jax.synthetic.protocol import random_rotation

Vector = Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class ScanPair:
    """Two scans of one object from two sides, each in a frame of its own; rows do *not* correspond.

    Attributes:
        src, dst: Points.
        src_viewpoint, dst_viewpoint: Where the sensor stood, in the frame of its scan.
        truth: ``T_dst_src``.
    """

    src: Points
    dst: Points
    src_viewpoint: Vector
    dst_viewpoint: Vector
    truth: Pose


def scan_pair(
    seed: Seed,
    model: Points,
    *,
    n: int = 640,
    sigma: float = 0.005,
    turn: tuple[float, float] = (20.0, 50.0),
    distance: float = 10.0,
) -> ScanPair:
    """Two scans of a model, the sensor going round it by an angle drawn from ``turn``.

    Args:
        seed: Anything ``numpy.random.default_rng`` takes.
        model: (m, 3) points of the whole surface around the origin, much denser than a scan.
        n: Points of each scan.
        sigma: Standard deviation of the noise of each coordinate.
        turn: Range of the angle between the two directions of view [deg].
        distance: Of the sensor from the origin of the model.

    Raises:
        ValueError: As ``partial_scan``.
    """
    rng = np.random.default_rng(seed)
    view = _unit(rng.standard_normal(3))
    axis = _unit(np.cross(view, rng.standard_normal(3)))
    angle = np.radians(rng.uniform(*turn))
    other = np.cos(angle) * view + np.sin(angle) * np.cross(axis, view)
    frames = [Pose(random_rotation(rng), shift, np.ones(())) for shift in rng.uniform(-0.5, 0.5, (2, 3))]
    scans = [
        pose.apply(partial_scan(rng, model, direction, n=n, sigma=sigma))
        for pose, direction in zip(frames, (view, other), strict=True)
    ]
    sensors = [
        pose.apply(distance * direction[None])[0]
        for pose, direction in zip(frames, (view, other), strict=True)
    ]
    return ScanPair(scans[0], scans[1], sensors[0], sensors[1], frames[1] @ frames[0].inverse())


def partial_scan(
    seed: Seed | np.random.Generator, model: Points, view: Vector, *, n: int, sigma: float, cells: int = 40
) -> Points:
    """``n`` points of the side of a model that is seen from a direction, with Gaussian noise.

    An orthographic depth image decides what is seen: in each of its cells the nearest points, and
    those less than one and a half cells behind them.

    Args:
        seed: A seed, or a generator to draw from.
        model: (m, 3) points of the whole surface.
        view: From the model to the sensor.
        n: Points to draw, again and again where fewer are seen.
        sigma: Standard deviation of the noise of each coordinate.
        cells: Cells along the longest side of the model.

    Raises:
        ValueError: If the model is no (m, 3) array of points, n or the view is nothing, or sigma below 0.
    """
    model = np.asarray(model, float)
    if model.ndim != 2 or model.shape[1] != 3 or not len(model):
        raise ValueError(f"the model has shape {model.shape}: expected (m, 3), one point a row.")
    if n < 1 or sigma < 0 or not np.linalg.norm(view) > 0:
        raise ValueError(
            f"received n = {n}, sigma = {sigma} and view = {view}: expected n above 0, sigma 0 or above, and "
            "a direction."
        )
    rng = np.random.default_rng(seed)
    view = _unit(np.asarray(view, float))
    across = _unit(np.cross(view, rng.standard_normal(3)))
    cell = max(float(np.ptp(model, axis=0).max()), np.finfo(float).tiny) / cells
    image = model @ np.stack([across, np.cross(view, across)], axis=1)
    row, column = np.floor((image - image.min(axis=0)) / cell).astype(int).T
    depth, place = model @ view, row * (2 * cells + 2) + column  # the image is at most sqrt(3) sides wide
    nearest = np.full(place.max() + 1, -np.inf)
    np.maximum.at(nearest, place, depth)
    seen = np.flatnonzero(depth > nearest[place] - 1.5 * cell)
    chosen = rng.choice(seen, n, replace=len(seen) < n)
    return model[chosen] + sigma * rng.standard_normal((n, 3))


def _unit(vector: Vector) -> Vector:
    return vector / np.linalg.norm(vector)
