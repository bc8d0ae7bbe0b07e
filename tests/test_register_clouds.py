"""From two raw clouds to a pose and a verdict, without a parameter."""

from __future__ import annotations

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloud_scenes import CUPBOARD, ROOM, SHELF, TABLE, on_faces, plane, terrain
from oracles import random_pose

import teaser_jax as tj

pytest.importorskip("small_gicp", reason="needs the extra clouds")

SCENES = {
    "landscape": (terrain(0, 18_000, 0, 20), terrain(1, 18_000, 8, 28)),
    "room": (
        on_faces(0, 18_000, ROOM + TABLE + CUPBOARD + SHELF),
        on_faces(1, 18_000, ROOM + TABLE + CUPBOARD + SHELF),
    ),
}
SRC, DST = SCENES["landscape"]
TRUE = random_pose(np.random.default_rng(3)).inverse()  # of the source as it is moved here
MOVED = TRUE.inverse().apply(SRC)


def furthest(found: tj.CloudRegistration, src: np.ndarray, right: np.ndarray) -> float:
    """How far the pose has any point from where it belongs, in voxels."""
    return float(np.linalg.norm(found.pose.apply(src) - right, axis=1).max() / found.voxel_size)


@pytest.fixture(scope="module")
def usual() -> tj.CloudRegistration:
    return tj.register_clouds(MOVED, DST)


@pytest.mark.parametrize("name", SCENES)
def test_two_clouds_find_one_another_wherever_they_lie(name: str):
    src, dst = SCENES[name]
    moved = random_pose(np.random.default_rng(5)).apply(src)
    found = tj.register_clouds(moved, dst)
    assert found.ok
    assert furthest(found, moved, src) < 2


def test_two_places_are_not_taken_for_one():
    found = tj.register_clouds(SCENES["landscape"][0], SCENES["room"][0])
    assert not found.ok
    assert found.status == tj.Status.NO_CONSENSUS
    assert np.isinf(np.diag(found.covariance)).all()


def test_what_slides_is_named():
    found = tj.register_clouds(plane(0, 20_000), plane(1, 20_000))
    assert not found.ok
    if found.status == tj.Status.DEGENERATE:
        assert [motion.kind for motion in found.free] == ["slide", "slide", "turn"]
        np.testing.assert_allclose(np.abs([motion.axis[2] for motion in found.free]), [0, 0, 1], atol=0.02)
        assert "slides along" in found.advice


def test_the_unit_does_not_matter(usual):
    found = tj.register_clouds(1000 * MOVED, 1000 * DST)
    assert found.ok
    assert found.voxel_size == pytest.approx(1000 * usual.voxel_size, rel=1e-6)
    apart = found.pose.apply(1000 * MOVED) / 1000 - usual.pose.apply(MOVED)
    assert np.linalg.norm(apart, axis=1).max() < 0.01 * usual.voxel_size


def test_coordinates_of_a_map_keep_their_digits(usual):
    utm, ecef = np.array([5e5, 5.4e6, 300.0]), np.array([4.1e6, 6e5, 4.8e6])
    found = tj.register_clouds(MOVED + utm, DST + ecef)
    assert found.ok
    apart = found.pose.apply(MOVED + utm) - ecef - usual.pose.apply(MOVED)
    assert np.linalg.norm(apart, axis=1).max() < 0.01 * usual.voxel_size


def test_the_same_clouds_get_the_same_bits_with_any_number_of_threads(usual):
    again = tj.register_clouds(MOVED, DST, threads=1)
    np.testing.assert_array_equal(again.T_dst_src, usual.T_dst_src)
    assert again.evidence.fit == usual.evidence.fit


def test_the_answer_tells_what_it_rests_on(usual):
    assert usual.T_dst_src.dtype == np.float64
    assert 0 < usual.displacement < usual.voxel_size
    assert usual.registration.ok
    assert usual.candidates[0].registration is usual.registration
    assert 1 <= usual.agreement <= len(usual.candidates)
    assert set(usual.seconds) >= {"reading", "cells", "descriptors", "matching", "register", "verdict"}
    # Shifts of the middle and turns about it add up to the displacement that is told.
    shifts = np.linalg.multi_dot([np.eye(3), usual.covariance[:3, :3], np.eye(3)])
    assert 0 < np.sqrt(np.trace(shifts)) <= usual.displacement
    for word in ("ok: OK", "accuracy", "fit", "overlap", "rivals", "two voxels"):
        assert word in repr(usual)


def test_matches_and_their_answer_stand_in_the_frames_as_given(usual):
    problem = usual.registration.problem
    inliers = usual.registration.inliers
    off = usual.pose.apply(problem.src[inliers]) - problem.dst[inliers]
    assert np.median(np.linalg.norm(off, axis=1)) < usual.voxel_size


def test_a_known_scale_is_applied():
    found = tj.register_clouds(MOVED / 2.5, DST, scale=2.5)
    assert found.ok
    assert found.pose.scale == 2.5
    assert furthest(found, MOVED / 2.5, SRC) < 2


def test_a_guess_is_refined_and_not_left():
    near = tj.Pose(TRUE.rotation, TRUE.translation + [0.3, -0.2, 0.1], 1.0)
    found = tj.register_clouds(MOVED, DST, initial=near, initial_error=1.0)
    assert found.ok
    assert len(found.candidates) == 1
    assert furthest(found, MOVED, SRC) < 2
    far = tj.Pose(TRUE.rotation, TRUE.translation + [9.0, 0, 0], 1.0)
    found = tj.register_clouds(MOVED, DST, initial=far, initial_error=0.5)
    assert not found.ok
    assert found.doubt == "guess"


def test_a_guess_rules_out_the_other_way_round():
    room = on_faces(0, 18_000, ROOM), on_faces(1, 18_000, ROOM)
    assert not tj.register_clouds(*room, initial=np.eye(4)).ok
    assert tj.register_clouds(*room, initial=np.eye(4), initial_error=0.5).ok


def test_a_tolerance_that_is_not_met_is_said(usual):
    assert tj.register_clouds(MOVED, DST, tolerance=10 * usual.displacement).ok
    found = tj.register_clouds(MOVED, DST, tolerance=0.1 * usual.displacement)
    assert not found.ok
    assert found.doubt == "tolerance"
    assert "more than the tolerance" in found.advice


def test_a_prepared_map_gives_the_answer_of_an_unprepared_one(usual):
    prepared = tj.prepare(DST)
    for _ in range(2):
        found = tj.register_clouds(MOVED, prepared)
        assert found.ok
        assert furthest(found, MOVED, SRC) < 2
    assert len(prepared._surfaces) <= 2  # those of the first call serve the second
    with pytest.raises(ValueError, match="dst was prepared already: give max_range to prepare"):
        tj.register_clouds(MOVED, prepared, max_range=3.0)


def test_descriptors_of_the_user_take_the_place_of_histograms(usual):
    ours = [np.sin(1.7 * x) for x in (SRC, DST)]  # learned ones would know the place as well
    found = tj.register_clouds(MOVED, DST, descriptors=ours)
    assert found.ok
    assert furthest(found, MOVED, SRC) < 2
    with pytest.raises(ValueError, match="a row for each point"):
        tj.register_clouds(MOVED, DST, descriptors=(ours[0][:-1], ours[1]))
    with pytest.raises(ValueError, match="give one kind"):
        tj.register_clouds(MOVED, DST, descriptors=(ours[0], ours[1][:, :2]))


def test_the_work_is_told_and_a_budget_ends_it():
    told: list[str] = []
    found = tj.register_clouds(SCENES["room"][0], SCENES["landscape"][0], seconds=1e-3, progress=told.append)
    assert len(found.candidates) <= 1
    assert found.ended_early
    assert "time was over" in found.advice
    assert any("matching" in what for what in told)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"voxel_size": 0}, "voxel_size is 0"),
        ({"tolerance": -1}, "tolerance is -1"),
        ({"seconds": np.nan}, "seconds is nan"),
        ({"refine": "icp"}, "refine"),
        ({"threads": 0}, "threads is 0"),
        ({"scale": 0}, "scale is 0"),
        ({"initial_error": 1.0}, "without initial"),
        ({"initial": np.diag([2.0, 2, 2, 1])}, "initial has scale 2"),
        ({"descriptors": np.ones(3)}, "two arrays"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict, said: str):
    with pytest.raises(ValueError, match=said):
        tj.register_clouds(MOVED, DST, **options)


def test_clouds_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="src has 3 points that can be used"):
        tj.register_clouds(np.eye(3), DST)
    with pytest.raises(ValueError, match="dst has shape"):
        tj.register_clouds(SRC, DST[:, :2])
    with pytest.raises(ValueError, match="inside jit"):
        jax.jit(lambda x: tj.register_clouds(x, DST).pose.rotation)(jnp.asarray(SRC, jnp.float32))


def test_nothing_is_written_to_the_terminal(capfd):
    tj.register_clouds(np.where(np.arange(len(SRC))[:, None] % 50, SRC, np.nan), DST)
    assert capfd.readouterr() == ("", "")


def test_every_option_is_explained():
    text = tj.register_clouds.__doc__
    assert all(name in text for name in inspect.signature(tj.register_clouds).parameters)
