"""Made-up places, each drawn from a seed: what stands where, and three sensors that see it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

import teaser_jax as tj
from benchmarks.clouds.scenes import Face, box, corridor, faces
from benchmarks.verdict.casting import camera, lidar, scan

SCANS = 3  # of each place
CLEAR = 0.4  # m between a sensor and what stands around


class Scan(NamedTuple):
    """One scan, in the frame of its sensor.

    Attributes:
        points: (n, 3) [m].
        position: Of the sensor in the frame of the place; the axes are those of the place [m].
    """

    points: np.ndarray
    position: np.ndarray


class Place(NamedTuple):
    """Scans of one place."""

    kind: str
    seed: int
    scans: tuple[Scan, ...]


def room(rng: np.random.Generator) -> Iterator[Scan]:
    """A box room with up to eight pieces of furniture, seen by a depth camera from three corners."""
    size = rng.uniform([3.0, 2.5, 2.3], [9.0, 7.0, 3.2])
    pieces = [
        ((rng.uniform(-0.5, 0.5, 2) * (size[:2] - 0.5)).tolist(), rng.uniform(0.3, [1.8, 1.8, 2.1]))
        for _ in range(rng.integers(0, 9))
    ]
    listed = box([0, 0, 0], size) + [f for at, s in pieces for f in box([*at, 0], s)]
    for position in _free(rng, pieces, 0.4 * size[:2]):
        inward = np.arctan2(-position[1], -position[0]) + rng.normal(0, 0.5)
        yield _seen(
            listed, [*position, rng.uniform(1.0, 1.8)], camera(inward, rng.uniform(-0.1, 0.3)), 0.006, rng
        )


def hallway(rng: np.random.Generator) -> Iterator[Scan]:
    """A corridor with doors here and there; half of them end in a wall. A laser moves along it."""
    length = rng.uniform(18, 45)
    doors = [(x, int(rng.choice([-1, 1]))) for x in np.cumsum(rng.uniform(1.2, 6.0, 30)) if x < length - 2]
    wall = length if rng.random() < 0.5 else None
    listed = corridor(0, length, doors, wall)
    for x in np.sort(rng.uniform(3, length - 3, SCANS)):
        yield _seen(listed, [x, rng.uniform(-0.6, 0.6), 1.3], lidar(low=-40, high=40), 0.008, rng)


def street(rng: np.random.Generator) -> Iterator[Scan]:
    """Houses on both sides of a road, cars, poles and hedges. A laser on a car moves 3 to 20 m on."""
    listed = faces(([-80, -40, 0], [160, 0, 0], [0, 80, 0]))
    for side in (-1, 1):
        x = -80.0
        while x < 80:
            width, deep = rng.uniform(5, 16), rng.uniform(6, 12)
            back = rng.uniform(7, 11)
            if rng.random() < 0.85:
                listed += box([x + width / 2, side * (back + deep / 2), 0], [width, deep, rng.uniform(4, 14)])
            x += width + rng.uniform(0, 5)
        for x in rng.uniform(-70, 70, rng.integers(3, 12)):
            listed += box(
                [x, side * rng.uniform(4.2, 4.8), 0], [rng.uniform(3.5, 5), 1.8, rng.uniform(1.4, 2)]
            )
        for x in rng.uniform(-70, 70, rng.integers(2, 10)):
            listed += box([x, side * rng.uniform(5.5, 6.5), 0], [0.25, 0.25, rng.uniform(3, 8)])
    for x in np.cumsum([-15, *rng.uniform(3, 20, SCANS - 1)]):
        yield _seen(listed, [x, rng.uniform(-1.5, 1.5), 1.8], lidar(), 0.02, rng)


def hall(rng: np.random.Generator) -> Iterator[Scan]:
    """A hall with columns in rows, and crates, sometimes none. A laser stands in three places."""
    size = rng.uniform([18, 14, 4], [45, 30, 8])
    step = rng.uniform(4, 7, 2)
    columns = [
        ([x, y], [0.5, 0.5, size[2]])
        for x in np.arange(-size[0] / 2 + step[0], size[0] / 2 - 1, step[0])
        for y in np.arange(-size[1] / 2 + step[1], size[1] / 2 - 1, step[1])
    ]
    crates = [
        ((rng.uniform(-0.5, 0.5, 2) * (size[:2] - 2)).tolist(), rng.uniform(0.6, [2.5, 2.5, 2.5]))
        for _ in range(rng.integers(0, 14))
    ]
    listed = box([0, 0, 0], size) + [f for at, s in columns + crates for f in box([*at, 0], s)]
    for position in _free(rng, columns + crates, 0.4 * size[:2]):
        yield _seen(listed, [*position, 1.5], lidar(low=-35, high=35), 0.012, rng)


def hills(rng: np.random.Generator) -> Iterator[Scan]:
    """Open country of gentle waves, of which each scan sees a square."""
    shape = [(rng.normal(0, 0.5), *rng.normal(0, 0.8, 2), rng.uniform(0, 6)) for _ in range(12)]
    middle = np.zeros(2)
    for _ in range(SCANS):
        x, y = rng.uniform(-10, 10, (2, 40_000)) + middle[:, None]
        z = sum(size * np.sin(a * x + b * y + phase) for size, a, b, phase in shape)
        position = np.array([*middle, 3.0])
        yield Scan(np.stack([x, y, z + 0.02 * rng.standard_normal(len(x))], axis=1) - position, position)
        middle = middle + rng.uniform(-7, 7, 2)


def solid(rng: np.random.Generator) -> Iterator[Scan]:
    """A made-up object of about a meter, seen by a depth camera that goes round it."""
    points = tj.synthetic.random_solid(rng, n=200_000)
    view = rng.standard_normal(3)
    side = np.cross(view, rng.standard_normal(3))
    count = int(10 ** rng.uniform(3.7, 4.5))
    for angle in np.cumsum([0, *rng.uniform(0.3, 1.4, SCANS - 1)]):
        towards = np.cos(angle) * view / np.linalg.norm(view) + np.sin(angle) * side / np.linalg.norm(side)
        seen = tj.synthetic.partial_scan(rng, points, towards, n=count, sigma=0.002)
        yield Scan(seen - 3 * towards, 3 * towards)


KINDS: dict[str, Callable[[np.random.Generator], Iterator[Scan]]] = {
    "room": room, "corridor": hallway, "street": street, "hall": hall, "hills": hills, "solid": solid,
}  # fmt: skip


def places(count: int) -> Iterator[Place]:
    """So many places of each kind, one kind after the other each time."""
    for seed in range(count):
        for number, (kind, draw) in enumerate(KINDS.items()):
            yield Place(kind, seed, tuple(draw(np.random.default_rng((seed, number)))))


def _seen(
    listed: list[Face], position: list[float], directions: np.ndarray, noise: float, rng: np.random.Generator
) -> Scan:
    place = np.asarray(position, float)
    return Scan(scan(listed, place, directions, noise, rng), place)


def _free(rng: np.random.Generator, pieces: list[tuple], reach: np.ndarray) -> Iterator[np.ndarray]:
    """Draw positions for the sensors that no piece stands on."""
    found = 0
    while found < SCANS:
        x = rng.uniform(-1, 1, 2) * reach
        if all(np.any(np.abs(x - at) > np.asarray(size)[:2] / 2 + CLEAR) for at, size in pieces):
            found += 1
            yield x
