"""Matches made by position, in the frames as given, are refused, and matches of descriptors are not."""

from __future__ import annotations

import numpy as np
import pytest
from oracles import random_pose, solve
from scipy.spatial import cKDTree

import teaser_jax as tj

N = 500


def room(rng: np.random.Generator) -> np.ndarray:
    points, side = rng.uniform(-1, 1, (N, 3)), rng.integers(0, 3, N)
    points[np.arange(N), side] = np.sign(points[np.arange(N), side])
    return points * [3, 2, 1.3]


def terrain(rng: np.random.Generator) -> np.ndarray:
    points = rng.uniform(-3, 3, (N, 3))
    points[:, 2] = 0.3 * np.sin(2 * points[:, 0]) + 0.2 * np.cos(3 * points[:, 1])
    return points


def ellipsoid(rng: np.random.Generator) -> np.ndarray:
    points = rng.normal(size=(N, 3))
    return points / np.linalg.norm(points, axis=1)[:, None] * [2.0, 1.3, 1.0]


def clouds(shape, degrees: float):
    """Samples of one surface in two frames, a small motion apart: no point of one is a point of the other."""
    rng = np.random.default_rng(int(degrees))
    half = np.radians(degrees) / 2
    axis = rng.normal(size=3)
    turn = np.append(np.sin(half) * axis / np.linalg.norm(axis), np.cos(half))
    motion = tj.Pose(tj.so3.rotation_from_quat(turn), 0.1 * rng.normal(size=3), 1.0)
    return shape(rng), motion.apply(shape(rng))


@pytest.mark.long
@pytest.mark.parametrize("shape", [room, terrain, ellipsoid])
@pytest.mark.parametrize("degrees", [3.0, 30.0])
@pytest.mark.parametrize("scale", [1.0, None], ids=["known", "voted"])
def test_nearest_neighbours_as_given_are_refused(shape, degrees, scale):
    src, dst = clouds(shape, degrees)
    near = dst[cKDTree(dst).query(src)[1]]
    far = np.array([1e3, -2e3, 5e2])  # of both frames: that changes nothing
    for a, b in ((src, near), (near, src), (src + far, near + far)):
        result = tj.register(a, b, noise_bound=0.05, scale=scale)
        assert result.status == tj.Status.BY_POSITION
        assert "descriptors" in str(result)
    if scale is not None:  # a batch asks the same question, whatever is known
        problems = [tj.host_problem(a, b, noise_bound=0.05) for a, b in ((src, near), (near, src))]
        assert all(s.status == tj.Status.BY_POSITION for s in tj.solve_batch(problems))


@pytest.mark.long
def test_under_jit_they_are_refused_too(x64):
    src, dst = clouds(room, 10.0)
    problem = tj.make_problem(src, dst[cKDTree(dst).query(src)[1]], noise_bound=0.05)
    assert solve(problem).status == tj.Status.BY_POSITION


@pytest.mark.parametrize("apart", [False, True], ids=["aligned", "apart"])
@pytest.mark.parametrize("bound", [1.0, 0.3], ids=["as it is", "too small"])
def test_matches_of_descriptors_are_not(apart, bound):
    """Aligned clouds, half of the matches wrong. A bound too small leaves right ones out, too."""
    for seed in range(20):
        rng = np.random.default_rng(seed)
        truth = random_pose(rng, 1.0) if apart else tj.Pose(np.eye(3), np.zeros(3), 1.0)
        src = room(rng)
        dst = truth.apply(src) + 0.02 * rng.normal(size=src.shape)
        wrong = rng.uniform(size=N) < 0.5
        dst[wrong] = dst[rng.integers(0, N, N)][wrong]
        result = tj.register(src, dst, noise_bound=0.08 * bound)
        assert result.status == tj.Status.OK


def test_one_point_that_many_matches_lead_to_says_nothing():
    rng = np.random.default_rng(0)
    src = rng.normal(size=(N, 3))
    assert tj.register(src, np.zeros((N, 3)), noise_bound=0.01).status != tj.Status.BY_POSITION


@pytest.mark.slow
def test_real_matches_of_descriptors_in_aligned_clouds_are_not(data_dir):
    paths = sorted((data_dir / "hard_matches").glob("*.npz"))
    assert paths
    for path in paths:
        pair = np.load(path)
        aligned = tj.Pose.from_matrix(pair["T_dst_src"]).apply(pair["src"].astype(float))
        result = tj.register(aligned, pair["dst"], noise_bound=float(pair["noise_bound"]))
        assert result.status != tj.Status.BY_POSITION, path.name
