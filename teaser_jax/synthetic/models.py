"""Models to sample points from: points, triangles, or a teapot that needs no file.

The teapot is a solid of blended primitives without any symmetry, so that its pose is unique.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int, Real

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.checks import shown

Points: TypeAlias = Float[np.ndarray, "n 3"]
Seed: TypeAlias = int | np.integer | Sequence[int] | np.random.SeedSequence


class Triangles(NamedTuple):
    """``Triangles`` are a surface to sample from: a model with any number of points.

    Attributes:
        vertices: Corners of the triangles [length].
        faces: Rows of the three vertices of each triangle.
    """

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


Shape: TypeAlias = Real[np.ndarray, "m 3"] | Triangles | None  # what points are drawn from; None: the teapot


def generator(seed: Any) -> np.random.Generator:
    """Make a generator from a seed, or pass one on. Raises ValueError for what is no seed."""
    try:
        return np.random.default_rng(seed)
    except (TypeError, ValueError):
        raise ValueError(
            f"seed is {shown(seed)}: expected a whole number, 0 or above, or several of them."
        ) from None


def sample_model(rng: np.random.Generator, n: int, model: Shape = None) -> Points:
    """Draw different points of a model, and resize them together to fit [0, 1]^3.

    Args:
        rng: Where randomness comes from.
        n: Number of points.
        model: (m, 3) points, drawn without replacement, or triangles, drawn from by area; None: the teapot.

    Returns:
        (n, 3) points, the longest side of their bounding box being 1.

    Raises:
        ValueError: If the model has fewer points than ``n``, or triangles without any area.
    """
    if isinstance(model, Triangles):
        points = sample_triangles(rng, n, model)
    else:
        pool = teapot(max(n, 20_000)) if model is None else np.asarray(model, float)
        if n > len(pool):
            raise ValueError(f"the model has {len(pool)} points, fewer than n = {n}: give Triangles instead.")
        points = pool[rng.choice(len(pool), n, replace=False)]
    low = points.min(axis=0)
    extent = (points.max(axis=0) - low).max()
    return (points - low) / (extent if extent > 0 else 1)


@functools.lru_cache(maxsize=2)
def teapot(n: int) -> Points:
    """Return ``n`` points, uniform on the surface of the teapot; always the same ones, read-only.

    The teapot stands about the origin, z up, and is some two units long.
    """
    rng, found = np.random.default_rng(0), np.zeros((0, 3))
    while len(found) < n:
        x = rng.uniform((-1, -0.7, -0.6), (1.1, 0.8, 0.8), (50_000, 3))
        x = x[np.abs(_teapot_distance(x)) < 0.05]
        value, slope = _teapot_distance(x), _teapot_slope(x)
        # A thin shell of constant thickness has as much volume where the surface has area.
        thin = np.abs(value) < 0.02 * np.linalg.norm(slope, axis=1)
        x, value, slope = x[thin], value[thin], slope[thin]
        for _ in range(3):  # Newton's method onto the surface
            x = x - (value / np.sum(slope**2, axis=1))[:, None] * slope
            value, slope = _teapot_distance(x), _teapot_slope(x)
        found = np.concatenate([found, x])
    found = found[:n]
    found.flags.writeable = False
    return found


def _teapot_distance(x: Points) -> Float[np.ndarray, " n"]:
    """Measure how far points are outside the teapot, a blend of simple solids; negative inside."""

    def ball(centre: Sequence[Number], radii: Any) -> np.ndarray:
        return (np.linalg.norm((x - centre) / radii, axis=1) - 1) * np.min(radii)

    def blend(a: np.ndarray, b: np.ndarray, width: float = 0.07) -> np.ndarray:
        share = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
        return b + (a - b) * share - width * share * (1 - share)

    body = ball((0, 0, 0), np.array([0.62, 0.62, 0.48]))
    knob = ball((0, 0, 0.54), 0.1)
    badge = ball((0.1, 0.6, 0.05), 0.12)  # on one side only: not even a mirror image fits
    ring = np.hypot(np.hypot(x[:, 0] + 0.62, x[:, 2] - 0.06) - 0.27, x[:, 1]) - 0.06
    start, along = np.array([0.4, 0, -0.12]), np.array([0.62, 0, 0.52])
    position = np.clip((x - start) @ along / (along @ along), 0, 1)
    spout = np.linalg.norm(x - start - position[:, None] * along, axis=1) - (0.15 - 0.09 * position)
    return functools.reduce(blend, (body, knob, badge, ring, spout))


def _teapot_slope(x: Points, step: float = 1e-5) -> Points:
    central = [_teapot_distance(x + e) - _teapot_distance(x - e) for e in step * np.eye(3)]
    return np.stack(central, axis=1) / (2 * step)


def sample_triangles(rng: np.random.Generator, n: int, model: Triangles) -> Points:
    """Draw points evenly from triangles, where they stand. Raises ValueError if they have no area."""
    a, b, c = np.moveaxis(np.asarray(model.vertices, float)[np.asarray(model.faces)], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    if not area.sum() > 0:
        raise ValueError("the triangles of the model have no area.")
    face = rng.choice(len(area), n, p=area / area.sum())
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))  # folds the square onto the triangle
    return a[face] + u * (b - a)[face] + v * (c - a)[face]
