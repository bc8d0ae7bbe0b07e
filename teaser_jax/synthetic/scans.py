"""Partial, noisy scans of a model, as a depth camera would make them, and pairs of such scans."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Real

from teaser_jax.ground.arrays import Number
from teaser_jax.pose import Pose
from teaser_jax.synthetic.models import Points, Seed, generator
from teaser_jax.synthetic.protocol import draw_rotation

Vector: TypeAlias = Float[np.ndarray, "3"]


@dataclass(frozen=True, eq=False)
class ScanPair:
    """A ``ScanPair`` holds scans of one object from two sides, each in a frame of its own.

    Rows of the two do *not* correspond.

    Attributes:
        src, dst: Points of the scans [length].
        src_viewpoint, dst_viewpoint: Where the sensor stood, in the frame of its scan [length].
        truth: ``T_dst_src``.
    """

    src: Float[np.ndarray, "n 3"]
    dst: Float[np.ndarray, "m 3"]
    src_viewpoint: Vector
    dst_viewpoint: Vector
    truth: Pose


def scan_pair(
    seed: Seed,
    model: Real[np.ndarray, "m 3"],
    *,
    n: int = 640,
    sigma: Number = 0.005,
    turn: tuple[Number, Number] = (20.0, 50.0),
    distance: Number = 10.0,
) -> ScanPair:
    """Scan a model twice, the sensor going round it by an angle drawn from ``turn``.

    Args:
        seed: Anything ``numpy.random.default_rng`` takes.
        model: (m, 3) points of the whole surface around the origin, much denser than a scan.
        n: Points of each scan.
        sigma: Standard deviation of the noise of each coordinate [length].
        turn: Range of the angle between the two directions of view [deg].
        distance: How far the sensor is from the origin of the model [length].

    Raises:
        ValueError: As ``partial_scan``.
    """
    rng = generator(seed)
    view = _unit(rng.standard_normal(3))
    axis = _unit(np.cross(view, rng.standard_normal(3)))
    angle = np.radians(rng.uniform(*turn))
    other = np.cos(angle) * view + np.sin(angle) * np.cross(axis, view)
    frames = [Pose(draw_rotation(rng), shift, np.ones(())) for shift in rng.uniform(-0.5, 0.5, (2, 3))]
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
    seed: Seed | np.random.Generator,
    model: Real[np.ndarray, "m 3"],
    view: Real[np.ndarray, "3"],
    *,
    n: int,
    sigma: Number,
    cells: int = 40,
) -> Points:
    """Scan the side of a model that is seen from a direction, with Gaussian noise.

    An orthographic depth image decides what is seen: in each of its cells the nearest points, and
    those less than one and a half cells behind them.

    Args:
        seed: A seed, or a generator to draw from.
        model: (m, 3) points of the whole surface.
        view: The direction from the model to the sensor [-].
        n: Points to draw, again and again where fewer are seen.
        sigma: Standard deviation of the noise of each coordinate [length].
        cells: Cells along the longest side of the model.

    Returns:
        (n, 3) points in the frame of the model [length].

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
    rng = generator(seed)
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
