"""How one surface lies on another, which motions that holds, and the last step of a pose."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_scenes import CUPBOARD, ROOM, corner, cylinder, on_faces, plane, sphere, terrain
from scipy.spatial.transform import Rotation

pytest.importorskip("small_gicp", reason="needs the extra clouds")

import teaser_jax as tj
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.lead import Lead, lead
from teaser_jax.clouds.trust.observability import observability
from teaser_jax.clouds.trust.pairing import direction_weights, lay, pair
from teaser_jax.clouds.trust.planes import beyond_planes
from teaser_jax.clouds.voxel import downsample

STILL = np.eye(4)


def surface(points: np.ndarray, cell: float) -> Surface:
    return Surface(downsample(points, cell), cell)


def motion(turn, shift) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec(turn).as_matrix(), shift
    return pose


def test_a_surface_lies_on_another_sample_of_itself():
    src, dst = surface(corner(0, 30_000), 0.05), surface(corner(1, 30_000), 0.05)
    laid = lay(STILL, src, dst)
    here, back = laid.here, laid.back
    for one in (here, back):
        assert one.overlap > 0.99
        assert one.fit > 0.95
    off = lay(motion([0, 0, 0], [0.3, 0.3, 0.3]), src, dst).here
    assert off.fit < 0.2


def test_pairs_are_those_of_a_full_table():
    src, dst = surface(terrain(0, 600), 1.0), surface(terrain(1, 600), 1.0)
    pose = motion([0.1, -0.2, 0.3], [0.4, 0.1, -0.2])
    found = pair(pose, src, dst)
    moved = src.points @ pose[:3, :3].T + pose[:3, 3]
    table = np.linalg.norm(moved[:, None] - dst.points[None], axis=2)
    np.testing.assert_array_equal(found.near, table.min(axis=1) < 3)
    np.testing.assert_array_equal(found.partner[found.near], table.argmin(axis=1)[found.near])
    np.testing.assert_allclose(found.distance[found.near], table.min(axis=1)[found.near], atol=1e-12)
    assert (found.distance[~found.near] >= 3).all()
    for k in np.flatnonzero(found.fits):
        across = dst.normals[found.partner[k]]
        assert abs((moved[k] - dst.points[found.partner[k]]) @ across) < 0.35
        assert abs((pose[:3, :3] @ src.normals[k]) @ across) > 0.85
    assert 0 < found.count < len(src)
    some = pair(pose, src, dst, np.array([3, 5]))
    np.testing.assert_array_equal(some.partner, found.partner[[3, 5]])


def test_each_direction_counts_the_same():
    normals = np.repeat(np.eye(3), [900, 90, 10], axis=0)
    weight = direction_weights(np.concatenate([normals, -normals, np.zeros((7, 3))]))
    shares = [
        weight[k].sum() + weight[1000:2000][k].sum()
        for k in (slice(0, 900), slice(900, 990), slice(990, 1000))
    ]
    np.testing.assert_allclose(shares, 1, rtol=1e-6)
    assert (weight[2000:] == 0).all()


SEEN = 0.01


@pytest.mark.parametrize(
    ("scene", "cell", "free"),
    [(plane, 0.08, 3), (sphere, 0.08, 3), (cylinder, 0.15, 2), (corner, 0.06, 0), (terrain, 0.5, 0)],
)
def test_what_slides_or_turns_is_counted(scene, cell: float, free: int):
    src, dst = surface(scene(0, 30_000), cell), surface(scene(1, 30_000), cell)
    found = observability(pair(STILL, src, dst))
    assert np.count_nonzero(found.visible < SEEN) == free
    assert found.visible.sum() > 0
    # Each motion displaces the points by one length on average.
    pairing = pair(STILL, src, dst)
    chosen = pairing.fits & (pairing.weight > 0)
    weight = pairing.weight[chosen] / pairing.weight[chosen].sum()
    for shift, turn in zip(found.motions[:3].T, found.motions[3:].T, strict=True):
        moved = shift + np.cross(turn, pairing.points[chosen] - found.centroid)
        assert weight @ np.sum(moved**2, axis=1) == pytest.approx(1, abs=1e-6)


def test_noise_does_not_make_a_plane_look_held():
    # Normals of few points are noisy: their squares would see a slide along the plane.
    src, dst = surface(plane(0, 6000, 0.03), 0.12), surface(plane(1, 6000, 0.03), 0.12)
    found = observability(pair(STILL, src, dst))
    assert (found.visible[:3] < SEEN).all()


def test_the_unit_does_not_matter():
    one, other = (
        observability(pair(STILL, *(surface(k * corner(s), k * 0.08) for s in (0, 1)))) for k in (1, 1000)
    )
    np.testing.assert_allclose(one.visible, other.visible, rtol=1e-4)
    assert other.displacement(1000 * 0.01) == pytest.approx(1000 * one.displacement(0.01), rel=1e-4)


def test_nothing_is_seen_where_nothing_fits():
    src, dst = surface(corner(0), 0.1), surface(corner(1), 0.1)
    found = observability(pair(motion([0, 0, 0], [50, 0, 0]), src, dst))
    np.testing.assert_array_equal(found.visible, 0)
    assert found.displacement(0.01) > 1


@pytest.mark.parametrize("method", ["gicp", "plane", "point"])
def test_a_pose_is_moved_to_where_the_surfaces_lie_on_one_another(method: str):
    src, dst = surface(terrain(0, 30_000), 0.4), surface(terrain(1, 30_000), 0.4)
    off = motion([0.01, -0.01, 0.02], [0.1, -0.1, 0.1])
    found = align(off, src, dst, method=method)
    error = lambda pose: np.linalg.norm(
        (src.points @ pose[:3, :3].T + pose[:3, 3]) - src.points, axis=1
    ).mean()
    assert error(found) < (0.05 if method != "point" else 0.8) * error(off)


def test_alignment_gives_the_same_bits_each_time():
    poses = []
    for _ in range(3):
        src, dst = (Surface(downsample(terrain(s, 20_000), 0.4), 0.4, threads=2) for s in (0, 1))
        poses.append(align(motion([0.01, 0, 0.02], [0.1, 0, 0.1]), src, dst, method="gicp"))
    np.testing.assert_array_equal(poses[0], poses[1])
    np.testing.assert_array_equal(poses[0], poses[2])


def test_a_method_that_nobody_knows_is_refused():
    src = surface(corner(0), 0.2)
    with pytest.raises(ValueError, match="'gicp', 'plane', 'point'"):
        align(STILL, src, src, method="ndt")


def test_what_stands_in_a_room_puts_its_pose_ahead_of_the_other_way_round():
    room, furnished = ROOM, ROOM + CUPBOARD
    half = motion([0, 0, np.pi], [0, 0, 0])
    for built, ahead in ((room, False), (furnished, True)):
        src, dst = (surface(on_faces(s, 30_000, built), 0.1) for s in (0, 1))
        forth, back = (lead(lay(a, src, dst), b) for a, b in ((STILL, half), (half, STILL)))
        assert forth.share == pytest.approx(-back.share, abs=0.02)  # cells have the weights of their pose
        assert (forth.share > 0.05) == ahead
        assert (forth.against < 0.3) == ahead


def test_cells_that_leave_the_other_cloud_say_nothing():
    src, dst = (surface(plane(s, 30_000), 0.1) for s in (0, 1))
    found = lead(lay(STILL, src, dst), motion([0, 0, 0], [1.5, 0, 0]))
    assert abs(found.share) < 0.02


def test_the_worse_of_two_leads_takes_the_worse_of_both():
    assert Lead(0.3, 0.2).at_worst(Lead(0.1, 0.05)) == Lead(0.1, 0.2)


def test_what_lies_off_five_planes_tells_furniture_from_walls():
    shares = []
    for faces in (ROOM[:5], [*ROOM[:5], *CUPBOARD]):
        one = surface(on_faces(0, 60_000, faces), 0.08)
        held = one.normals.any(axis=1)
        shares.append(beyond_planes(one.points[held], one.normals[held], 0.08))
    assert shares[0] < 0.01
    assert shares[1] > 0.03
    hills = surface(terrain(0, 40_000), 0.3)
    assert beyond_planes(hills.points, hills.normals, 0.3) > 0.3
    assert beyond_planes(np.zeros((0, 3)), np.zeros((0, 3)), 1.0) == 0


def test_one_corner_of_an_empty_room_on_another_is_not_ok():
    room = on_faces(0, 120_000, ROOM)
    here, there = room[(room[:, 0] < 1) & (room[:, 1] < 0.8)], room[(room[:, 0] > -1.2) & (room[:, 1] > -1)]
    found = tj.register_clouds(here, there)
    assert not found.ok
    assert found.status in (tj.Status.AMBIGUOUS, tj.Status.DEGENERATE)
