"""Random problems are what they say they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

import teaser_jax as tj
from teaser_jax import synthetic
from teaser_jax.synthetic import models

PROTOCOLS = (synthetic.random_problem, synthetic.descriptor_problem)


def errors(problem: synthetic.SyntheticProblem) -> np.ndarray:
    return np.linalg.norm(problem.dst - problem.truth.apply(problem.src), axis=1)


@pytest.mark.parametrize("make", [*PROTOCOLS, synthetic.all_to_all])
def test_the_seed_decides(make):
    once, again, other = make((3, 1), n=30), make((3, 1), n=30), make((3, 2), n=30)
    np.testing.assert_array_equal(once.src, again.src)
    np.testing.assert_array_equal(once.dst, again.dst)
    assert not np.array_equal(once.src, other.src)


@pytest.mark.parametrize("make", PROTOCOLS)
@pytest.mark.parametrize(("n", "rate"), [(100, 0.0), (100, 0.5), (1000, 0.95), (200, 1.0)])
def test_right_matches_keep_the_bound_and_wrong_ones_break_it(make, n, rate):
    problem = make(5, n=n, outlier_rate=rate, scale=(1, 5))
    assert problem.inliers.sum() == n - round(rate * n)
    assert problem.noise_bound == pytest.approx(0.0554)
    np.testing.assert_array_equal(errors(problem) <= problem.noise_bound, problem.inliers)
    assert 1 <= problem.truth.scale <= 5


def test_the_model_fits_the_unit_cube_tightly():
    src = synthetic.random_problem(0, n=50).src
    assert src.min() == 0
    assert src.max() == 1
    np.testing.assert_array_equal(src.min(axis=0), 0)


def test_rotations_and_balls_are_uniform():
    rng = np.random.default_rng(0)
    rotations = np.stack([synthetic.draw_rotation(rng) for _ in range(4000)])
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(1, 2), np.tile(np.eye(3), (4000, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotations), 1)
    # Uniform on SO(3), traces have mean 0 and variance 1, and every entry has variance 1/3.
    traces = np.trace(rotations, axis1=1, axis2=2)
    assert abs(traces.mean()) < 0.06
    assert abs(traces.var() - 1) < 0.1
    np.testing.assert_allclose(rotations.var(axis=0), 1 / 3, atol=0.03)
    volume = (np.linalg.norm(synthetic.in_ball(rng, 4000, 2.0), axis=1) / 2) ** 3
    np.testing.assert_allclose(np.quantile(volume, [0.25, 0.5, 0.75, 1]), [0.25, 0.5, 0.75, 1], atol=0.03)


def test_noise_is_gaussian_within_its_bound():
    noise = synthetic.bounded_noise(np.random.default_rng(0), 5000, 1.0, 1.5)
    length = np.linalg.norm(noise, axis=1)
    assert length.max() <= 1.5
    assert length.max() > 1.45
    loose = synthetic.bounded_noise(np.random.default_rng(0), 5000, 0.1, 10.0)
    np.testing.assert_allclose(loose.std(axis=0), 0.1, rtol=0.05)


def test_a_given_truth_is_kept():
    truth = tj.Pose(np.eye(3), np.zeros(3), np.asarray(2.0))
    problem = synthetic.random_problem(0, n=20, outlier_rate=0, truth=truth)
    np.testing.assert_allclose(problem.dst, 2 * problem.src, atol=problem.noise_bound)


@pytest.mark.long
def test_no_rotation_or_reflection_maps_the_teapot_onto_itself():
    pot = synthetic.teapot(20_000)
    pot = pot[:4000] - pot.mean(axis=0)
    tree = cKDTree(pot)
    half_turns = [np.diag(signs) for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1), (1, -1, 1), (-1, 1, 1))]
    rng = np.random.default_rng(0)
    angles = [(tj.so3.rotation_angle(r), r) for r in (synthetic.draw_rotation(rng) for _ in range(200))]
    spacing = tree.query(pot, k=2)[0][:, 1].max()
    for turn in half_turns + [r for angle, r in angles if angle > 0.3]:
        distances = tree.query(pot @ turn.T)[0]
        assert distances.max() > 0.08 > spacing


def test_the_teapot_is_sampled_evenly():
    pot = synthetic.teapot(20_000)
    assert np.abs(models._teapot_distance(pot)).max() < 1e-6
    # On a surface the number of neighbours within r grows with r^2 at the same rate everywhere.
    near = cKDTree(pot).query_ball_point(pot[:2000], 0.05, return_length=True)
    assert near.std() / near.mean() < 0.25


def test_points_as_a_model_are_drawn_without_repeats():
    model = np.random.default_rng(1).normal(size=(40, 3)) * [1, 2, 3] + 1e3
    problem = synthetic.random_problem(0, n=40, outlier_rate=0, model=model)
    assert len(np.unique(problem.src, axis=0)) == 40
    extent = np.ptp(model, axis=0).max()
    expected = np.sort((model - model.min(axis=0)) / extent, axis=0)
    np.testing.assert_allclose(np.sort(problem.src, axis=0), expected, atol=1e-12)
    with pytest.raises(ValueError, match=r"40 points, fewer than n = 41.*Triangles"):
        synthetic.random_problem(0, n=41, model=model)


def test_a_mesh_gives_any_number_of_points_by_area():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    mesh = synthetic.Triangles(vertices, np.array([[0, 1, 2], [0, 2, 3]]))
    points = synthetic.sample_model(np.random.default_rng(0), 4000, mesh)
    np.testing.assert_array_equal(points[:, 2], 0)
    np.testing.assert_allclose(
        np.quantile(points[:, :2], [0.25, 0.5, 0.75], axis=0).T, [[0.25, 0.5, 0.75]] * 2, atol=0.03
    )


def test_descriptors_err_towards_few_points():
    problem = synthetic.descriptor_problem(0, n=400, outlier_rate=0.9, hubs=0.05)
    wrong = problem.dst[~problem.inliers]
    assert len(np.unique(wrong, axis=0)) <= 20
    reach = np.linalg.norm(problem.dst - problem.dst.mean(axis=0), axis=1).max()
    assert reach < 2  # on the object, not somewhere in space


def test_all_to_all_matches_every_point_with_every_point():
    problem = synthetic.all_to_all(0, n=20, overlap=0.5)
    assert problem.src.shape == (200, 3)
    assert problem.inliers.sum() == 10
    assert problem.noise_bound == pytest.approx(0.01)
    assert len(np.unique(problem.src, axis=0)) == 20
    assert len(np.unique(problem.dst, axis=0)) == 10
    np.testing.assert_array_equal(problem.src.reshape(20, 10, 3)[:, 0], problem.src.reshape(20, 10, 3)[:, 9])
    assert errors(problem)[problem.inliers].max() <= problem.noise_bound


@pytest.mark.parametrize(
    ("make", "known", "message"),
    [
        (synthetic.random_problem, dict(n=0), "n is 0: expected a whole number"),
        (synthetic.random_problem, dict(sigma=-1.0), "sigma is -1.0: expected 0 or more"),
        (synthetic.random_problem, dict(outlier_rate=1.5), "outlier_rate is 1.5"),
        (synthetic.random_problem, dict(sigma=1.0, noise_bound=0.1), "below sigma"),
        (synthetic.descriptor_problem, dict(n=10, sigma=5.0), "spans the target"),
        (synthetic.all_to_all, dict(overlap=0.0), "overlap is 0.0"),
        (synthetic.random_problem, dict(scale=-1), "scale is -1: expected a number above 0"),
        (synthetic.random_problem, dict(scale=0), "scale is 0: expected a number above 0"),
        (synthetic.random_problem, dict(scale=None), "scale is None: expected a number above 0"),
        (synthetic.random_problem, dict(scale=(2, 1)), r"scale is \(2, 1\): expected one number, or a range"),
        (synthetic.random_problem, dict(sigma="a"), "sigma is 'a': expected 0 or more"),
        (synthetic.random_problem, dict(noise_bound=10**400), "noise_bound is 10*...: expected"),
        (synthetic.random_problem, dict(n=2.5), "n is 2.5: expected a whole number"),
    ],
)
def test_what_makes_no_sense_is_refused(make, known, message, unchecked):
    with pytest.raises(ValueError, match=message):
        make(0, **known)


@pytest.mark.parametrize("seed", [-1, "a", 0.5, [1, -2]])
def test_what_is_no_seed(seed, unchecked):
    with pytest.raises(ValueError, match="expected a whole number, 0 or above"):
        synthetic.random_problem(seed)
