"""Surfaces of the tests of clouds, and slow oracles that a reader can check by eye."""

from __future__ import annotations

import numpy as np

BINS = 11


def terrain(seed: int, count: int, low: float = 0.0, high: float = 20.0) -> np.ndarray:
    """Points of one rolling landscape, drawn anew with each seed."""
    rng, shape = np.random.default_rng(seed), np.random.default_rng(7)
    x, y = rng.uniform(low, high, count), rng.uniform(0, 20, count)
    waves = [
        (shape.normal() * 0.5, shape.normal() * 0.8, shape.normal() * 0.8, shape.uniform(0, 6))
        for _ in range(12)
    ]
    z = sum(size * np.sin(a * x + b * y + phase) for size, a, b, phase in waves)
    return np.stack([x, y, z], axis=1)


def rectangle(rng: np.random.Generator, count: int, corner, u, v) -> np.ndarray:
    a, b = rng.uniform(0, 1, (2, count, 1))
    return np.asarray(corner) + a * np.asarray(u) + b * np.asarray(v)


def plane(seed: int, count: int = 4000, noise: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rectangle(rng, count, [0, 0, 0], [4, 0, 0], [0, 3, 0]) + noise * rng.normal(size=(count, 3))


def sphere(seed: int, count: int = 4000) -> np.ndarray:
    points = np.random.default_rng(seed).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def cylinder(seed: int, count: int = 4000) -> np.ndarray:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.cos(angle), np.sin(angle), rng.uniform(-3, 3, count)], axis=1)


def corner(seed: int, count: int = 6000) -> np.ndarray:
    """Three walls that meet."""
    rng = np.random.default_rng(seed)
    x, y, z = np.eye(3)
    return np.concatenate(
        [rectangle(rng, count // 3, 0 * x, 2 * a, 2 * b) for a, b in ((x, y), (y, z), (z, x))]
    )


def slow_fpfh(points, normals, radius: float, local: bool) -> tuple[np.ndarray, np.ndarray]:
    """Histograms point by point, pair by pair."""
    n = len(points)
    near = [
        [j for j in range(n) if 0 < np.linalg.norm(points[j] - points[i]) <= radius and normals[j].any()]
        for i in range(n)
    ]
    own, counts = np.zeros((n, 3 * BINS)), np.zeros(n, int)
    for i in range(n):
        if not normals[i].any():
            continue
        mine = normals[i]
        if local and sum((points[j] - points[i]) @ mine for j in near[i]) > 0:
            mine = -mine
        for j in near[i]:
            theirs = -normals[j] if local and normals[j] @ mine < 0 else normals[j]
            line = (points[j] - points[i]) / np.linalg.norm(points[j] - points[i])
            u, other = mine, theirs
            if abs(mine @ line) < abs(theirs @ line):
                u, other, line = theirs, mine, -line
            v = np.cross(line, u)
            if np.linalg.norm(v) <= 1e-6:
                continue
            v = v / np.linalg.norm(v)
            w = np.cross(u, v)
            shares = (
                (np.arctan2(w @ other, u @ other) + np.pi) / (2 * np.pi),
                (v @ other + 1) / 2,
                (u @ line + 1) / 2,
            )
            for angle, share in enumerate(shares):
                own[i, angle * BINS + min(max(int(BINS * share), 0), BINS - 1)] += 1
            counts[i] += 1
        own[i] *= 100 / max(counts[i], 1)
    found = np.zeros_like(own)
    for i in range(n):
        if not counts[i]:
            continue
        shared = sum(
            (own[j] / np.sum((points[j] - points[i]) ** 2) for j in near[i] if counts[j]), np.zeros(3 * BINS)
        ).reshape(3, BINS)
        total = shared.sum(axis=1, keepdims=True)
        found[i] = own[i] + (100 * shared / np.where(total > 0, total, 1)).ravel()
    return found, counts > 0


Face = tuple  # a corner and two sides


def box(low, high) -> list[Face]:
    """The six faces of a box."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    x, y, z = np.diag(high - low)
    return [(o, u, v) for u, v, w in ((x, y, z), (y, z, x), (z, x, y)) for o in (low, low + w)]


def on_faces(seed: int, count: int, faces: list[Face], noise: float = 0.01) -> np.ndarray:
    """Points spread evenly over faces, with errors."""
    rng = np.random.default_rng(seed)
    area = np.array([np.linalg.norm(np.cross(u, v)) for _, u, v in faces])
    points = [
        rectangle(rng, max(3, int(count * a / area.sum())), *face)
        for a, face in zip(area, faces, strict=True)
    ]
    points = np.concatenate(points)
    return points + noise * rng.normal(size=points.shape)


ROOM = box([-2.5, -2, 0], [2.5, 2, 2.5])
TABLE, CUPBOARD, SHELF = (
    box([0.7, 0.8, 0], [2.3, 1.6, 0.75]),
    box([-2.3, -1.75, 0], [-1.7, -1.25, 1.9]),
    box([-1.65, 1.35, 0], [-0.75, 1.85, 1.1]),
)


def corridor(start: float, end: float, doors=(), last: float | None = None) -> list[Face]:
    """Floor, ceiling and two walls, with doors that stand out by 12 cm, and a wall at the end."""
    x, y, z = np.diag([end - start, 2.4, 2.6])
    o = np.array([start, -1.2, 0])
    faces = [(o, x, y), (o + z, x, y), (o, x, z), (o + y, x, z)]
    for at, side in doors:
        if start <= at <= end - 0.9:
            faces += box(
                [at, min(side * 1.2, side * 1.08), 0], [at + 0.9, max(side * 1.2, side * 1.08), 2.05]
            )
    if last is not None:
        faces.append((np.array([last, -1.2, 0]), y, z))
    return faces


STAIRS = [
    face
    for i in range(12)
    for face in (
        (np.array([0.3 * i, 0, 0.17 * i]), np.array([0, 1.5, 0]), np.array([0, 0, 0.17])),
        (np.array([0.3 * i, 0, 0.17 * (i + 1)]), np.array([0.3, 0, 0]), np.array([0, 1.5, 0])),
    )
]
BLOCK = box([0, 0, 0], [2, 1, 0.6]) + box([0.35, 0, 0.6], [0.85, 0.4, 1.1])
