"""Losses against what they stand for, and their gradients where angles and lengths have kinks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from oracles import random_pose

import teaser_jax as tj
from teaser_jax import learn

# Step by step each loss compiles dozens of programs.
matching_loss, rotation_loss, translation_loss = (
    jax.jit(f) for f in (learn.matching_loss, learn.rotation_loss, learn.translation_loss)
)
point_loss, inlier_loss, keypoint_loss = (
    jax.jit(f) for f in (learn.point_loss, learn.inlier_loss, learn.keypoint_loss)
)


def pose(seed: int) -> tj.Pose:
    return jax.tree.map(jnp.asarray, random_pose(np.random.default_rng(seed)))


def test_pose_losses_are_the_errors(x64):
    a, b = pose(0), pose(1)
    errors = tj.metrics.errors(a, b)
    assert rotation_loss(a, b) == pytest.approx(float(errors.rotation), rel=1e-12)
    assert translation_loss(a, b) == pytest.approx(float(errors.translation), rel=1e-12)
    points = np.random.default_rng(0).normal(size=(10, 3))
    mask = np.arange(10) < 7
    apart = np.linalg.norm(np.asarray(a.apply(points) - b.apply(points)), axis=1)
    assert point_loss(a, b, points) == pytest.approx(apart.mean())
    assert point_loss(a, b, points, mask) == pytest.approx(apart[:7].mean())


def test_pose_losses_take_batches(x64):
    stack = lambda *x: jax.tree.map(lambda *y: jnp.stack(y), *x)
    several, others = stack(pose(0), pose(1)), stack(pose(2), pose(3))
    points = np.random.default_rng(0).normal(size=(2, 5, 3))
    for loss in (rotation_loss, translation_loss, lambda a, b: point_loss(a, b, points)):
        assert jax.eval_shape(loss, several, others).shape == (2,)
    np.testing.assert_allclose(rotation_loss(several, others)[1], rotation_loss(pose(1), pose(3)), rtol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1.0, np.pi - 1e-9, np.pi])
def test_gradients_are_finite_at_every_angle(angle, x64):
    truth = pose(0)
    axis = np.array([1.0, 2.0, 2.0]) / 3
    turn = tj.so3.rotation_from_quat(np.append(np.sin(angle / 2) * axis, np.cos(angle / 2)))

    def loss(rotation):
        estimate = tj.Pose(rotation, truth.translation, truth.scale)
        points = jnp.zeros((4, 3)).at[1, 0].set(1.0)
        total = rotation_loss(estimate, truth) + translation_loss(estimate, truth)
        return total + point_loss(estimate, truth, points)

    value, slope = jax.jit(jax.value_and_grad(loss))(truth.rotation @ turn)
    assert np.isfinite(value)
    assert np.all(np.isfinite(slope))


def test_inlier_loss_is_balanced_cross_entropy(x64):
    rng = np.random.default_rng(0)
    logits, inliers, mask = rng.normal(size=(3, 20)), rng.random((3, 20)) < 0.2, rng.random((3, 20)) < 0.8
    each = np.asarray(optax.sigmoid_binary_cross_entropy(logits, inliers.astype(float)))
    expected = 0.5 * (each[mask & inliers].mean() + each[mask & ~inliers].mean())
    assert inlier_loss(logits, inliers, mask) == pytest.approx(expected)
    # More wrong matches of the same kind change nothing.
    wrong = np.concatenate([logits, logits[:, ~inliers.any(axis=0)]], axis=1)
    assert np.isfinite(inlier_loss(wrong, np.zeros(wrong.shape, bool)))


def test_keypoint_loss_saturates_and_draws_keypoints_together(x64):
    truth, src = pose(4), np.random.default_rng(0).normal(size=(8, 3))
    dst = np.array(truth.apply(src))
    assert keypoint_loss(src, dst, truth, noise_bound=0.1) < 1e-20
    dst[0] += 1e6
    assert keypoint_loss(src, dst, truth, noise_bound=0.1) == pytest.approx(1 / 8)
    assert keypoint_loss(src, dst, truth, noise_bound=0.1, mask=np.arange(8) > 0) < 1e-20
    off = src + 0.05
    loss = jax.jit(jax.value_and_grad(lambda src: keypoint_loss(src, dst, truth, noise_bound=0.1)))
    before, slope = loss(off)
    assert loss(off - 0.01 * np.asarray(slope))[0] < before


def test_matching_loss_by_hand(x64):
    rng = np.random.default_rng(0)
    src = rng.uniform(size=(6, 3))
    truth = pose(5)
    dst = np.concatenate([np.asarray(truth.apply(src[:4])), rng.uniform(5, 6, (3, 3))])
    a, b = rng.normal(size=(6, 4)), rng.normal(size=(7, 4))
    a, b = (x / np.linalg.norm(x, axis=1, keepdims=True) for x in (a, b))
    found = matching_loss(a, b, src, dst, truth, radius=1e-3, temperature=0.5)
    weight = np.exp(a @ b.T / 0.5)
    rows = np.mean([-np.log(weight[i, i] / weight[i].sum()) for i in range(4)])
    columns = np.mean([-np.log(weight[i, i] / weight[:, i].sum()) for i in range(4)])
    assert found == pytest.approx(0.5 * (rows + columns))


@pytest.mark.long
def test_nothing_to_learn_from_is_zero_with_gradient_zero():
    truth, nothing = pose(6), jnp.zeros(5, bool)
    src, a = jnp.zeros((5, 3)), jnp.ones((5, 4))
    losses = [
        lambda a: learn.matching_loss(a, a, src, src + 9, truth, radius=0.1),
        lambda a: inlier_loss(a[:, 0], nothing, nothing),
        lambda a: keypoint_loss(a[:, :3], src, truth, noise_bound=0.1, mask=nothing),
        lambda a: point_loss(truth, pose(7), a[:, :3], nothing),
    ]
    for loss in losses:
        value, slope = jax.jit(jax.value_and_grad(loss))(a)
        assert value == 0
        np.testing.assert_array_equal(slope, 0)


def unit_rows(seed: int, n: int = 10) -> np.ndarray:
    rows = np.random.default_rng(seed).normal(size=(n, 8)).astype(np.float32)
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)


@jax.jit
def contrastive(a, b, points, pose, temperature):
    """The loss and its gradient in the first descriptors."""
    loss = lambda x: learn.matching_loss(x, b, points, points, pose, radius=1e-3, temperature=temperature)
    return jax.value_and_grad(loss)(a)


@pytest.mark.parametrize("temperature", [0.1, 0.01, 0.001])
def test_the_contrastive_loss_is_exact_at_every_temperature(temperature):
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    one = tj.Pose(np.eye(3), np.zeros(3), np.asarray(1.0))
    a, b = unit_rows(0), unit_rows(1)
    scores = (a.astype(float) @ b.astype(float).T) / temperature
    total = lambda axis: scores.max(axis) + np.log(np.exp(scores - scores.max(axis, keepdims=True)).sum(axis))
    both = [np.mean(total(axis) - np.diagonal(scores)) for axis in (0, 1)]
    loss, slope = contrastive(a, b, points, one, temperature)
    assert loss == pytest.approx(np.mean(both), rel=1e-4)
    assert np.isfinite(slope).all()


def test_points_that_are_masked_or_no_numbers_do_not_count():
    points = np.random.default_rng(0).normal(size=(10, 3)).astype(np.float32)
    one = tj.Pose(np.eye(3), np.zeros(3), np.asarray(1.0))
    a, b = unit_rows(0), unit_rows(1)
    broken, odd, some = points.copy(), a.copy(), np.arange(10) > 0
    broken[0], odd[0] = np.nan, np.inf
    loss = lambda x, src, **known: matching_loss(x, b, src, points, one, radius=0.01, **known)
    expected = loss(a, points, src_mask=some)
    assert expected > 0
    assert loss(a, broken, src_mask=some) == expected
    assert loss(a, broken) == expected
    assert loss(odd, points) == expected


def test_losses_of_what_is_no_number_are_none():
    one = tj.Pose(np.eye(3), np.zeros(3), np.asarray(1.0))
    lost = tj.Pose(np.full((3, 3), np.nan), np.full(3, np.nan), np.asarray(np.nan))
    points = np.ones((4, 3), np.float32)
    assert np.isnan(rotation_loss(lost, one))
    assert np.isnan(translation_loss(lost, one))
    assert np.isnan(point_loss(lost, one, points))
    assert np.isnan(point_loss(one, one, np.nan * points))
    assert np.isnan(keypoint_loss(points, points, lost, noise_bound=0.1))


@jax.jit
def keypoint_slope(dst, src):
    one = tj.Pose(np.eye(3, dtype=np.float32), np.zeros(3, np.float32), np.float32(1))
    return jax.grad(lambda dst: learn.keypoint_loss(src, dst, one, noise_bound=0.5))(dst)


@pytest.mark.parametrize("kind", [np.int32, np.float16, np.float32])
@pytest.mark.parametrize("far", [0, 3, 1e4])
def test_keypoints_of_every_type_and_distance(kind, far):
    one = tj.Pose(np.eye(3, dtype=np.float32), np.zeros(3, np.float32), np.float32(1))
    src = np.zeros((5, 3), kind)
    loss = lambda dst: keypoint_loss(src, dst, one, noise_bound=0.5)
    dst = src + np.asarray(far, kind)
    assert loss(dst) == pytest.approx(3 * far**2 / (0.25 + 3 * far**2), rel=1e-3)
    assert np.isfinite(keypoint_slope(dst.astype(np.float32), src)).all()


def test_impossible_numbers_are_refused(unchecked):
    one = tj.Pose(np.eye(3), np.zeros(3), np.asarray(1.0))
    points, a = np.ones((4, 3), np.float32), unit_rows(0, 4)
    weights = np.full(4, 0.5, np.float32)
    for wrong in (
        lambda: learn.keypoint_loss(points, points, one, noise_bound=0.0),
        lambda: learn.keypoint_loss(points, points[:1], one, noise_bound=1.0),
        lambda: learn.keypoint_loss(points, points, one, noise_bound=1.0, mask=weights),
        lambda: learn.point_loss(one, one, points, weights),
        lambda: learn.matching_loss(a, a, points, points, one, radius=-1.0),
        lambda: learn.matching_loss(a, a, points, points, one, radius=1.0, temperature=0.0),
        lambda: learn.matching_loss(a, a, points, points, one, radius=1.0, src_mask=weights),
        lambda: learn.soft_counterparts(a, a, points, dst_mask=np.ones(1, bool)),
        lambda: learn.teacher(points[None], points[None], noise_bound=-1.0),
        lambda: learn.teacher(np.stack([points] * 2), np.stack([points] * 2), noise_bound=np.ones(2)),
        lambda: learn.read_scan(points, np.ones(3), reach=0.0),
        lambda: learn.read_scan(points.T, np.ones(3)),
        lambda: learn.read_scan(points, np.ones((1, 3))),
        lambda: learn.init_network(jax.random.key(0), width=0),
    ):
        with pytest.raises(ValueError, match="expected"):
            wrong()
