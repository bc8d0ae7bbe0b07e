"""Rotation search by itself: methods, sets, proofs, jit, and bad input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import BOUND, draw_vectors, rotation_cost

import teaser_jax as tj
from teaser_jax.certify.certificate import CertificateStatus
from teaser_jax.settings import Gnc, PairSearch
from teaser_jax.so3 import rotation_angle


@pytest.mark.long
@pytest.mark.parametrize("method", ["gnc", "global"])
def test_the_rotation_the_sets_the_cost_and_the_proof(method):
    src, dst, truth = draw_vectors(0, 30, 0.4)
    found = tj.solve_rotation(src, dst, noise_bound=BOUND, method=method)
    assert np.degrees(rotation_angle(truth.T @ found.rotation)) < 2
    r2 = np.sum((dst - src @ found.rotation.T) ** 2, axis=1)
    assert np.array_equal(found.inliers, r2 <= BOUND**2)
    assert_allclose(found.cost, rotation_cost(src, dst, found.rotation))
    assert found.certificate.is_optimal
    assert tj.verify(src, dst, found.rotation, found.certificate, noise_bound=BOUND)
    assert "30 measurements" in repr(found)


@pytest.mark.long
@pytest.mark.parametrize(("k", "runs"), [(40, 10), pytest.param(100, 10, marks=pytest.mark.slow)])
@pytest.mark.parametrize("wrong", [0.8, 0.9])
def test_hard_rates_are_solved_and_most_are_certified(k, runs, wrong):
    certified = 0
    for seed in range(runs):
        src, dst, truth = draw_vectors([k, seed], k, wrong)
        found = tj.solve_rotation(src, dst, noise_bound=BOUND)
        assert found.cost <= rotation_cost(src, dst, truth) + 1e-9
        assert found.certificate.status in (CertificateStatus.OPTIMAL, CertificateStatus.UNKNOWN)
        certified += bool(found.certificate.is_optimal)
    assert certified >= 0.8 * runs  # of 30 runs with 40, 90 % wrong: 25


@pytest.mark.long
def test_rows_of_the_mask_in_the_order_of_the_user():
    src, dst, _ = draw_vectors(1, 20, 0.2)
    order = np.random.default_rng(0).permutation(25)
    wide = np.full((25, 3), np.nan), np.full((25, 3), np.nan)
    where = np.sort(order[:20])
    wide[0][where], wide[1][where] = src, dst
    plain = tj.solve_rotation(src, dst, noise_bound=BOUND)
    masked = tj.solve_rotation(*wide, noise_bound=BOUND, mask=np.isin(np.arange(25), where))
    unmasked = tj.solve_rotation(*wide, noise_bound=BOUND)
    for found in (masked, unmasked):
        assert_allclose(found.rotation, plain.rotation, atol=1e-9)
        assert np.array_equal(np.flatnonzero(found.inliers), where[plain.inliers])


def test_a_bound_for_each_and_vectors_of_no_length():
    src, dst, _ = draw_vectors(2, 12, 0.0)
    src[3] = 0
    bounds = np.full(12, BOUND)
    bounds[3] = 10 * np.linalg.norm(dst[3]) + BOUND
    found = tj.solve_rotation(src, dst, noise_bound=bounds)
    assert found.inliers[3]
    r2 = np.sum((dst - src @ found.rotation.T) ** 2, axis=1) / bounds**2
    assert_allclose(found.cost, np.minimum(r2, 1).sum())


@pytest.mark.long
def test_under_jit_and_vmap_and_in_float32():
    drawn = [draw_vectors(seed, 16, 0.5) for seed in range(3)]
    src, dst = (np.stack([d[i] for d in drawn]) for i in range(2))
    batch = jax.jit(jax.vmap(lambda a, b: tj.solve_rotation(a, b, noise_bound=BOUND, proof="direct")))(
        src.astype(np.float32), dst.astype(np.float32)
    )
    assert batch.rotation.dtype == np.float32
    for i in range(3):
        alone = tj.solve_rotation(src[i], dst[i], noise_bound=BOUND)
        assert_allclose(batch.rotation[i], alone.rotation, atol=1e-4)
        assert np.array_equal(batch.inliers[i], alone.inliers)
    nothing = jax.jit(lambda a, b: tj.solve_rotation(a, b, noise_bound=BOUND, proof=None))(src[0], dst[0])
    assert nothing.certificate is None


@pytest.mark.parametrize("k", [0, 1, 2])
def test_few_measurements_give_an_answer_and_no_crash(k):
    src, dst, _ = draw_vectors(3, max(k, 1), 0.0)
    found = tj.solve_rotation(src[:k], dst[:k], noise_bound=BOUND)
    assert np.isfinite(found.rotation).all()
    assert_allclose(np.linalg.det(found.rotation), 1)
    assert bool(found.certificate.is_optimal) == (k > 0)
    if k == 0:
        assert found.certificate.status == CertificateStatus.NO_MEASUREMENTS


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(method="ransac"), "expected one of 'gnc', 'global', 'sdp'"),
        (dict(src=np.ones((4, 2))), "expected \\(k, 3\\) both"),
        (dict(noise_bound=0.0), "above 0"),
        (dict(noise_bound=np.ones(3)), "shapes"),
        (dict(cbar2=-1.0), "above 0"),
        (dict(mask=np.ones(3, bool)), "mask has shape"),
        (dict(mask=[0, 2, 5]), "truth values"),
        (dict(dst=np.full((12, 3), 1e100)), "vectors reach 1e.100 with"),
        (dict(src=np.ones((12, 3), complex)), "expected real numbers"),
        (dict(tolerance="x"), "tolerance is 'x': expected a number between 0 and 1"),
        (dict(tolerance=0.0), "tolerance"),
        (dict(proof="magic"), "proof is 'magic'"),
    ],
)
def test_bad_input_is_refused(unchecked, change, words):
    src, dst, _ = draw_vectors(0, 12, 0.0)
    with pytest.raises(ValueError, match=words):
        tj.solve_rotation(**(dict(src=src, dst=dst, noise_bound=BOUND) | change))


@pytest.mark.long
def test_the_record_is_asked_for_its_turn(monkeypatch):
    """A method that is added turns the rotation by itself, and not by the search over pairs."""
    asked = []
    turn = PairSearch.turn
    monkeypatch.setattr(PairSearch, "turn", lambda self, m: asked.append(self) or turn(self, m))
    a = np.random.default_rng(0).normal(size=(9, 3))
    tj.solve_rotation(a, a, noise_bound=0.1, method=PairSearch(gnc=Gnc(iterations=7)), proof=None)
    assert asked


def test_vectors_far_beyond_their_bounds_end_no_iteration_and_have_no_rotation():
    src, dst, _ = draw_vectors(0, 12, 0.0)
    with pytest.raises(ValueError, match="square and compare"):
        tj.solve_rotation(src, dst, noise_bound=1e-160)
    ask = lambda bound: tj.solve_rotation(src, dst, noise_bound=bound, method="gnc", proof=None)
    found = jax.jit(ask)(jnp.float32(1e-19))
    assert_allclose(found.rotation, np.eye(3))
    assert not found.inliers.any()
