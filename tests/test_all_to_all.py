"""Points without matches: every point of one cloud may be any point of the other."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import teaser_jax as tj

BOUND = 0.01
GRID = np.stack(np.meshgrid(*[np.arange(3.0)] * 3), axis=-1).reshape(-1, 3) / 3


def moved(points, *, seed=0, keep=1.0, error=BOUND / 2):
    """Move points, disturb them and drop some; return the target, the pose and who each of them was."""
    rng = np.random.default_rng(seed)
    pose = tj.Pose(tj.synthetic.draw_rotation(rng), rng.standard_normal(3), 1.0)
    who = rng.permutation(len(points))[: round(keep * len(points))]
    noise = rng.standard_normal((len(who), 3))
    noise *= error / np.linalg.norm(noise, axis=1, keepdims=True)
    return pose.apply(points)[who] + noise, pose, who


def turned_by(found, truth):
    return np.rad2deg(tj.so3.rotation_angle(found.rotation.T @ truth.rotation))


def random_points(n, seed=5):
    return np.random.default_rng(seed).random((n, 3))


@pytest.mark.parametrize("overlap", [1.0, 0.6])
def test_a_part_is_found_and_each_point_told(overlap):
    points = random_points(32)
    dst, truth, who = moved(points, keep=overlap)
    found = tj.all_to_all(points, dst, noise_bound=BOUND)
    assert found.ok
    assert turned_by(found.pose, truth) < 2
    np.testing.assert_array_equal(found.pairs[:, 0], np.sort(who))
    np.testing.assert_array_equal(who[found.pairs[:, 1]], found.pairs[:, 0])
    assert found.solution.clique_is_maximum
    assert found.solution.clique_upper_bound == len(dst)


def test_both_may_hold_points_that_the_other_lacks():
    points = random_points(45)
    dst, truth, who = moved(points[15:])
    found = tj.all_to_all(points[:30], dst, noise_bound=BOUND)
    assert found.ok
    assert turned_by(found.pose, truth) < 2
    right = who[found.pairs[:, 1]] + 15 == found.pairs[:, 0]
    assert right.sum() == 15
    assert right.mean() > 0.9


def test_it_is_a_registration():
    points = random_points(25)
    dst, _, _ = moved(points)
    found = tj.all_to_all(points, dst, noise_bound=BOUND)
    assert isinstance(found, tj.Registration)
    assert found.certificate.is_optimal
    assert np.isfinite(tj.covariance(found).covariance).all()
    np.testing.assert_allclose(found.T_dst_src, found.pose.matrix)
    again = tj.refit(found.problem, found.solution.selection)
    np.testing.assert_allclose(again.matrix, found.pose.matrix, atol=1e-12)
    assert "rivals       none found" in repr(found)
    assert {"consistency graph", "clique, host", "rotation", "translation", "rivals"} <= set(found.seconds)


def test_points_have_one_partner_where_many_lie_within_the_bound():
    points = random_points(30)
    dst, _, _ = moved(points, error=0.03)
    found = tj.all_to_all(points, dst, noise_bound=0.06)
    assert len(set(found.pairs[:, 0])) == len(set(found.pairs[:, 1])) == len(found.pairs)
    assert found.inliers.sum() == len(found.pairs) == 30


HALF = random_points(20, seed=8)
SYMMETRIC = {
    "grid": GRID,
    "ring": np.stack([f(np.arange(24) * np.pi / 12) for f in (np.cos, np.sin, np.zeros_like)], axis=1),
    "half turn": np.concatenate(
        [HALF[10:], HALF[10:] * [-1, -1, 1], np.arange(10)[:, None] / 8 * [0, 0, 1.0]]
    ),
    "two copies": np.concatenate([HALF, HALF @ np.diag([-1.0, 1.0, -1.0]) + 3]),
}


@pytest.mark.parametrize("name", SYMMETRIC)
def test_what_fits_twice_is_not_ok(name):
    dst, _, _ = moved(SYMMETRIC[name][:20] if name == "two copies" else SYMMETRIC[name])
    found = tj.all_to_all(SYMMETRIC[name], dst, noise_bound=BOUND)
    assert found.status == tj.Status.AMBIGUOUS
    assert max(x.explained for x in found.rivals) >= 0.8 * len(found.pairs)


@pytest.mark.parametrize("seed", range(3))
def test_a_mirror_plane_hides_nothing(seed):
    """Half of the largest cliques are mirrored, and no pose explains those."""
    half = random_points(15, seed=9) + 0.1
    points = np.concatenate([half, half * [-1, 1, 1]])
    dst, truth, _ = moved(points, seed=seed)
    found = tj.all_to_all(points, dst, noise_bound=BOUND)
    assert found.ok
    assert turned_by(found.pose, truth) < 2
    assert len(found.pairs) == 30


def test_a_mirrored_cloud_says_so():
    dst, _, _ = moved(random_points(30) * [-1, 1, 1])
    assert tj.all_to_all(random_points(30), dst, noise_bound=BOUND).status == tj.Status.MIRRORED


@pytest.mark.parametrize("bound", [0.003, 0.01, 0.03, 0.1])
def test_clouds_of_other_things_are_not_ok(bound):
    for seed in range(3):
        src, dst = random_points(30, seed=2 * seed), random_points(25, seed=2 * seed + 1)
        found = tj.all_to_all(src, dst, noise_bound=bound)
        assert not found.ok


@pytest.mark.long
def test_three_points_are_no_evidence():
    dst, _, _ = moved(random_points(3))
    assert not tj.all_to_all(random_points(3), dst, noise_bound=BOUND).ok


def test_points_that_cannot_be_used_are_left_out_and_rows_stay_those_given():
    points = random_points(25)
    dst, _, who = moved(points)
    given = np.concatenate([[[np.nan, 0, 0]], points, points[:3]])
    found = tj.all_to_all(given, dst, noise_bound=BOUND)
    assert found.ok
    np.testing.assert_array_equal(who[found.pairs[:, 1]] + 1, found.pairs[:, 0])


def test_frames_far_away_and_a_known_scale():
    points = random_points(25)
    dst, truth, _ = moved(points)
    far = np.array([4e5, 5e6, 100.0])
    found = tj.all_to_all(points / 2 + far, dst - far, noise_bound=BOUND, scale=2.0)
    assert found.ok
    assert turned_by(found.pose, truth) < 2
    apart = found.pose.apply(points / 2 + far)[found.pairs[:, 0]] - (dst - far)[found.pairs[:, 1]]
    assert np.linalg.norm(apart, axis=1).max() < 2 * BOUND


def test_the_order_of_the_points_does_not_matter():
    points = random_points(30)
    dst, _, _ = moved(points, keep=0.8)
    order = np.random.default_rng(1).permutation(30)
    one, other = (tj.all_to_all(x, dst, noise_bound=BOUND) for x in (points, points[order]))
    np.testing.assert_allclose(one.pose.matrix, other.pose.matrix, atol=1e-12)


def test_greedy_cliques_do_too():
    points = random_points(30)
    dst, truth, _ = moved(points)
    found = tj.all_to_all(points, dst, noise_bound=BOUND, settings=tj.Settings(clique="greedy"))
    assert found.ok
    assert turned_by(found.pose, truth) < 2
    assert "clique, device" in found.seconds


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"src": np.full((4, 3), np.nan)}, "no finite point"),
        ({"src": np.zeros((4, 2))}, "expected"),
        ({"src": random_points(300), "dst": random_points(300)}, "90000 matches"),
        ({"scale": None}, "known scale"),
        ({"noise_bound": [0.1, 0.2]}, "one number"),
        ({"noise_bound": 0.0}, "above 0"),
        ({"settings": tj.Settings(clique="none")}, "without a clique"),
    ],
)
def test_bad_input_is_refused(change, words):
    known = {"src": random_points(5), "dst": random_points(5), "noise_bound": BOUND} | change
    with pytest.raises(ValueError, match=words):
        tj.all_to_all(known.pop("src"), known.pop("dst"), **known)


def test_inside_jit_it_says_what_to_use():
    with pytest.raises(ValueError, match="inside jit"):
        jax.jit(lambda x: tj.all_to_all(x, x, noise_bound=BOUND).inliers)(random_points(5))
