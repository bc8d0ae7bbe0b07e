"""Procedural scenes: some slide or turn on themselves, some repeat, some are plain and yet have one answer.

The clouds of a scene are drawn anew, so that no point is in both, and lie where they fit on one another.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

POINTS = 40_000
SLIDES, REPEATS, PLAIN, NOISE = "slide or turn", "repeat", "plain", "noise"
Draw = Callable[[np.random.Generator], np.ndarray]


class Face(NamedTuple):
    """A rectangle: a corner and two sides."""

    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray


class Scene(NamedTuple):
    """Two surfaces, and what is known of them beforehand.

    Attributes:
        kind: SLIDES, REPEATS, PLAIN or NOISE; only plain ones have an answer.
        src, dst: Draw the points of each.
        noise: Standard deviation of each coordinate.
    """

    kind: str
    name: str
    src: Draw
    dst: Draw
    noise: float

    def clouds(self, seed: int) -> tuple[np.ndarray, np.ndarray]:
        """Draw both clouds, with noise."""
        clouds = []
        for k, draw in enumerate((self.src, self.dst)):
            rng = np.random.default_rng((seed, k))
            points = draw(rng)
            clouds.append(points + self.noise * rng.standard_normal(points.shape))
        return clouds[0], clouds[1]


def scenes() -> Iterator[Scene]:
    """All scenes."""
    yield from _flat()
    yield from _round()
    yield from _corridors()
    yield from _rooms()
    yield from _rows()
    yield from _noise()


def faces(*listed: Sequence) -> list[Face]:
    """Rectangles from corners and sides."""
    return [Face(*(np.asarray(x, float) for x in one)) for one in listed]


def box(middle: Sequence[float], size: Sequence[float]) -> list[Face]:
    """The six faces of a box that stands on a point."""
    x, y, z = np.diag(np.asarray(size, float))
    low = np.asarray(middle, float) - (x + y) / 2
    return [Face(low + far, u, v) for u, v, w in ((x, y, z), (y, z, x), (z, x, y)) for far in (0 * w, w)]


def on(listed: list[Face], points: int = POINTS) -> Draw:
    """Points spread evenly over faces."""

    def draw(rng: np.random.Generator) -> np.ndarray:
        area = np.array([np.linalg.norm(np.cross(f.u, f.v)) for f in listed])
        face = rng.choice(len(listed), points, p=area / area.sum())
        corner, u, v = (np.array(x)[face] for x in zip(*listed, strict=True))
        a, b = rng.uniform(size=(2, points, 1))
        return corner + a * u + b * v

    return draw


def beyond(draw: Draw, low: Sequence[float], high: Sequence[float] = (np.inf,) * 3) -> Draw:
    """Only what lies within a box."""
    return lambda rng: (x := draw(rng))[((x > low) & (x < high)).all(axis=1)]


def shifted(draw: Draw, by: Sequence[float]) -> Draw:
    """The same surface elsewhere."""
    return lambda rng: draw(rng) + np.asarray(by)


def _flat() -> Iterator[Scene]:
    plane = faces(([0, 0, 0], [4, 0, 0], [0, 3, 0]))
    for noise in (0.002, 0.01, 0.03):
        yield Scene(SLIDES, f"plane, noise {noise}", on(plane), on(plane), noise)
    yield Scene(SLIDES, "planes of two sizes", on(plane), on(faces(([0, 0, 0], [6, 0, 0], [0, 2, 0]))), 0.005)
    two = lambda x: on(faces(([x, 0, 0], [5, 0, 0], [0, 4, 0]), ([x, 0, 2.5], [5, 0, 0], [0, 4, 0])))
    for x in (0, 2):
        yield Scene(SLIDES, f"floor and ceiling, {x} m on", two(0), two(x), 0.01)
    edge = lambda x: on(faces(([x, 0, 0], [6, 0, 0], [0, 0, 3]), ([x, 0, 0], [6, 0, 0], [0, 4, 0])))
    yield Scene(SLIDES, "floor and wall, 2 m on", edge(0), edge(2), 0.01)

    def wave(start: float) -> Draw:
        def draw(rng: np.random.Generator) -> np.ndarray:
            x, y = rng.uniform(start, start + 8, POINTS), rng.uniform(0, 4, POINTS)
            return np.stack([x, y, 0.15 * np.sin(2 * np.pi * x / 0.8)], axis=1)

        return draw

    yield Scene(SLIDES, "corrugated sheet, three waves on", wave(0), wave(2.4), 0.004)


def revolved(radius: Callable[[np.ndarray], np.ndarray], low: float, high: float) -> Draw:
    """A surface of revolution about z."""

    def draw(rng: np.random.Generator) -> np.ndarray:
        z, angle = rng.uniform(low, high, POINTS), rng.uniform(0, 2 * np.pi, POINTS)
        return np.stack([radius(z) * np.cos(angle), radius(z) * np.sin(angle), z], axis=1)

    return draw


def _round() -> Iterator[Scene]:
    cylinder = revolved(lambda z: 0.3 + 0 * z, -1, 1)
    for noise in (0.001, 0.01):
        yield Scene(SLIDES, f"cylinder, noise {noise}", cylinder, cylinder, noise)
    halves = beyond(cylinder, [0, -1, -9]), beyond(cylinder, [-1, 0, -9])
    yield Scene(SLIDES, "two halves of a cylinder", *halves, 0.002)
    cone = revolved(lambda z: z / 4, 0.1, 2)
    yield Scene(SLIDES, "cone", cone, cone, 0.003)
    sphere = revolved(lambda z: np.sqrt(1 - z**2), -1, 1)
    for noise in (0.002, 0.01):
        yield Scene(SLIDES, f"sphere, noise {noise}", sphere, sphere, noise)
    caps = beyond(sphere, [0, -2, -2]), beyond(sphere, [-0.3, -2, -2])
    yield Scene(SLIDES, "two caps of a sphere", *caps, 0.004)

    def torus(rng: np.random.Generator) -> np.ndarray:
        a, b = rng.uniform(0, 2 * np.pi, (2, POINTS))
        r = 1 + 0.3 * np.cos(b)
        return np.stack([r * np.cos(a), r * np.sin(a), 0.3 * np.sin(b)], axis=1)

    yield Scene(SLIDES, "torus", torus, torus, 0.005)

    def tunnel(start: float) -> Draw:
        def draw(rng: np.random.Generator) -> np.ndarray:
            angle, x = rng.uniform(-0.2 * np.pi, 1.2 * np.pi, POINTS), rng.uniform(start, start + 40, POINTS)
            vault = np.stack([x, 3 * np.cos(angle), 3 * np.sin(angle)], axis=1)
            floor = on(faces(([start, -2.43, -1.76], [40, 0, 0], [0, 4.86, 0])), POINTS // 3)(rng)
            return np.concatenate([vault, floor])

        return draw

    for x in (0, 4, 8):
        yield Scene(SLIDES, f"tunnel, {x} m on", tunnel(0), tunnel(x), 0.02)


def corridor(
    start: float, end: float, doors: Sequence[tuple[float, int]] = (), wall: float | None = None
) -> list[Face]:
    """Floor, ceiling and walls; doors on either side that stand out by 12 cm, and a wall across."""
    length, width, height = [end - start, 0, 0], [0, 2.4, 0], [0, 0, 2.6]
    listed = faces(
        ([start, -1.2, 0], length, width), ([start, -1.2, 2.6], length, width),
        ([start, -1.2, 0], length, height), ([start, 1.2, 0], length, height),
    )  # fmt: skip
    for x, side in doors:
        if start <= x <= end - 0.9:
            listed += box([x + 0.45, side * 1.14, 0], [0.9, 0.12, 2.05])
    if wall is not None and start <= wall <= end:
        listed += faces(([wall, -1.2, 0], width, height))
    return listed


def _corridors() -> Iterator[Scene]:
    even = [(3.0 * k + 1, 1 if k % 2 else -1) for k in range(-4, 14)]
    odd = [
        (0.7, 1), (3.1, 1), (4.9, -1), (8.2, -1), (9.9, 1), (13.4, 1), (14.2, -1), (17.1, 1), (21.0, -1),
        (24.2, 1), (25.7, -1),
    ]  # fmt: skip
    for kind, name, doors, shifts in (
        (SLIDES, "corridor", (), (0, 2, 8)),
        (REPEATS, "corridor with a door every 3 m", even, (0, 6, 8)),
        (PLAIN, "corridor with doors here and there", odd, (0, 4, 8)),
    ):
        for x in shifts:
            sides = (on(corridor(start, start + 20, doors)) for start in (0, x))
            yield Scene(kind, f"{name}, {x} m on", *sides, 0.01)
    for x in (0, 6):
        sides = on(corridor(0, 22 + x, wall=20)), on(corridor(x, 22 + x, wall=20))
        yield Scene(PLAIN, f"corridor with an end, {x} m on", *sides, 0.01)
    ends = on(corridor(0, 20, wall=20)), on(corridor(-8, 12))
    yield Scene(SLIDES, "corridor, an end in one cloud only", *ends, 0.01)


ROOM = box([0, 0, 0], [5, 4, 2.5])
TABLE, CUPBOARD, SHELF = (
    box([1.5, 1.2, 0], [1.6, 0.8, 0.75]),
    box([-2, -1.5, 0], [0.6, 0.5, 1.9]),
    box([-1.2, 1.6, 0], [0.9, 0.5, 1.1]),
)


def _rooms() -> Iterator[Scene]:
    for noise in (0.005, 0.02):
        yield Scene(REPEATS, f"empty room, noise {noise}", on(ROOM), on(ROOM), noise)
    cube = on(box([0, 0, 0], [4, 4, 4]))
    yield Scene(REPEATS, "room like a cube", cube, cube, 0.01)
    twins = on(ROOM + box([1.5, 1.2, 0], [0.8, 0.8, 0.75]) + box([-1.5, -1.2, 0], [0.8, 0.8, 0.75]))
    yield Scene(REPEATS, "room with two tables, a half turn apart", twins, twins, 0.01)
    halves = beyond(on(ROOM), [-9, -9, -9], [1, 9, 9]), beyond(on(ROOM), [-1, -9, -9])
    yield Scene(REPEATS, "two halves of an empty room", *halves, 0.01)
    small = on(box([0, 0, 0], [1, 1, 1]))
    yield Scene(REPEATS, "cube from outside", small, small, 0.003)
    for name, furniture in (("furniture", TABLE + CUPBOARD + SHELF), ("a cupboard", CUPBOARD)):
        room = on(ROOM + furniture)
        yield Scene(PLAIN, f"room with {name}", room, room, 0.01)
    block = on(box([0, 0, 0], [2, 1, 0.6]) + box([0.6, 0.2, 0.6], [0.5, 0.4, 0.5]))
    yield Scene(PLAIN, "block with a smaller one on it", block, block, 0.004)

    def terrain(start: float) -> Draw:
        def draw(rng: np.random.Generator) -> np.ndarray:
            hills = np.random.default_rng(7)
            x, y = rng.uniform(start, start + 20, POINTS), rng.uniform(0, 20, POINTS)
            waves = (
                0.5 * hills.normal() * np.sin(0.8 * (hills.normal() * x + hills.normal() * y) + phase)
                for phase in hills.uniform(0, 6, 12)
            )
            return np.stack([x, y, sum(waves)], axis=1)

        return draw

    yield Scene(PLAIN, "hills, of which six tenths overlap", terrain(0), terrain(8), 0.02)


def stairs(steps: int, width: float = 1.5) -> list[Face]:
    """Steps of 30 cm by 17 cm."""
    run, rise, across = [0.3, 0, 0], [0, 0, 0.17], [0, width, 0]
    return [
        face
        for k in range(steps)
        for face in faces(([0.3 * k, 0, 0.17 * k], across, rise), ([0.3 * k, 0, 0.17 * (k + 1)], run, across))
    ]


def _rows() -> Iterator[Scene]:
    """Surfaces made of equal pieces in a row."""
    for k in (0, 3):
        on_by = shifted(on(stairs(20)), [0.3 * k, 0, 0.17 * k])
        yield Scene(REPEATS, f"stairs, {k} steps on", on(stairs(20)), on_by, 0.004)
    landings = stairs(14) + faces(
        ([-2, 0, 0], [2, 0, 0], [0, 1.5, 0]), ([-2, 0, 0], [6.2, 0, 0], [0, 0, 4]),
        ([4.2, 0, 2.38], [2, 0, 0], [0, 1.5, 0]),
    )  # fmt: skip
    yield Scene(PLAIN, "stairs with landings and a wall", on(landings), on(landings), 0.005)

    def shelf(first: int) -> Draw:
        x, depth = 0.8 * first, [0, 0.4, 0]
        sides = [([x + 0.8 * k, 0, 0], depth, [0, 0, 2.2]) for k in range(10)]
        boards = [([x + 0.8 * k, 0, 0.44 * j], [0.8, 0, 0], depth) for k in range(10) for j in range(6)]
        return on(faces(*sides, *boards, ([x, 0.4, 0], [8, 0, 0], [0, 0, 2.2])))

    for k in (0, 2, 5):
        yield Scene(REPEATS, f"shelf, {k} bays on", shelf(0), shelf(k), 0.004)

    def colonnade(first: int) -> Draw:
        def draw(rng: np.random.Generator) -> np.ndarray:
            floor = on(faces(([3 * first - 1.5, -2, 0], [12, 0, 0], [0, 8, 0])), POINTS // 2)(rng)
            column = revolved(lambda z: 0.3 + 0 * z, 0, 4)(rng)
            place = rng.integers([first, 0], [first + 4, 2], (POINTS, 2))
            column[:, :2] += [3, 4] * place
            return np.concatenate([floor, column])

        return draw

    for k in (0, 1):
        yield Scene(REPEATS, f"colonnade, {k} bays on", colonnade(0), colonnade(k), 0.01)


def _noise() -> Iterator[Scene]:
    cube: Draw = lambda rng: rng.uniform(-2, 2, (POINTS, 3))
    ball: Draw = lambda rng: rng.standard_normal((POINTS, 3))
    yield Scene(NOISE, "points in a cube", cube, cube, 0.0)
    yield Scene(NOISE, "normal points", ball, ball, 0.0)
    yield Scene(NOISE, "points in a cube, and normal ones", cube, ball, 0.0)
    yield Scene(NOISE, "points in a cube, and a room", cube, on(ROOM), 0.01)
