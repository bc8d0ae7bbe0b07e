"""Errors of a pose and of an inlier set."""

from __future__ import annotations

import math

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import teaser_jax as tj
from teaser_jax import metrics


def pose(rotvec=(0, 0, 0), translation=(0, 0, 0), scale=1.0) -> tj.Pose:
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    return tj.Pose(rotation, np.asarray(translation, float), np.asarray(scale, float))


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.0, math.pi])
def test_rotation_error_is_the_angle_between(angle):
    rng = np.random.default_rng(0)
    axis = rng.normal(size=3)
    axis *= angle / np.linalg.norm(axis)
    base = Rotation.random(random_state=1)
    estimate = pose((base * Rotation.from_rotvec(axis)).as_rotvec())
    truth = pose(base.as_rotvec())
    assert metrics.rotation_error(estimate, truth) == pytest.approx(angle, abs=1e-12)
    assert metrics.rotation_error(truth, estimate) == pytest.approx(angle, abs=1e-12)


def test_translation_and_scale_errors_are_distances():
    assert metrics.translation_error(pose(translation=(1, 2, 2)), pose()) == pytest.approx(3)
    assert metrics.scale_error(pose(scale=0.5), pose(scale=2.0)) == pytest.approx(1.5)


@pytest.mark.long
def test_batches_and_jax_arrays_keep_their_kind():
    two = tj.Pose(jnp.stack([jnp.eye(3)] * 2), jnp.ones((2, 3)), jnp.ones(2))
    for error in (metrics.rotation_error, metrics.translation_error, metrics.scale_error):
        assert error(two, two).shape == (2,)
        np.testing.assert_allclose(error(two, two), 0)


@pytest.mark.parametrize(
    ("found", "right", "precision", "recall"),
    [
        ([1, 1, 0, 0], [1, 0, 1, 0], 0.5, 0.5),
        ([1, 0, 0], [1, 1, 1], 1.0, 1 / 3),
        ([0, 0], [1, 0], math.nan, 0.0),
        ([1, 0], [0, 0], 0.0, math.nan),
    ],
)
def test_precision_and_recall(found, right, precision, recall):
    assert metrics.precision_recall(found, right) == pytest.approx((precision, recall), nan_ok=True)


def test_errors_are_the_three_at_once():
    estimate, truth = pose((0, 0, 0.1), (0, 3, 4), 1.5), pose()
    found = metrics.errors(estimate, truth)
    assert found == pytest.approx((0.1, 5.0, 0.5))
    assert found.rotation_deg == pytest.approx(math.degrees(0.1))


def test_what_is_no_mask_of_the_same_matches(unchecked):
    for found in (np.ones(3, bool), ["a", "b"], np.zeros(2, [("x", float)])):
        with pytest.raises(ValueError, match="expected masks of the same matches"):
            tj.metrics.precision_recall(found, np.ones(2, bool))
