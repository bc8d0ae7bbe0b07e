"""Small parts: found in a scan of one side of them, with their symmetries, and where no search is made."""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from cloud_scenes import BLOCK, CUPBOARD, ROOM, TABLE, box, on_faces, terrain
from oracles import random_pose

from teaser_jax.so3 import rotation_angle

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from teaser_jax.clouds.cloud import Cloud, as_cloud
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.parts.closed import closedness, which_is_part
from teaser_jax.clouds.parts.field import CAPACITY, LEVELS, REACH, distances, field_of
from teaser_jax.clouds.parts.search import Effort, Searched, search
from teaser_jax.clouds.parts.settle import settle
from teaser_jax.clouds.parts.sight import likely_eyes, visible
from teaser_jax.clouds.parts.sweep import lattice_of, sweep
from teaser_jax.clouds.parts.turns import even_rotations
from teaser_jax.clouds.sizes import padded
from teaser_jax.clouds.symmetry import STEPS, Axis, shared_axis, turned
from teaser_jax.clouds.trust.pairing import moved
from teaser_jax.synthetic.scans import partial_scan

F32 = np.float32
VIEW = np.array([0.5, 0.3, 0.8])
# Programs are not optimised in tests, and these parts are easy.
EASY = Effort(rotations=600, points=64, settled=128, weighed=64, aligned=16)
DISTANCE = 6.0  # of the camera, for parts two units long
SQUARE = box([-1, -0.25, -0.25], [1, 0.25, 0.25])


def rod(seed: int, count: int) -> np.ndarray:
    """A round rod along x with flat ends."""
    rng = np.random.default_rng(seed)
    angle, along = rng.uniform(0, 2 * np.pi, count), rng.uniform(-1, 1, count)
    radius = np.full(count, 0.4)
    ends = rng.uniform(size=count) < 0.17
    along[ends], radius[ends] = np.sign(along[ends]), 0.4 * np.sqrt(rng.uniform(size=ends.sum()))
    return np.stack([along, radius * np.cos(angle), radius * np.sin(angle)], axis=1)


PARTS = {
    "block": on_faces(0, 30_000, BLOCK, 0.0),
    "square": on_faces(0, 30_000, SQUARE, 0.0),
    "rod": rod(0, 30_000),
}


def scanned(name: str, knows_viewpoint: bool = True) -> tuple[Cloud, Cloud, np.ndarray]:
    """A part, a scan of one side of it that lies somewhere, and the pose between their frames."""
    pose = random_pose(np.random.default_rng(5))
    points = PARTS[name]
    view = VIEW / np.linalg.norm(VIEW)
    scan = pose.apply(partial_scan(3, points, view, n=4000, sigma=0.01, cells=80))
    eye = pose.apply((points.mean(axis=0) + DISTANCE * view)[None])[0]
    part = as_cloud(points[::2])
    dst = as_cloud(scan, viewpoint=eye if knows_viewpoint else None)
    truth = np.array(pose.matrix, np.float64)
    truth[:3, 3] += truth[:3, :3] @ part.origin - dst.origin
    return part, dst, truth


@cache
def found(name: str) -> Searched:
    return search(*scanned(name)[:2], effort=EASY)


def off(pose: np.ndarray, truth: np.ndarray, points: np.ndarray) -> float:
    return float(np.linalg.norm(moved(pose, points) - moved(truth, points), axis=1).max())


@pytest.mark.parametrize("knows_viewpoint", [True, False])
def test_a_part_is_found_in_its_scan(knows_viewpoint: bool):
    part, scan, truth = scanned("block", knows_viewpoint)
    answer = found("block") if knows_viewpoint else search(part, scan, effort=EASY)
    assert off(answer.found[0].pose, truth, part.points) < 0.05  # of 2.4, with errors of 0.01
    assert len(answer.equivalent) == 1
    assert answer.axis is None
    assert answer.found[0].cover.scan > 0.97
    assert answer.ok == answer.knows_viewpoint == knows_viewpoint


def test_all_poses_of_a_square_rod_are_found():
    part, _, truth = scanned("square")
    turns = [np.diag([a, b, a * b, 1.0]) for a in (1, -1) for b in (1, -1)]
    turns += [
        np.array([[a, 0, 0, 0], [0, 0, b, 0], [0, -a * b, 0, 0], [0, 0, 0, 1.0]])
        for a in (1, -1)
        for b in (1, -1)
    ]
    about = np.eye(4)
    about[:3, 3] = part.origin
    poses = [x.pose for x in found("square").equivalent]
    assert len(poses) == 8
    for turn in turns:
        other = truth @ np.linalg.inv(about) @ turn @ about
        assert min(off(pose, other, part.points) for pose in poses) < 0.1
    assert found("square").axis is None


def test_a_round_rod_has_an_axis():
    part, _, _ = scanned("rod")
    axis = found("rod").axis
    assert axis is not None
    assert abs(axis.direction[0]) > np.cos(np.radians(2))
    point = axis.point + part.origin
    assert np.linalg.norm(point - (point @ axis.direction) * axis.direction) < 0.02


def test_a_wrong_part_is_not_taken_for_the_right_one():
    scan = scanned("block")[1]
    wrong = search(scanned("rod")[0], scan, effort=EASY)
    assert not wrong.ok
    assert wrong.found[0].cover.distance > 1.5 * found("block").found[0].cover.distance


def test_same_clouds_same_bits():
    part, scan, _ = scanned("square")
    again = search(part, scan, effort=EASY, threads=2)
    first = [x.pose.tobytes() for x in found("square").found]
    assert [x.pose.tobytes() for x in again.found] == first


@pytest.mark.long
def test_a_search_ends_when_its_time_is_over():
    part, scan, _ = scanned("block")
    assert len(search(part, scan, effort=EASY, seconds=0.0).found) == 1


def test_found_poses_are_different():
    part, _, _ = scanned("block")
    poses = [x.pose for x in found("block").found]
    size = np.linalg.norm(np.ptp(part.points, axis=0))
    for k, pose in enumerate(poses):
        for other in poses[:k]:
            assert (
                np.linalg.norm(moved(pose, part.points) - moved(other, part.points), axis=1).mean()
                > 0.04 * size
            )


AXIS = Axis(np.array([0.3, 0.0, -0.1]), np.array([0.0, 1.0, 0.0]))


def test_poses_that_turn_about_an_axis_share_it():
    pose = random_pose(np.random.default_rng(2)).matrix
    half = np.diag([1.0, -1.0, -1.0, 1.0])  # turns the axis round
    poses = turned(np.array(pose), AXIS)
    assert len(poses) == STEPS
    found = shared_axis(np.concatenate([poses[[0, 2, 5, 11]], poses[:2] @ half]), 1.0)
    assert found is not None
    assert abs(found.direction @ AXIS.direction) == pytest.approx(1, abs=1e-9)
    np.testing.assert_allclose(found.point, AXIS.point, atol=1e-9)
    np.testing.assert_allclose(
        moved(poses[5], AXIS.point[None]), moved(poses[0], AXIS.point[None]), atol=1e-9
    )


@pytest.mark.parametrize("rows", [[0], [0, 3], [0, 8]])
def test_two_poses_share_no_axis_worth_a_look(rows: list[int]):
    assert shared_axis(turned(np.eye(4), AXIS)[rows], 1.0) is None


def test_poses_that_differ_by_shifts_or_at_random_share_no_axis():
    rng = np.random.default_rng(3)
    assert shared_axis(np.stack([np.array(random_pose(rng).matrix) for _ in range(5)]), 1.0) is None
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.arange(5)
    assert shared_axis(poses, 1.0) is None


def test_bodies_are_told_from_scans():
    for name in ("block", "rod"):
        part, scan, _ = scanned(name)
        assert which_is_part(part, scan) == "src"
        assert which_is_part(scan, part) == "dst"
        assert which_is_part(part, part) is None
        assert which_is_part(scan, scan) is None
    assert closedness(PARTS["block"]) > 0.6


def test_rooms_and_landscapes_are_not_searched():
    room, land = as_cloud(on_faces(0, 8000, ROOM + TABLE + CUPBOARD)), as_cloud(terrain(0, 8000))
    part, scan, _ = scanned("block")
    for other in (room, land):
        assert which_is_part(other, other) is None
    assert which_is_part(part, land) is None  # larger than the part
    assert which_is_part(room, as_cloud(terrain(0, 5000, 0, 2), viewpoint=[1.0, 10.0, 0.0])) is None


def test_the_field_is_the_distance_to_the_nearest_point():
    rng = np.random.default_rng(0)
    points, asked = rng.normal(size=(300, 3)), rng.uniform(-4, 4, (2000, 3))
    field = field_of(Tree(points))
    assert np.prod(field.shape) <= CAPACITY
    slow = np.sqrt(((asked[:, None] - points[None]) ** 2).sum(axis=2)).min(axis=1)
    reach = REACH * field.width
    quick = np.asarray(distances(jnp_field(field), jnp.asarray(asked, F32)))
    # Half the diagonal of a voxel, and half a level.
    assert np.abs(quick - np.minimum(slow, reach)).max() < (0.87 + REACH / LEVELS) * field.width


def jnp_field(field):
    return type(field)(*(jnp.asarray(x) for x in field))


@pytest.mark.parametrize("shape", [[1, 1, 1], [1, 0.05, 0.05], [1, 1, 0.02]])
def test_the_field_of_any_box_fits(shape: list[float]):
    points = np.random.default_rng(0).uniform(-1, 1, (500, 3)) * shape
    assert np.prod(field_of(Tree(points)).shape) <= CAPACITY


def test_points_in_one_place_have_no_field():
    with pytest.raises(ValueError, match="no shape"):
        field_of(Tree(np.ones((5, 3))))


def test_a_sweep_is_what_a_slow_one_finds():
    rng = np.random.default_rng(1)
    part = on_faces(0, 1000, BLOCK, 0.0) - [1, 0.5, 0.5]
    field = jnp_field(field_of(Tree(part)))
    lattice = lattice_of(field)
    points, rotations = (rng.normal(size=(20, 3)) * 0.6).astype(F32), even_rotations(12).astype(F32)
    total, place = sweep(lattice, jnp.asarray(points), jnp.asarray(rotations), at_once=None)
    batched = sweep(lattice, jnp.asarray(points), jnp.asarray(rotations), at_once=5)
    np.testing.assert_array_equal(total, batched[0])
    np.testing.assert_array_equal(place, batched[1])
    unit = float(field.width) * REACH / LEVELS
    for k, rotation in enumerate(rotations):
        there = (points @ rotation.T)[None] + lattice.places[:, None]
        table = np.asarray(distances(field, jnp.asarray(there, F32))).sum(axis=1) / unit
        # Of the two grids the voxels do not have the same middles.
        assert abs(table[int(place[k])] - int(total[k])) < 20 * LEVELS / REACH
        assert table[int(place[k])] < table.min() + 20 * LEVELS / REACH


def test_even_rotations_leave_no_large_gap():
    rotations = even_rotations(4096)
    np.testing.assert_allclose(
        rotations @ np.swapaxes(rotations, 1, 2), np.tile(np.eye(3), (4096, 1, 1)), atol=1e-12
    )
    rng = np.random.default_rng(0)
    gaps = []
    for _ in range(200):
        asked = np.array(random_pose(rng).rotation)
        gaps.append(np.degrees(rotation_angle(rotations @ asked.T).min()))
    assert max(gaps) < 13
    assert np.mean(gaps) < 9


def test_poses_settle_where_the_scan_lies_on_the_part():
    part, scan, truth = scanned("block")
    cells, some = part.points[::5], scan.points[::30].astype(F32)
    field = jnp_field(field_of(Tree(cells)))
    start = np.linalg.inv(truth)
    turn = even_rotations(4096)
    near = turn[np.argsort(rotation_angle(turn))[:8]]
    rows, _ = padded(cells)
    rotations, shifts = settle(
        field,
        jnp.asarray(rows),
        jnp.asarray(some),
        jnp.asarray(near @ start[:3, :3], F32),
        jnp.asarray(near @ start[:3, 3] + 0.05, F32),
    )
    before = [
        np.linalg.norm(moved(start, some) @ (turn - np.eye(3)).T + 0.05, axis=1).mean() for turn in near
    ]
    after = [
        np.linalg.norm(some @ rotation.T + shift - moved(start, some), axis=1).mean()
        for rotation, shift in zip(np.asarray(rotations), np.asarray(shifts), strict=True)
    ]
    assert np.max(np.array(after) / before) < 0.6
    assert np.mean(after) < 0.4 * np.mean(before)


def test_a_camera_sees_the_front_of_a_ball():
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    rows, mask = padded(points)
    eye = np.array([0, 0, 5.0])
    seen = np.asarray(visible(jnp.asarray(rows), jnp.asarray(mask), jnp.asarray(eye, F32), F32(0.2)))[:3000]
    faces = np.sum(points * (eye - points), axis=1) > 0
    assert np.mean(seen == faces) > 0.88
    assert not seen[points[:, 2] < -0.2].any()


def test_a_scan_tells_its_line_of_sight():
    _, scan, _ = scanned("block")
    eyes = likely_eyes(scan.points, 0.07)
    middle = (scan.points.min(axis=0) + scan.points.max(axis=0)) / 2
    line, true = eyes[0] - middle, scan.viewpoint - middle
    assert abs(line @ true) / np.linalg.norm(line) / np.linalg.norm(true) > np.cos(np.radians(25))
    np.testing.assert_allclose(eyes.mean(axis=0), middle, atol=1e-9)


@pytest.mark.long
def test_a_real_part_is_found(data_dir: Path):
    folder = data_dir / "cloud_pairs"
    pairs = json.loads((folder / "pairs.json").read_text())
    pair = next(p for p in pairs if p["dst"] == "cran_Separator_1")
    part, scan = (as_cloud(np.load(folder / f"{pair[name]}.npz")["points"]) for name in ("src", "dst"))
    assert which_is_part(part, scan) == "src"
    answer = search(part, scan, effort=EASY)
    assert not answer.ok  # nobody said where the camera stood
    poses = [x.pose for x in answer.equivalent]
    for truth in np.array(pair["symmetric"]):
        truth[:3, 3] += truth[:3, :3] @ part.origin - scan.origin
        apart = [pose @ np.linalg.inv(truth) for pose in poses]
        shifts = [np.linalg.norm(pose[:3, 3] - truth[:3, 3]) for pose in poses]
        angles = [np.degrees(rotation_angle(x[:3, :3])) for x in apart]
        assert any(a < 10 and s < 0.005 for a, s in zip(angles, shifts, strict=True))
