"""The network sees shapes and not frames, and the loop teaches it something without pose labels."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from oracles import random_pose

from teaser_jax import learn, synthetic
from teaser_jax.learn.network import _normals

SIZE = 320


@pytest.fixture(scope="module")
def pairs() -> learn.Pairs:
    models = [synthetic.random_solid((0, k), n=4000) for k in range(4)]
    return learn.read_pairs(
        synthetic.scan_pair((1, k), models[k % 4], n=SIZE, turn=(5, 15), sigma=0.002) for k in range(12)
    )


# Step by step they compile dozens of programs.
describe, read_scan = jax.jit(learn.describe), jax.jit(learn.read_scan)


def scan_of(points, viewpoint, **known) -> learn.Scan:
    return read_scan(np.asarray(points, np.float32), np.asarray(viewpoint, np.float32), **known)


@pytest.mark.long
def test_descriptors_are_the_same_in_every_frame():
    pair = synthetic.scan_pair(0, synthetic.teapot(20_000), n=SIZE, sigma=0.0)
    network = learn.init_network(jax.random.key(0))
    here = describe(network, scan_of(pair.src, pair.src_viewpoint))
    pose = random_pose(np.random.default_rng(0))
    moved = scan_of(pose.apply(pair.src), pose.apply(pair.src_viewpoint[None])[0])
    there = describe(network, moved)
    np.testing.assert_allclose(np.linalg.norm(here, axis=1), 1, atol=1e-5)
    # A neighbour at the very edge of a ring, or a normal at right angles to the view, may fall either way.
    assert np.median(np.sum(here * there, axis=1)) > 0.995
    order = np.random.default_rng(0).permutation(SIZE)
    shuffled = describe(network, scan_of(pair.src[order], pair.src_viewpoint))
    assert np.median(np.sum(here[order] * shuffled, axis=1)) > 0.9999


def test_normals_of_a_ball_point_outwards():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(800, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    seen, radius = ball[ball[:, 2] > 0.1], 0.12
    near = np.linalg.norm(seen[:, None] - seen, axis=2) < radius
    exist, sensor = jnp.ones(len(seen), bool), jnp.asarray([0.0, 0, 10])
    normals_of = jax.jit(lambda near: _normals(jnp.asarray(seen), sensor, exist, near, radius))
    normals = np.asarray(normals_of(near))
    assert np.mean(np.sum(normals * 2 * seen, axis=1)) > 0.98
    alone = np.asarray(normals_of(np.zeros_like(near)))
    assert np.min(alone[:, 2]) > 0.99  # nobody near: towards the sensor


@pytest.mark.long
def test_padding_changes_nothing():
    network = learn.init_network(jax.random.key(0))
    pair = synthetic.scan_pair(0, synthetic.teapot(20_000), n=SIZE)
    plain = describe(network, scan_of(pair.src, pair.src_viewpoint))
    padded = np.concatenate([pair.src, np.full((20, 3), 0.1)])
    found = describe(network, scan_of(padded, pair.src_viewpoint, mask=jnp.arange(SIZE + 20) < SIZE))
    assert np.median(np.sum(found[:SIZE] * plain, axis=1)) > 0.9999


@partial(jax.jit, static_argnames=("labels", "steps"))
def trained(network, pairs, key, *, labels=learn.solver_labels, steps=60):
    return learn.train(
        network,
        pairs,
        key,
        optimizer=OPTIMIZER,
        steps=steps,
        batch=4,
        points=224,
        noise_bound=0.06,
        labels=labels,
    )


OPTIMIZER = optax.adam(3e-3)


@pytest.fixture(scope="module")
def taught(pairs):
    """What the solver has taught, and how that went."""
    return trained(learn.init_network(jax.random.key(0)), pairs, jax.random.key(1))


@pytest.mark.long
def test_training_lowers_the_loss_and_uses_no_true_pose(pairs, taught):
    network = learn.init_network(jax.random.key(0))
    after, history = taught
    assert history.loss.shape == (60,)
    assert history.trusted.shape == history.angle.shape == (60, 4)
    trusting = np.any(history.trusted, axis=1)
    loss = np.asarray(history.loss)[trusting]
    assert np.mean(loss[-15:]) < 0.8 * np.mean(loss[:15])
    assert np.mean(np.degrees(history.angle)[history.trusted] < 15) > 0.7
    # Training on the solver's labels does not look at the true ones: others change nothing.
    others = jax.tree.map(lambda x: x[::-1], pairs.truth)
    misled, _ = trained(network, pairs._replace(truth=others), jax.random.key(1))
    jax.tree.map(np.testing.assert_array_equal, misled, after)
    supervised, told = trained(network, pairs, jax.random.key(1), labels=learn.truth_labels)
    assert np.all(told.trusted)
    np.testing.assert_allclose(told.angle, 0, atol=1e-3)
    assert jax.tree.structure(supervised) == jax.tree.structure(network)


@pytest.mark.long
def test_pairs_that_nobody_trusts_teach_nothing(pairs):
    def distrust(network, pairs, noise_bound):
        labels = learn.solver_labels(network, pairs, noise_bound)
        return learn.Labels(labels.pose, labels.inliers, jnp.zeros_like(labels.trusted), labels.status)

    network = learn.init_network(jax.random.key(0))
    blind = pairs._replace(truth=None)  # which nobody needs
    after, history = trained(network, blind, jax.random.key(1), labels=distrust, steps=3)
    assert np.all(np.isnan(history.angle))
    np.testing.assert_array_equal(history.loss, 0)
    jax.tree.map(np.testing.assert_array_equal, after, network)


def test_no_pairs_are_refused():
    with pytest.raises(ValueError, match="no pair"):
        learn.read_pairs([])


@pytest.mark.long
def test_a_checkpoint_is_the_leaves_of_a_tree(pairs, taught, tmp_path):
    network, history = taught
    labels = learn.truth_labels(network, pairs, 0.06)
    for thing in (network, history, labels, pairs):
        leaves, shape = jax.tree.flatten(thing)
        np.savez(tmp_path / "checkpoint.npz", *leaves)
        with np.load(tmp_path / "checkpoint.npz") as stored:
            again = jax.tree.unflatten(shape, [stored[f"arr_{k}"] for k in range(len(leaves))])
        jax.tree.map(np.testing.assert_array_equal, again, thing)


@pytest.mark.long
def test_a_point_that_is_no_number_is_a_masked_point():
    pair = synthetic.scan_pair(0, synthetic.teapot(20_000), n=SIZE)
    network = learn.init_network(jax.random.key(0))
    spoiled = pair.src.copy()
    spoiled[3] = np.nan
    scan = scan_of(spoiled, pair.src_viewpoint)
    assert not scan.mask[3]
    assert np.all(np.isfinite(describe(network, scan)))


def test_pairs_that_do_not_fit_are_refused(pairs):
    network = learn.init_network(jax.random.key(0))
    half = pairs._replace(dst=jax.tree.map(lambda x: x[:6], pairs.dst))
    with pytest.raises(ValueError, match="one of each"):
        learn.train(network, half, jax.random.key(0), optimizer=OPTIMIZER, steps=1)
    with pytest.raises(ValueError, match="1 or more"):
        learn.train(network, pairs, jax.random.key(0), optimizer=OPTIMIZER, steps=1, points=0)
    with pytest.raises(ValueError, match="no true poses"):
        learn.truth_labels(network, pairs._replace(truth=None), 0.05)


@pytest.mark.long
def test_a_point_alone_is_masked_and_bends_no_slope():
    """Its descriptor had length zero and a slope of a million: training never recovered."""
    pair = synthetic.scan_pair(0, synthetic.teapot(20_000), n=40, sigma=0.0)
    network = learn.init_network(jax.random.key(0))
    pose = jax.tree.map(lambda x: x[0], learn.truth_labels(None, pairs_of(pair), 0.1).pose)

    @jax.jit
    @jax.grad
    def slope_of(parameters, scan):
        found = learn.describe(parameters, scan)
        return learn.matching_loss(
            found, found, scan.points, scan.points, pose.inverse() @ pose, radius=0.02, src_mask=scan.mask
        )

    slopes = []
    for points in (pair.src, np.concatenate([pair.src[:-1], [[9.0, 9, 9]]])):
        scan = scan_of(points, pair.src_viewpoint, reach=1.0)
        slopes.append(max(float(np.max(np.abs(x))) for x in jax.tree.leaves(slope_of(network, scan))))
    assert not scan.mask[-1]
    assert scan.mask[:-1].all()
    assert slopes[1] < 3 * slopes[0]


def pairs_of(pair) -> learn.Pairs:
    return learn.read_pairs([pair])


def test_training_on_nonsense_is_refused(pairs):
    network, key = learn.init_network(jax.random.key(0)), jax.random.key(1)
    known = {"optimizer": optax.sgd(0.01), "steps": 1, "batch": 2}
    for wrong in ({"radius": -1.0}, {"noise_bound": float("nan")}, {"temperature": 0.0}, {"points": 3}):
        with pytest.raises(ValueError, match="expected"):
            learn.train(network, pairs, key, **known, **wrong)
    other = synthetic.scan_pair(1, synthetic.teapot(20_000), n=SIZE - 1)
    same = synthetic.scan_pair(1, synthetic.teapot(20_000), n=SIZE)
    with pytest.raises(ValueError, match="expected one for all"):
        learn.read_pairs([same, other])
