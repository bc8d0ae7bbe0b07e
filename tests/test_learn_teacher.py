"""The solver as a teacher: labels for a batch, and which of them to trust."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random_matches

import teaser_jax as tj
from teaser_jax.learn import teacher

N = 32
_taught = jax.jit(
    lambda src, dst, mask, least: teacher(src, dst, noise_bound=0.05, mask=mask, least_inliers=least)
)


def taught(src, dst, *, mask=None, least_inliers=0):
    """One program for all choices."""
    return _taught(src, dst, np.ones(src.shape[:-1], bool) if mask is None else mask, least_inliers)


def batch_of(*wrong: float) -> tuple[np.ndarray, np.ndarray, list]:
    drawn = [random_matches(k, N, wrong=share, noise=0.5) for k, share in enumerate(wrong)]
    return np.stack([d.src for d in drawn]), np.stack([d.dst for d in drawn]), drawn


@pytest.mark.long
def test_right_labels_are_trusted_and_hopeless_ones_are_not(x64):
    src, dst, drawn = batch_of(0.3, 0.5, 1.0)
    labels = taught(src, dst)
    np.testing.assert_array_equal(labels.trusted, [True, True, False])
    for k in range(2):
        one = jax.tree.map(lambda x, k=k: x[k], labels)
        np.testing.assert_array_equal(one.inliers, drawn[k].inliers)
        assert np.max(np.abs(one.pose.matrix - drawn[k].truth.matrix)) < 0.05
    assert labels.status[2] != tj.Status.OK


@pytest.mark.long
def test_axes_masks_and_thresholds(x64):
    src, dst, drawn = batch_of(0.3, 0.5, 1.0)
    several = taught(np.stack([src, src]), np.stack([dst, dst]))
    assert several.pose.rotation.shape == (2, 3, 3, 3)
    np.testing.assert_array_equal(several.inliers[1], taught(src, dst).inliers)
    mask = np.arange(N) > 10
    masked = taught(src, dst, mask=np.broadcast_to(mask, (3, N)))
    assert not np.any(masked.inliers[:, ~mask])
    few = int(drawn[1].inliers.sum())
    np.testing.assert_array_equal(taught(src, dst, least_inliers=few + 1).trusted, [True, False, False])


@pytest.mark.long
def test_no_gradient_flows_into_labels(x64):
    src, dst, _ = batch_of(0.3, 0.5, 1.0)
    slope = jax.jit(jax.grad(lambda dst: jnp.sum(teacher(src, dst, noise_bound=0.05).pose.matrix)))(dst)
    np.testing.assert_array_equal(slope, 0)


def test_shapes_that_do_not_fit_are_told(unchecked):
    with pytest.raises(ValueError, match="expected the same"):
        teacher(jnp.zeros((2, 5, 3)), jnp.zeros((2, 6, 3)), noise_bound=0.1)
    with pytest.raises(ValueError, match="expected the same"):
        teacher(jnp.zeros((3, 5)), jnp.zeros((3, 5)), noise_bound=0.1)
