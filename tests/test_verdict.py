"""The verdict: each question by itself, on problems made to fail just that one."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from oracles import problem_of, random_matches, solve

import teaser_jax as tj
from teaser_jax.settings import ExactClique, Gnc, Refinement, ScaleVote
from teaser_jax.stages import chance, verdict
from teaser_jax.synthetic import draw_rotation, random_problem

BOUND = 0.05


def status(src, dst, **known) -> tj.Status:
    return tj.register(src, dst, noise_bound=known.pop("noise_bound", BOUND), **known).status


def moved(points, seed=0):
    """The points under a random rigid motion, with a little noise."""
    rng = np.random.default_rng(seed)
    return points @ draw_rotation(rng).T + rng.uniform(-1, 1, 3) + 0.003 * rng.normal(size=points.shape)


def cloud(n=60, seed=1):
    return np.random.default_rng(seed).uniform(size=(n, 3))


@pytest.mark.long
def test_right_matches_are_ok():
    src = cloud()
    assert status(src, moved(src)) == tj.Status.OK


@pytest.mark.long
def test_three_clean_matches_among_few_are_not_beyond_chance():
    # Any three matches that agree on their distances make a perfect pose: that alone is no evidence.
    src = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0.5]])
    assert status(src, moved(src)) == tj.Status.NO_CONSENSUS


@pytest.mark.long
@pytest.mark.parametrize("n", [32, 64, 256])
@pytest.mark.parametrize("seed", range(5))
def test_wrong_matches_are_never_ok(n, seed):
    problem = random_problem((n, seed), n=n, outlier_rate=1.0, radius=1.0)
    assert status(problem.src, problem.dst) != tj.Status.OK


@pytest.mark.long
@pytest.mark.parametrize("scale", [0.5, 0.8, 1.2, 2.0])
@pytest.mark.parametrize("rate", [0.0, 0.5])
def test_a_wrong_scale_is_never_ok_where_it_leaves_right_matches_out(scale, rate):
    """Right matches that lie close together agree at any scale, and are many where all are many."""
    few = 0
    for seed in range(5):
        drawn = random_problem((1, seed), n=250, outlier_rate=rate, scale=scale)
        found = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        if found.inliers[drawn.inliers].mean() < 0.7:
            few += 1
            assert not found.ok
    assert few >= 2


@pytest.mark.long
def test_a_scale_off_by_less_than_the_bound_is_none_of_that():
    for seed in range(5):
        drawn = random_problem((1, seed), n=250, outlier_rate=0.5, scale=1.02)
        found = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        assert found.ok
        assert found.inliers[drawn.inliers].all()


@pytest.mark.long
def test_a_mirror_image_has_no_pose():
    src = cloud()
    for mirror in (np.diag([1, 1, -1]), np.eye(3)[[0, 2, 1]], 2 * np.diag([-1, 1, 1])):
        scale = None if mirror[0, 0] == -2 else 1.0
        assert status(src, moved(src @ mirror.T), scale=scale) == tj.Status.MIRRORED
        # The advice, followed: any one axis, any two.
        for way_out in (np.diag([1, -1, 1]), np.eye(3)[[2, 1, 0]]):
            assert status(src, moved(src @ mirror.T) @ way_out.T, scale=scale) == tj.Status.OK


def test_few_wrong_matches_are_not_called_mirror_images():
    for seed in range(20):
        problem = random_problem((9, seed), n=64, outlier_rate=1.0, radius=1.0)
        assert status(problem.src, problem.dst) != tj.Status.MIRRORED


def test_a_line_does_not_determine_a_rotation():
    src = np.linspace(0, 1, 40)[:, None] * [1.0, 2.0, 0.5]
    assert status(src, moved(src)) == tj.Status.DEGENERATE


def test_a_plane_does():
    src = cloud() * [1, 1, 0]
    assert status(src, moved(src)) == tj.Status.OK


def test_coincident_points_determine_nothing():
    assert status(np.ones((40, 3)), np.zeros((40, 3))) == tj.Status.TOO_FEW_POINTS  # one match, forty times
    near = np.random.default_rng(0).normal(size=(2, 40, 3))
    assert status(1 + 1e-3 * near[0], 1e-3 * near[1]) == tj.Status.DEGENERATE


def test_a_source_within_the_noise_determines_nothing():
    src = 0.04 * cloud()
    assert status(src, moved(src)) == tj.Status.DEGENERATE


def test_too_few_points():
    src = cloud(2)
    assert status(src, moved(src)) == tj.Status.TOO_FEW_POINTS
    src = cloud(40)
    assert status(src, moved(src), mask=np.arange(40) < 2) == tj.Status.TOO_FEW_POINTS


def test_the_first_failure_sticks():
    # A single usable point is also degenerate and without consensus.
    src = np.zeros((40, 3))
    assert status(src, src, mask=np.arange(40) < 1) == tj.Status.TOO_FEW_POINTS


@pytest.mark.long
@pytest.mark.parametrize(
    "cap",
    [dict(rotation=Gnc(iterations=1), refine=False), dict(refine=Refinement(iterations=1))],
    ids=["GNC", "refinement"],
)
def test_an_iteration_cap_is_reported(cap, x64):
    # Either takes more than one round here, and what it has found by then is no better founded.
    matches = random_matches(0, wrong=0.4, noise_bound=0.1, noise=1.6, scale=1.3)
    problem = problem_of(matches, scale=1.3)
    assert solve(problem).status == tj.Status.OK
    capped = solve(problem, tj.Settings(clique="greedy", **cap))
    assert capped.status == tj.Status.NOT_CONVERGED
    assert not capped.ok


def test_turns_are_rotations_far_from_none_and_spread():
    turns = chance.TURNS
    assert len(turns) >= 60
    np.testing.assert_allclose(
        np.swapaxes(turns, 1, 2) @ turns, np.broadcast_to(np.eye(3), turns.shape), atol=1e-12
    )
    assert np.all(np.linalg.det(turns) > 0)
    assert np.all(tj.so3.rotation_angle(turns) > np.deg2rad(45))
    # Evenly: the mean of the matrices of uniform rotations is zero; the missing small turns pull a little.
    assert np.abs(turns.mean(axis=0)).max() < 0.2


def test_inliers_that_huddle_count_as_chance(x64):
    # Forty matches within the noise of each other agree with any pose through one of them.
    n = 64
    src = np.concatenate([0.01 * cloud(40), 5 + cloud(24)])
    problem = tj.make_problem(src, src, noise_bound=BOUND)
    pose = tj.Pose(np.eye(3), np.zeros(3), np.ones(()))
    counts = np.asarray(jax.jit(chance.chance_inliers)(problem, pose, np.arange(n) < 40))
    assert counts.shape == (2, len(chance.TURNS))
    assert counts.min() == 39


# --- evidence that is none ------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_copies_of_a_match_are_no_evidence(seed):
    # Thirty wrong matches, each listed sixteen times: three of them that agree look like 48.
    rng = np.random.default_rng(seed)
    src, dst = (np.repeat(rng.uniform(-1, 1, (30, 3)), 16, axis=0) for _ in range(2))
    assert status(src, dst, settings=tj.Settings(clique=ExactClique(seconds=1.0))) != tj.Status.OK


@pytest.mark.long
def test_copies_do_no_harm_either():
    problem = random_problem(2, n=30, outlier_rate=0.5)
    twice = [np.concatenate([x, x]) for x in (problem.src, problem.dst)]
    found = tj.register(*twice, noise_bound=problem.noise_bound)
    assert found.ok
    np.testing.assert_array_equal(found.inliers[:30], problem.inliers)


@pytest.mark.parametrize("n", [0, 1, 40, 500, 5000])
def test_distinct_points_are_counted(n, x64):
    rng = np.random.default_rng(n)
    points = rng.normal(size=(n, 3))[rng.integers(0, (n + 1) // 2, n)]
    chosen = rng.uniform(size=n) < 0.8
    found = int(jax.jit(verdict.count_distinct)(points, chosen))
    expected = len(np.unique(points[chosen], axis=0))
    assert 0.9 * expected <= found <= expected  # two in one slot count as one


def test_many_matches_of_one_point_are_one_piece_of_evidence(x64):
    """A hub that forty matches lead to, and three matches beside it: whatever the pose, four points agree."""
    rng = np.random.default_rng(0)
    src, dst = rng.normal(size=(60, 3)), rng.normal(size=(60, 3))
    src[:40], dst[:40] = src[0] + 0.01 * rng.normal(size=(40, 3)), src[0]
    dst[40:43] = src[40:43]
    result = tj.register(src, dst, noise_bound=0.05)
    assert result.inliers[:43].all()
    assert result.status == tj.Status.NO_CONSENSUS


def test_a_pose_that_two_matches_hold_is_not_determined():
    problem = random_problem(0, n=60, outlier_rate=0.5)
    weights = np.full(60, 1e-12)
    weights[np.flatnonzero(problem.inliers)[:2]] = 1
    known = dict(noise_bound=problem.noise_bound)
    assert status(problem.src, problem.dst, confidence=weights, **known) == tj.Status.DEGENERATE
    # The unit of confidence does not matter.
    assert status(problem.src, problem.dst, confidence=np.full(60, 1e-12), **known) == tj.Status.OK


@pytest.mark.long
def test_a_scale_out_of_its_range_has_no_consensus():
    problem = random_problem(0, n=60, outlier_rate=0.5)
    known = dict(noise_bound=problem.noise_bound, scale=None)
    by_chance = {tj.Status.NO_CONSENSUS, tj.Status.DEGENERATE}  # so few agree that they may lie on a line
    for scale_range, expected in {
        (0.9, 1.1): {tj.Status.OK},
        (1.2, 1.5): {tj.Status.NO_CONSENSUS},
        (2.0, 3.0): by_chance,
    }.items():
        settings = tj.Settings(scale_search=ScaleVote(scale_range))
        assert status(problem.src, problem.dst, settings=settings, **known) in expected


@pytest.mark.long
@pytest.mark.parametrize("flat", [1.0, 0.3, 0.1])
@pytest.mark.parametrize("axis", range(3))
def test_a_flat_cloud_mirrored_has_no_pose_either(flat, axis):
    # Its flat parts fit a rotation by themselves: those alone are no answer.
    rng = np.random.default_rng(axis)
    parts = np.concatenate([cloud(60) * [1, 1, 0.01], cloud(90, 2) * [1, 1, flat]])
    src = parts @ draw_rotation(rng).T
    mirror = np.where(np.arange(3) == axis, -1, 1)
    assert status(src, moved(src)) == tj.Status.OK
    assert status(src, moved(src * mirror)) == tj.Status.MIRRORED
