"""Scenes that slide, turn or repeat are never trusted, and sound ones are."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_scenes import (
    BLOCK,
    CUPBOARD,
    ROOM,
    SHELF,
    STAIRS,
    TABLE,
    box,
    corridor,
    cylinder,
    on_faces,
    plane,
    sphere,
    terrain,
)
from scipy.spatial.transform import Rotation

import teaser_jax as tj

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from teaser_jax.clouds.cloud import as_cloud
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.prepared import Prepared
from teaser_jax.clouds.trust.judge import judge

STILL = np.eye(4)
MANY = 20_000
DOORS = [(3.0 * i + 1, 1 if i % 2 else -1) for i in range(-4, 14)]


def judged(src: np.ndarray, dst: np.ndarray, pose: np.ndarray = STILL):
    """The verdict on a pose between two clouds, given in their own frames."""
    a, b = as_cloud(src), as_cloud(dst)
    near = pose.copy()
    near[:3, 3] += pose[:3, :3] @ a.origin - b.origin
    return judge(near, Pair(Prepared(a), Prepared(b)))


def faces(built: list) -> tuple[np.ndarray, np.ndarray]:
    return on_faces(0, MANY, built), on_faces(1, MANY, built)


FREE = {
    "plane": (plane(0, MANY, 0.01), plane(1, MANY, 0.01)),
    "noisy plane": (plane(0, MANY, 0.03), plane(1, MANY, 0.03)),
    "sphere": (sphere(0, MANY), sphere(1, MANY)),
    "cylinder": (cylinder(0, MANY), cylinder(1, MANY)),
    "corridor": faces(corridor(0, 20)),
    "corridor further on": (on_faces(0, MANY, corridor(0, 20)), on_faces(1, MANY, corridor(8, 28))),
    "two parallel walls": faces(
        [(np.zeros(3), *np.diag([5.0, 4, 0])[:2]), (2.5 * np.eye(3)[2], *np.diag([5.0, 4, 0])[:2])]
    ),
}


@pytest.mark.parametrize("name", FREE)
def test_what_slides_or_turns_is_degenerate(name: str):
    found = judged(*FREE[name])
    assert found.verdict.status == tj.Status.DEGENERATE
    assert found.evidence.seen.visible[0] < 0.008


EQUAL = {
    "empty room": ROOM,
    "cube": box([0, 0, 0], [1, 1, 1]),
    "stairs": STAIRS,
    "room alike after half a turn": ROOM + TABLE + box([-2.3, -1.6, 0], [-0.7, -0.8, 0.75]),
}


@pytest.mark.parametrize("name", EQUAL)
def test_what_fits_twice_is_ambiguous(name: str):
    found = judged(*faces(EQUAL[name]))
    assert found.verdict.status == tj.Status.AMBIGUOUS
    assert len(found.evidence.rivals.poses) > 0


def test_a_corridor_of_even_doors_is_never_trusted():
    for on in (0, 6, 8):
        src, dst = on_faces(0, MANY, corridor(0, 20, DOORS)), on_faces(1, MANY, corridor(on, 20 + on, DOORS))
        assert judged(src, dst).verdict.status in (tj.Status.DEGENERATE, tj.Status.AMBIGUOUS)


SOUND = {
    "furnished room": faces(ROOM + TABLE + CUPBOARD + SHELF),
    "room with a cupboard": faces(ROOM + CUPBOARD),
    "terrain": (terrain(0, MANY), terrain(1, MANY)),
    "half of a terrain": (terrain(0, MANY, 0, 20), terrain(1, MANY, 8, 28)),
}


@pytest.mark.parametrize("name", SOUND)
def test_a_sound_scene_is_trusted_where_the_pose_is_right_and_nowhere_else(name: str):
    src, dst = SOUND[name]
    found = judged(src, dst)
    assert found.verdict.status == tj.Status.OK
    assert found.evidence.displacement < found.evidence.voxel_size
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    assert judged(src, dst, turned).verdict.status != tj.Status.OK


def test_a_pose_that_is_off_by_a_voxel_is_aligned_before_it_is_judged():
    src, dst = SOUND["terrain"]
    off = np.eye(4)
    off[:3, 3] = 0.2
    found, right = judged(src, dst, off), judged(src, dst)
    assert found.verdict.status == tj.Status.OK
    # Gentle hills hold a slide loosely: what is promised is two cells.
    np.testing.assert_allclose(found.pose, right.pose, atol=right.evidence.voxel_size)


def test_the_same_clouds_get_the_same_bits():
    src, dst = SOUND["furnished room"]
    one, other = judged(src, dst), judged(src, dst)
    np.testing.assert_array_equal(one.pose, other.pose)
    assert one.evidence.fit == other.evidence.fit
    assert one.evidence.rivals.lead == other.evidence.rivals.lead


def test_a_block_is_told_from_its_turned_self():
    src, dst = faces(BLOCK)
    assert judged(src, dst).verdict.status in (tj.Status.OK, tj.Status.AMBIGUOUS)
    half = np.eye(4)
    half[:3, :3], half[:3, 3] = np.diag([-1.0, -1, 1]), [2, 1, 0]
    assert judged(src, dst, half).verdict.status != tj.Status.OK
