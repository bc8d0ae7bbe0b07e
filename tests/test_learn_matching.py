"""Matches from descriptors, with confidences that carry a gradient."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from teaser_jax import learn
from teaser_jax.learn import soft_counterparts

match = partial(jax.jit, static_argnames="mutual")(learn.match)  # step by step it compiles a hundred programs
counterparts = jax.jit(soft_counterparts)


def descriptors(seed: int, n: int, m: int, d: int = 8) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, d)), rng.normal(size=(m, d))


def test_the_dual_softmax_by_hand(x64):
    a, b = descriptors(0, 7, 9)
    found = match(a, b, temperature=0.5)
    weight = np.exp(a @ b.T / 0.5)
    both = weight / weight.sum(axis=1, keepdims=True) * weight / weight.sum(axis=0)
    np.testing.assert_array_equal(found.counterpart, weight.argmax(axis=1))
    np.testing.assert_allclose(found.confidence, both[np.arange(7), found.counterpart], rtol=1e-12)
    mutual = weight.argmax(axis=0)[weight.argmax(axis=1)] == np.arange(7)
    np.testing.assert_array_equal(found.mask, mutual)
    assert np.all(match(a, b, mutual=False).mask)


def test_equal_descriptors_find_each_other():
    a, _ = descriptors(1, 20, 1)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    order = np.random.default_rng(0).permutation(20)
    found = match(jnp.asarray(a), jnp.asarray(a[order]), temperature=0.01)
    np.testing.assert_array_equal(order[found.counterpart], np.arange(20))
    assert np.all(found.mask)
    np.testing.assert_allclose(found.confidence, 1, atol=1e-3)


@pytest.mark.long
def test_masked_points_match_nothing_and_change_nothing(x64):
    a, b = descriptors(2, 6, 8)
    spoiled = np.vstack([b, 100 * b[:3]])
    found = match(np.vstack([a, 100 * a[:2]]), spoiled, src_mask=np.arange(8) < 6, dst_mask=np.arange(11) < 8)
    plain = match(a, b)
    for mine, expected in zip(found, plain, strict=True):
        np.testing.assert_allclose(mine[:6], expected)
    assert not np.any(found.mask[6:])
    np.testing.assert_array_equal(found.confidence[6:], 0)
    nothing = match(a, b, dst_mask=np.zeros(8, bool))
    assert not np.any(nothing.mask)
    assert np.all(np.isfinite(nothing.confidence))


def test_confidences_have_an_exact_gradient(x64):
    a, b = descriptors(3, 6, 8)
    direction = np.random.default_rng(0).normal(size=a.shape)
    confidence = lambda a: match(a, jnp.asarray(b), temperature=0.7).confidence
    _, forward = jax.jit(lambda a, d: jax.jvp(confidence, (a,), (d,)))(jnp.asarray(a), jnp.asarray(direction))
    central = (confidence(a + 1e-6 * direction) - confidence(a - 1e-6 * direction)) / 2e-6
    np.testing.assert_allclose(forward, central, atol=1e-8)
    assert np.max(np.abs(forward)) > 1e-3


def test_a_cold_softmax_is_the_hard_choice_and_a_warm_one_has_a_gradient(x64):
    a, b = descriptors(4, 6, 8)
    dst = np.random.default_rng(0).normal(size=(8, 3))
    cold = counterparts(a, b, dst, temperature=1e-3)
    np.testing.assert_allclose(cold, dst[match(a, b).counterpart], atol=1e-9)
    kept = np.arange(8) < 5
    np.testing.assert_allclose(
        counterparts(a, b, dst, dst_mask=kept), counterparts(a, b[:5], dst[:5]), atol=1e-12
    )
    total = lambda a: jnp.sum(soft_counterparts(a, b, dst, temperature=1.0) ** 2)
    assert np.all(np.abs(jax.jit(jax.grad(total))(jnp.asarray(a))) > 0)


@pytest.mark.parametrize("size", [1e-30, 1e30])
def test_descriptors_of_any_size_are_finite(size):
    a, b = descriptors(5, 6, 8)
    found = match(jnp.asarray(size * a, jnp.float32), jnp.asarray(b, jnp.float32))
    assert np.all(np.isfinite(found.confidence))


def test_descriptors_that_are_not_finite_match_nothing_and_spoil_no_gradient(x64):
    a, b = descriptors(6, 6, 8)
    a[1], b[2] = np.nan, np.inf
    found = match(a, b, mutual=False)
    assert not found.mask[1]
    assert not np.any(found.counterpart[found.mask] == 2)
    slope = jax.jit(jax.grad(lambda a: jnp.sum(match(a, jnp.asarray(b)).confidence)))(jnp.asarray(a))
    assert np.all(np.isfinite(slope))


def test_nonsense_is_refused(unchecked):
    a, b = (jnp.asarray(x) for x in descriptors(7, 6, 8))
    for bad in ((a, b[:, :3]), (a, b[:0]), (a[None], b[None])):
        with pytest.raises(ValueError, match="expected"):
            learn.match(*bad)
    with pytest.raises(ValueError, match="temperature"):
        learn.match(a, b, temperature=-1.0)
