"""Error bounds: true on problems with known truth, exact where they claim to be, and their conditions."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose

import teaser_jax as tj
from teaser_jax.certify.paper_bounds import flattest_four


def registered(seed, n=100, outlier_rate=0.5, scale=1.0, **known):
    drawn = tj.synthetic.random_problem(seed, n=n, outlier_rate=outlier_rate, **known)
    return drawn, tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, scale=scale)


def check(drawn, result, bounds):
    """Whether everything lies below its bound; of the distance to the truth, and of every point."""
    w, truth, pose = bounds.whole_set, drawn.truth, result.pose
    moved = np.linalg.norm(pose.apply(drawn.src) - truth.apply(drawn.src), axis=1)
    error = tj.metrics.errors(pose, truth)
    return (
        np.linalg.norm(pose.scale * pose.rotation - truth.scale * truth.rotation) <= w.matrix.value
        and error.rotation <= w.angle.value
        and error.scale <= w.scale.value + 1e-12
        and np.linalg.norm(pose.translation - truth.translation) <= w.translation.value
        and np.all(moved <= w.at(drawn.src))
    )


@pytest.mark.long
@pytest.mark.parametrize("scale", [1.0, None])
@pytest.mark.parametrize(("n", "rate"), [(50, 0.3), (100, 0.5), (100, 0.8)])
def test_the_truth_lies_within_the_bound_over_the_whole_set(n, rate, scale):
    for seed in range(5):
        drawn, result = registered(seed, n, rate, scale)
        bounds = tj.error_bounds(result.problem, result.solution)
        assert check(drawn, result, bounds)
        assert bounds.whole_set.angle.informative
        assert (bounds.whole_set.scale.value > 0) == (scale is None)


@pytest.mark.slow
def test_the_truth_lies_within_the_bound_in_all_of_500():
    informative = 0
    for seed in range(500):
        n, rate = [(100, 0.5), (100, 0.8), (1000, 0.9), (1000, 0.95), (1000, 0.98)][seed % 5]
        drawn, result = registered(seed, n, rate)
        assert result.ok
        bounds = tj.error_bounds(result.problem, result.solution)
        assert check(drawn, result, bounds), seed
        cascade = np.linalg.norm(bounds.cascade.rotation - drawn.truth.rotation)
        assert np.isnan(bounds.matrix.value) or cascade <= bounds.matrix.value
        assert (
            np.linalg.norm(bounds.cascade.translation - drawn.truth.translation) <= bounds.translation.value
        )
        informative += bounds.whole_set.matrix.informative
    assert informative >= 450


@pytest.mark.long
def test_some_of_the_inliers_may_be_wrong():
    drawn, result = registered(3, 100, 0.2)
    strict, loose = (tj.error_bounds(result.problem, result.solution, wrong=w) for w in (0, 4))
    assert loose.whole_set.angle.value > strict.whole_set.angle.value
    # Members that are wrong matches of the refitted pose: the assumption of four covers them.
    inliers = result.inliers.copy()
    inliers[np.flatnonzero(~inliers)[:4]] = True
    selection = replace(result.solution.selection, inliers=inliers)
    solution = replace(result.solution, selection=selection, inliers=inliers)
    bounds = tj.error_bounds(result.problem, solution, wrong=4)
    assert check(drawn, result, bounds)
    assert np.all(loose.whole_set.at(drawn.src) >= strict.whole_set.at(drawn.src))


@pytest.mark.long
def test_any_pose_that_fits_as_well_lies_within_it():
    # Not the truth only: move the pose until an inlier leaves its bound.
    drawn, result = registered(1, 60, 0.3)
    bounds = tj.error_bounds(result.problem, result.solution).whole_set
    rng, pose = np.random.default_rng(0), result.pose
    src, dst = drawn.src[result.inliers], drawn.dst[result.inliers]
    tried = 0
    for _ in range(2000):
        axis = rng.normal(size=3) * rng.uniform(0, 0.1)
        from scipy.spatial.transform import Rotation

        other = tj.Pose(
            pose.rotation @ Rotation.from_rotvec(axis).as_matrix(),
            pose.translation + rng.normal(size=3) * 0.02,
            pose.scale,
        )
        if np.all(np.linalg.norm(dst - other.apply(src), axis=1) <= drawn.noise_bound):
            tried += 1
            assert np.linalg.norm(axis) <= bounds.angle.value
            assert np.all(
                np.linalg.norm(other.apply(drawn.src) - pose.apply(drawn.src), axis=1) <= bounds.at(drawn.src)
            )
    assert tried > 20


def test_the_flattest_four_is_exact():
    rng = np.random.default_rng(0)
    for _ in range(5):
        points = rng.normal(size=(8, 3))
        expected = min(
            np.linalg.svd(
                np.stack([(points[x] - points[i]) / np.linalg.norm(points[x] - points[i]) for x in three], 1),
                compute_uv=False,
            )[2]
            for i in range(8)
            for three in combinations([x for x in range(8) if x != i], 3)
        )
        assert_allclose(flattest_four(points), expected, rtol=1e-9)
    assert flattest_four(np.zeros((4, 3))) == 0


@pytest.mark.long
def test_the_bounds_of_the_paper_and_their_reasons():
    _, result = registered(0, 100, 0.5)
    bounds = tj.error_bounds(result.problem, result.solution)
    beta = float(result.problem.noise_bound[0] * result.solution.selection.widening)
    assert_allclose(bounds.translation.value, (9 + 3 * np.sqrt(3)) * beta)
    assert bounds.scale.value == 0  # known
    assert not bounds.matrix.informative
    _, many = registered(0, 200, 0.2)
    large = tj.error_bounds(many.problem, many.solution)
    assert np.isnan(large.matrix.value)
    assert "60" in large.matrix.reason
    assert "cannot be checked" in repr(large)


@pytest.mark.long
def test_contracts_say_what_holds():
    drawn = tj.synthetic.random_problem(0, n=40, outlier_rate=0.25)
    exact = drawn.dst.copy()
    exact[drawn.inliers] = drawn.truth.apply(drawn.src)[drawn.inliers]
    result = tj.register(drawn.src, exact, noise_bound=drawn.noise_bound)
    random, adversarial, noisy = tj.error_bounds(result.problem, result.solution).contracts
    assert [c.holds for c in random.conditions] == [True, None, True, True]
    assert random.holds is None
    assert adversarial.holds is True
    assert noisy.holds is None
    _, result = registered(0, 40, 0.25)  # with noise
    random, adversarial, noisy = tj.error_bounds(result.problem, result.solution).contracts
    assert adversarial.holds is False
    assert noisy.conditions[-1].holds


def test_planes_lines_and_too_few():
    drawn, result = registered(5, 40, 0.0)
    flat = drawn.src * [1, 1, 0]
    plane = tj.register(flat, drawn.truth.apply(flat), noise_bound=drawn.noise_bound)
    bounds = tj.error_bounds(plane.problem, plane.solution)
    assert np.isfinite(bounds.whole_set.angle.value)  # a plane fixes a rotation
    assert not bounds.matrix.informative
    assert bounds.contracts[2].conditions[0].holds is False
    none = np.zeros(40, bool)
    selection = replace(result.solution.selection, inliers=none, clique=none)
    empty = replace(result.solution, selection=selection, inliers=none)
    bounds = tj.error_bounds(result.problem, empty)
    assert np.isnan(bounds.whole_set.angle.value)
    assert "three right ones" in bounds.whole_set.angle.reason
    assert not bounds.whole_set.angle.informative


def test_bad_input_is_refused():
    _, result = registered(0, 40, 0.25)
    with pytest.raises(ValueError, match="wrong is -1"):
        tj.error_bounds(result.problem, result.solution, wrong=-1)
    told = repr(tj.error_bounds(result.problem, result.solution, wrong=39))
    assert "of the whole set nothing follows" in told
    assert "nan" not in told
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda p: tj.error_bounds(p, result.solution).scale)(result.problem)
