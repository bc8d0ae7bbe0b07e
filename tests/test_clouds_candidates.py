"""From two raw clouds to a pose and a verdict, without a parameter."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_scenes import CUPBOARD, ROOM, SHELF, TABLE, on_faces, terrain
from oracles import random_pose

import teaser_jax as tj

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from teaser_jax.clouds.candidates import STAGES, Pair, candidates
from teaser_jax.clouds.cloud import as_cloud
from teaser_jax.clouds.trust.judge import judge

SCENES = {
    "landscape": (terrain(0, 30_000, 0, 20), terrain(1, 30_000, 8, 28)),
    "room": (
        on_faces(0, 30_000, ROOM + TABLE + CUPBOARD + SHELF),
        on_faces(1, 30_000, ROOM + TABLE + CUPBOARD + SHELF),
    ),
}


def answered(src: np.ndarray, dst: np.ndarray):
    """The best candidate between two clouds, judged, with its pose in their own frames."""
    a, b = as_cloud(src), as_cloud(dst)
    found = sorted(candidates(Pair(a, b)), key=lambda c: -c.score)
    assert 1 <= len(found) <= len(STAGES)
    judged = judge(found[0].pose, a.points, b.points, [c.pose for c in found[1:]])
    pose = judged.pose.copy()
    pose[:3, 3] += b.origin - pose[:3, :3] @ a.origin
    return judged, pose


@pytest.mark.parametrize("name", SCENES)
def test_two_clouds_find_one_another_wherever_they_lie(name: str):
    src, dst = SCENES[name]
    moved = random_pose(np.random.default_rng(3))
    judged, pose = answered(moved.apply(src), dst)
    assert judged.status == tj.Status.OK
    off = np.linalg.norm(moved.apply(src) @ pose[:3, :3].T + pose[:3, 3] - src, axis=1)
    assert off.max() < 2 * judged.evidence.voxel_size


def test_two_places_are_not_taken_for_one():
    judged, _ = answered(SCENES["landscape"][0], SCENES["room"][0])
    assert judged.status != tj.Status.OK


def test_the_unit_does_not_matter():
    src, dst = SCENES["landscape"]
    moved = random_pose(np.random.default_rng(4)).apply(src)
    poses = []
    for unit in (1.0, 1000.0):
        judged, pose = answered(unit * moved, unit * dst)
        assert judged.status == tj.Status.OK
        poses.append((pose[:3, :3], pose[:3, 3] / unit))
    size = judged.evidence.voxel_size / 1000
    apart = (moved @ poses[0][0].T + poses[0][1]) - (moved @ poses[1][0].T + poses[1][1])
    assert np.linalg.norm(apart, axis=1).max() < 0.1 * size
