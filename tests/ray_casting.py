"""Scans of a town of boxes by a spinning laser: a street that leads round a block, with two corners alike."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

SIDE = 18.0  # of the loop [m]
HEIGHT = 1.7  # of the sensor above the ground


class Boxes:
    """Upright boxes: centres, half sizes and yaw angles."""

    def __init__(self, centres, halves, yaws):
        self.centres, self.halves, self.yaws = map(np.asarray, (centres, halves, yaws))

    def __add__(self, other: Boxes) -> Boxes:
        return Boxes(*(np.concatenate(x) for x in zip(self._parts, other._parts, strict=True)))

    @property
    def _parts(self):
        return self.centres, self.halves, self.yaws

    def chosen(self, mask) -> Boxes:
        return Boxes(*(x[mask] for x in self._parts))

    def half_turn(self) -> Boxes:
        """The same boxes on the other side of the middle."""
        return Boxes(self.centres * [-1, -1, 1], self.halves, self.yaws + np.pi)


def along_the_loop(s: float) -> tuple[np.ndarray, float]:
    """A place on the square loop, and the direction there, after a way of ``s``."""
    side, rest = divmod(s % (4 * SIDE), SIDE)
    start = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])[int(side)] * SIDE / 2
    yaw = side * np.pi / 2
    return start + rest * np.array([np.cos(yaw), np.sin(yaw)]), yaw


def town(seed: int, alike: float) -> Boxes:
    """Houses, cars and poles along the loop; all within ``alike`` of one corner stand at the opposite one."""
    rng = np.random.default_rng(seed)
    rows = []
    for s in np.cumsum(rng.uniform(2.2, 4.2, int(4 * SIDE / 3.2))):
        at, yaw = along_the_loop(s)
        across = np.array([-np.sin(yaw), np.cos(yaw)])
        for side in (-1, 1):
            house = rng.uniform([0.4, 0.4, 0.6], [1.8, 1.8, 3.5])
            place = at + side * (rng.uniform(3.5, 7.0) + house[1]) * across
            rows.append([*place, house[2], *house, rng.uniform(0, np.pi)])
            if rng.uniform() < 0.5:  # a car or a pole at the kerb
                small = rng.choice([[1.8, 0.8, 0.7], [0.12, 0.12, 2.5], [0.5, 0.5, 0.6]])
                there = at + side * rng.uniform(2.6, 3.4) * across + rng.normal(size=2) * 0.5
                rows.append([*there, small[2], *small, rng.uniform(0, np.pi)])
    rows = np.array(rows)
    boxes = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6])
    corner = np.array([-SIDE / 2, -SIDE / 2])
    near = lambda at: np.linalg.norm(boxes.centres[:, :2] - at, axis=1) < alike
    return boxes.chosen(~near(-corner)) + boxes.chosen(near(corner)).half_turn()


def scan(
    boxes: Boxes, pose: np.ndarray, rng: np.random.Generator, reach: float = 14.0, columns: int = 300
) -> np.ndarray:
    """Points that a laser of 32 lines sees from a pose, with noise of 1 cm, in its own frame."""
    azimuth = np.linspace(0, 2 * np.pi, columns, endpoint=False) + rng.uniform(0, 0.01)
    azimuth, elevation = np.meshgrid(azimuth, np.radians(np.linspace(-30, 25, 32)))
    rays = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1
    ).reshape(-1, 3)
    world = rays @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.where(world[:, 2] < 0, -eye[2] / world[:, 2], np.inf)  # the ground
        for centre, half, yaw in zip(boxes.centres, boxes.halves, boxes.yaws, strict=True):
            if np.linalg.norm(centre[:2] - eye[:2]) > reach + 4:
                continue
            c, s = np.cos(yaw), np.sin(yaw)
            turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
            start, way = turn @ (eye - centre), world @ turn.T
            a, b = (-half - start) / way, (half - start) / way
            enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
            hit = (enter < leave) & (enter > 0)
            depth = np.where(hit & (enter < depth), enter, depth)
    seen = depth < reach
    return (rays * (depth + rng.normal(size=len(depth)) * 0.01)[:, None])[seen]


def loop_of_scans(
    count: int, seed: int = 0, alike: float = 18.0, **how
) -> tuple[list[np.ndarray], np.ndarray]:
    """Scans round the loop, each turned about a little, and their true poses ``T_world_scan``."""
    rng = np.random.default_rng(seed)
    boxes = town(seed, alike)
    clouds, poses = [], np.tile(np.eye(4), (count, 1, 1))
    for k in range(count):
        at, yaw = along_the_loop(k * 4 * SIDE / count)
        angles = [yaw + rng.normal() * 0.1, rng.normal() * 0.02, rng.normal() * 0.02]
        poses[k, :3, :3] = Rotation.from_euler("ZYX", angles).as_matrix()
        poses[k, :3, 3] = [*(at + rng.normal(size=2) * 0.3), HEIGHT + rng.normal() * 0.05]
        clouds.append(scan(boxes, poses[k], rng, **how))
    return clouds, poses
