"""Procedural shapes: unions of simple solids, without symmetry as soon as there are a few parts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.synthetic.models import Points, Seed, generator
from teaser_jax.synthetic.protocol import draw_rotation

Kind = Literal["box", "ball", "rod", "ring", "cone"]
KINDS: tuple[Kind, ...] = get_args(Kind)
SAMPLED = 2  # times the points wanted, because those inside another part are dropped
SKIN = 1e-9  # points this far inside another part are hidden


class Part(NamedTuple):
    """A ``Part`` is a solid about the origin: it has an area, is drawn from, and tells who is inside."""

    area: float
    sample: Callable[[np.random.Generator, int], Points]
    inside: Callable[[Points], Bool[np.ndarray, " n"]]


def random_solid(
    seed: Seed | np.random.Generator,
    *,
    kinds: Sequence[Kind] = KINDS,
    parts: int | tuple[int, int] = (7, 10),
    n: int = 20_000,
) -> Points:
    """Draw points on a union of solids of random sizes, places and directions, uniform on its surface.

    Args:
        seed: A seed, or a generator to draw from.
        kinds: The kinds of parts to draw from: a family of shapes.
        parts: Their number, or the range (low, high) from which it is drawn.
        n: Number of points.

    Returns:
        (n, 3), the longest side of the bounding box being 1, around the origin.

    Raises:
        ValueError: For kinds that there are not, or no parts.
    """
    unknown = sorted(set(kinds) - set(KINDS))
    if unknown or not kinds:
        raise ValueError(f"kinds holds {unknown or 'nothing'}: expected some of {', '.join(KINDS)}.")
    low, high = (parts, parts) if isinstance(parts, int) else parts
    if not 1 <= low <= high or n < 1:
        raise ValueError(f"received parts = {parts} and n = {n}: expected at least one of each.")
    rng = generator(seed)
    placed = [
        (_PARTS[kinds[int(rng.integers(len(kinds)))]](rng), draw_rotation(rng), rng.uniform(-0.4, 0.4, 3))
        for _ in range(rng.integers(low, high + 1))
    ]
    points = np.zeros((0, 3))
    while len(points) < n:
        points = np.concatenate([points, _on_surface(rng, placed, n)])
    points = points[:n]
    lowest, highest = points.min(axis=0), points.max(axis=0)
    return (points - (lowest + highest) / 2) / (highest - lowest).max()


def _on_surface(rng: np.random.Generator, placed: list[tuple], n: int) -> Points:
    """Draw about n points of the union, in random order: of each part by area, none inside another."""
    total = sum(part.area for part, _, _ in placed)
    kept = []
    for part, turn, shift in placed:
        x = part.sample(rng, int(np.ceil(SAMPLED * n * part.area / total))) @ turn.T + shift
        others = [q for q in placed if q[0] is not part]
        hidden = [other.inside((x - moved) @ turned) for other, turned, moved in others]
        kept.append(x[~np.any(hidden, axis=0)] if hidden else x)
    points = np.concatenate(kept)
    return points[rng.permutation(len(points))]


def _signs(rng: np.random.Generator, n: int) -> Float[np.ndarray, " n"]:
    return rng.choice([-1.0, 1.0], n)


def _box(rng: np.random.Generator) -> Part:
    half = rng.uniform(0.12, 0.55, 3)
    faces = half[[1, 0, 0]] * half[[2, 2, 1]]

    def sample(rng: np.random.Generator, n: int) -> Points:
        x = rng.uniform(-1, 1, (n, 3)) * half
        axis = rng.choice(3, n, p=faces / faces.sum())
        x[np.arange(n), axis] = half[axis] * _signs(rng, n)
        return x

    return Part(8 * faces.sum(), sample, lambda x: np.all(np.abs(x) < half - SKIN, axis=1))


def _ball(rng: np.random.Generator) -> Part:
    radii = rng.uniform(0.15, 0.55, 3)
    a, b, c = radii**1.6  # Thomsen's formula for the area of an ellipsoid
    area = 4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6)

    def sample(rng: np.random.Generator, n: int) -> Points:
        def some() -> Points:
            u = rng.standard_normal((n, 3))
            u /= np.linalg.norm(u, axis=1, keepdims=True)
            return u[rng.random(n) < np.linalg.norm(u / radii, axis=1) * radii.min()]

        return _enough(some, n) * radii

    return Part(area, sample, lambda x: np.sum((x / radii) ** 2, axis=1) < 1 - SKIN)


def _rod(rng: np.random.Generator) -> Part:
    radius, half = rng.uniform(0.06, 0.25), rng.uniform(0.2, 0.6)

    def sample(rng: np.random.Generator, n: int) -> Points:
        side = rng.random(n) < 2 * half / (2 * half + radius)
        angle, r = rng.uniform(0, 2 * np.pi, n), np.where(side, 1, np.sqrt(rng.random(n))) * radius
        z = np.where(side, rng.uniform(-half, half, n), half * _signs(rng, n))
        return np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=1)

    def inside(x: Points) -> Bool[np.ndarray, " n"]:
        return (np.hypot(x[:, 0], x[:, 1]) < radius - SKIN) & (np.abs(x[:, 2]) < half - SKIN)

    return Part(2 * np.pi * radius * (2 * half + radius), sample, inside)


def _ring(rng: np.random.Generator) -> Part:
    large, small = rng.uniform(0.25, 0.5), rng.uniform(0.06, 0.15)

    def sample(rng: np.random.Generator, n: int) -> Points:
        def some() -> Points:
            u, v = rng.uniform(0, 2 * np.pi, (2, n))
            kept = rng.random(n) < (large + small * np.cos(v)) / (large + small)
            return np.stack([u[kept], v[kept], v[kept]], axis=1)

        u, v, _ = _enough(some, n).T
        r = large + small * np.cos(v)
        return np.stack([r * np.cos(u), r * np.sin(u), small * np.sin(v)], axis=1)

    def inside(x: Points) -> Bool[np.ndarray, " n"]:
        return (np.hypot(x[:, 0], x[:, 1]) - large) ** 2 + x[:, 2] ** 2 < small**2 - SKIN

    return Part(4 * np.pi**2 * large * small, sample, inside)


def _cone(rng: np.random.Generator) -> Part:
    radius, height = rng.uniform(0.15, 0.4), rng.uniform(0.4, 0.9)
    slant = np.hypot(radius, height)

    def sample(rng: np.random.Generator, n: int) -> Points:
        side = rng.random(n) < slant / (slant + radius)
        angle, share = rng.uniform(0, 2 * np.pi, n), np.sqrt(rng.random(n))  # of the way from the tip
        z = np.where(side, height * (1 - share), 0) - height / 3
        return np.stack([radius * share * np.cos(angle), radius * share * np.sin(angle), z], axis=1)

    def inside(x: Points) -> Bool[np.ndarray, " n"]:
        z = x[:, 2] + height / 3
        return (z > SKIN) & (np.hypot(x[:, 0], x[:, 1]) < radius * (1 - z / height) - SKIN)

    return Part(np.pi * radius * (slant + radius), sample, inside)


def _enough(some: Callable[[], Points], n: int) -> Points:
    """Draw rows until there are n."""
    found = some()
    while len(found) < n:
        found = np.concatenate([found, some()])
    return found[:n]


_PARTS: dict[Kind, Callable[[np.random.Generator], Part]] = {
    "box": _box, "ball": _ball, "rod": _rod, "ring": _ring, "cone": _cone,
}  # fmt: skip
