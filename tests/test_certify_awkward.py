"""Certificates where they are degenerate: never a crash, never a claim that does not hold."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import BOUND, best_rotation, draw_vectors, rotation_cost, tampered, turned

from teaser_jax import certify_rotation, verify
from teaser_jax.certify.certificate import CertificateStatus, CertifiedBy

OPEN = (CertificateStatus.UNKNOWN, CertificateStatus.SUBOPTIMAL)


def sound(src, dst, rotation, found) -> bool:
    """No claim beyond the best rotation that a slow search knows, and each one confirmed by itself."""
    _, least = best_rotation(src, dst)
    least = min(least, rotation_cost(src, dst, rotation))
    allowed = 1e-3 * found.cost + 1e-6 + 1e-9
    true = found.lower_bound <= least + 1e-9 and (not found.is_optimal or found.cost <= least + allowed)
    return true and (not found.is_optimal or verify(src, dst, rotation, found, noise_bound=BOUND))


@jax.jit
def with_odd_mask(src, dst, rotation, bound):
    """A certificate of 12 measurements inside jit, all of which a mask of numbers chooses."""
    return certify_rotation(src, dst, rotation, noise_bound=bound, mask=[2] * 12)


@pytest.mark.long
def test_no_measurements():
    found = certify_rotation(np.zeros((0, 3)), np.zeros((0, 3)), np.eye(3), noise_bound=BOUND)
    assert found.status == CertificateStatus.NO_MEASUREMENTS
    assert not found.is_optimal
    assert found.measurements == 0


def test_no_noise_and_no_outliers_has_no_relative_gap():
    src, _, rotation = draw_vectors(0, 12, 0.0)
    for dst in (src @ rotation.T, src @ rotation.T * (1 + 1e-9)):
        found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
        assert found.is_optimal
        assert found.method == CertifiedBy.ZERO_COST
        assert found.suboptimality == 0
        assert found.absolute_gap <= 1e-6
        assert verify(src, dst, rotation, found, noise_bound=BOUND)


def test_a_tiny_cost_is_settled_by_the_absolute_gap():
    src, dst, rotation = draw_vectors(0, 12, 0.0, sigma=1e-6)
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    assert found.is_optimal
    assert found.absolute_gap < 1e-6
    assert sound(src, dst, rotation, found)


@pytest.mark.long
@pytest.mark.parametrize("k", [1, 2, 3])
def test_few_measurements(k):
    for seed in range(3):
        src, dst, rotation = draw_vectors((k, seed), k, 0.0)
        best, _ = best_rotation(src, dst)
        found = certify_rotation(src, dst, best, noise_bound=BOUND)
        assert sound(src, dst, best, found)
        assert found.is_optimal
        if k == 1:
            assert not found.is_unique  # any turn about the vector is as good


def test_a_plane_is_certified():
    src, dst, rotation = draw_vectors(1, 12, 0.0)
    src = src * [1, 1, 0]
    dst = src @ rotation.T + (dst - draw_vectors(1, 12, 0.0)[0] @ rotation.T)
    best, _ = best_rotation(src, dst)
    found = certify_rotation(src, dst, best, noise_bound=BOUND)
    assert found.is_optimal
    assert sound(src, dst, best, found)


@pytest.mark.long
def test_a_line_may_be_certified_and_is_never_unique():
    rng = np.random.default_rng(0)
    src = np.linspace(-1, 1, 10)[:, None] * [1.0, 2.0, 3.0]
    rotation = draw_vectors(0, 3, 0.0)[2]
    for noise in (0.0, 0.001, 0.01):
        dst = src @ rotation.T + noise * rng.normal(size=src.shape)
        found = certify_rotation(src, dst, rotation, noise_bound=BOUND, iterations=50)
        assert not found.is_unique
        assert np.isinf(found.angle_bound) or noise == 0.01  # noise off the line fixes the turn, barely
        assert sound(src, dst, rotation, found)


@pytest.mark.long
def test_no_inlier_claims_nothing():
    for seed in range(5):
        src, dst, _ = draw_vectors(seed, 10, 1.0)
        for s in range(50):  # a rotation that fits none
            rotation = turned(np.eye(3), 180 * (s + 1) / 50, s)
            if rotation_cost(src, dst, rotation) == 10:
                break
        found = certify_rotation(src, dst, rotation, noise_bound=BOUND, iterations=30)
        assert np.isfinite(found.lower_bound)
        assert sound(src, dst, rotation, found)
        if best_rotation(src, dst)[1] < 9.9:
            assert found.status in OPEN


def test_a_residual_at_the_very_bound():
    src, dst, rotation = draw_vectors(2, 10, 0.0)
    best, _ = best_rotation(src, dst)
    away = dst[0] - src[0] @ best.T
    for factor in (1 - 1e-12, 1.0, 1 + 1e-12):
        dst[0] = src[0] @ best.T + factor * BOUND * away / np.linalg.norm(away)
        found = certify_rotation(src, dst, best, noise_bound=BOUND, iterations=60)
        assert sound(src, dst, best, found)


def test_vectors_of_no_length_are_set_apart():
    src, dst, rotation = draw_vectors(4, 12, 0.0)
    src[3], dst[5] = 0, 0
    best, _ = best_rotation(src, dst)
    found = certify_rotation(src, dst, best, noise_bound=BOUND)
    assert found.measurements == 10
    assert found.is_optimal
    assert_allclose(found.cost, rotation_cost(src, dst, best))
    assert verify(src, dst, best, found, noise_bound=BOUND)
    only = certify_rotation(np.zeros((3, 3)), dst[:3], best, noise_bound=BOUND)
    assert not only.is_optimal


@pytest.mark.long
def test_duplicates_are_harmless():
    src, dst, _ = draw_vectors(5, 10, 0.2)
    src, dst = np.repeat(src, 2, axis=0), np.repeat(dst, 2, axis=0)
    best = certify_rotation(src, dst, draw_vectors(5, 10, 0.2)[2], noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, best, noise_bound=BOUND)
    assert found.is_optimal
    assert sound(src[::2], dst[::2], best, certify_rotation(src[::2], dst[::2], best, noise_bound=BOUND))


@pytest.mark.long
@pytest.mark.parametrize(
    "make", [lambda r: -r, lambda r: 2 * r, lambda r: r + 0.1, lambda r: np.zeros((3, 3))]
)
def test_what_is_no_rotation_is_projected(make):
    src, dst, rotation = draw_vectors(6, 12, 0.0)
    best, _ = best_rotation(src, dst)
    given = make(best)
    left, _, right = np.linalg.svd(given)
    projected = left @ np.diag([1, 1, np.linalg.det(left @ right)]) @ right
    found = certify_rotation(src, dst, given, noise_bound=BOUND)
    assert_allclose(np.linalg.det(found.rotation), 1)
    if np.any(given):
        assert_allclose(found.cost, rotation_cost(src, dst, projected), rtol=1e-9)
    assert not (found.is_optimal and found.cost > best_rotation(src, dst)[1] * 1.001 + 1e-6)


@pytest.mark.long
def test_not_a_number_anywhere():
    src, dst, rotation = draw_vectors(7, 12, 0.0)
    odd = dst.copy()
    odd[2, 1] = np.nan
    keep = np.arange(12) != 2
    best = certify_rotation(src[keep], dst[keep], rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, odd, best, noise_bound=BOUND)
    assert found.is_optimal
    assert found.measurements == 11
    # Inside jit nothing can be raised: nothing is claimed instead.
    for r, bound in ((np.full((3, 3), np.nan), BOUND), (best, np.nan), (best, 0.0), (best, -1.0)):
        inside = with_odd_mask(src, dst, r, bound)
        known = rotation_cost(src, dst, best)
        assert not bool(inside.is_optimal) or (bound == BOUND and float(inside.cost) <= 1.001 * known)


def test_a_gap_below_what_float64_resolves_is_undecidable():
    src, dst, rotation = draw_vectors(8, 12, 0.0)
    tiny = 3e-8
    dst = src @ rotation.T + tiny * 0.3 * np.random.default_rng(0).normal(size=src.shape)
    found = certify_rotation(src, dst, rotation, noise_bound=tiny)
    assert not found.is_optimal or verify(src, dst, rotation, found, noise_bound=tiny)
    found = certify_rotation(src, dst, found.rotation, noise_bound=tiny, tolerance=1e-9)
    assert not found.is_optimal
    assert found.status in (CertificateStatus.UNDECIDABLE, CertificateStatus.SUBOPTIMAL)


def test_float32_input_gets_a_float64_proof_of_what_it_holds():
    src, dst, rotation = draw_vectors(9, 16, 0.25)
    src, dst, rotation = (x.astype(np.float32) for x in (src, dst, rotation))
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    assert found.cost.dtype == np.float64
    double = [x.astype(np.float64) for x in (src, dst)]
    best = found.rotation
    again = certify_rotation(*double, best, noise_bound=BOUND)
    assert again.is_optimal
    assert verify(*double, best, again, noise_bound=BOUND)


def test_more_than_it_can_look_at():
    src, dst, rotation = draw_vectors(0, 1001, 0.0)
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    assert found.status == CertificateStatus.TOO_LARGE
    assert not found.is_optimal
    assert_allclose(found.cost, rotation_cost(src, dst, rotation))
    assert found.lower_bound == 0


@pytest.mark.long
@pytest.mark.parametrize("unused", ["zero", "nan", "masked"])
@pytest.mark.parametrize("method", ["direct", "splitting", "reference"])
def test_unused_rows_may_stand_anywhere(unused, method):
    # Once padding was looked for at the end only, and the bound of a wrong candidate lay above the optimum.
    known = dict(noise_bound=BOUND, method=method, iterations=5)
    inside = jax.jit(lambda a, b, r, m: certify_rotation(a, b, r, mask=m, **known))
    for seed in range(4):
        src, dst, truth = draw_vectors([17, seed], 12, 0.3)
        candidate, mask = turned(truth, 120, seed), np.ones(12, bool)
        if unused == "masked":
            mask[:4] = False
            found = inside(src, dst, candidate, mask)
        else:
            src[:4] = 0.0 if unused == "zero" else np.nan
            found = certify_rotation(src, dst, candidate, **known)
        resting = rotation_cost(np.zeros((4, 3)), dst[:4], truth) if unused == "zero" else 0.0
        least = min(rotation_cost(src[4:], dst[4:], truth), best_rotation(src[4:], dst[4:])[1]) + resting
        assert float(found.lower_bound) <= least * (1 + 1e-6) + 1e-9
        last = certify_rotation(src[4:], dst[4:], candidate, **known)
        assert_allclose(float(found.lower_bound) - resting, last.lower_bound, atol=2e-2)


@pytest.mark.long
def test_numbers_of_all_kinds_under_jit():
    src, dst, rotation = draw_vectors(0, 12, 0.0)
    whole = np.round(src * 20).astype(np.int32)
    found = jax.jit(lambda a, b: certify_rotation(a, b, np.eye(3), noise_bound=[1.0] * 12))(whole, whole + 1)
    outside = certify_rotation(whole, whole + 1, np.eye(3), noise_bound=1.0)
    assert_allclose(found.suboptimality, outside.suboptimality, rtol=1e-5)
    assert_allclose(found.rotation, outside.rotation, atol=1e-6)
    # Truthy is used; what is claimed in float32 is rounded down.
    masked = with_odd_mask(src, dst, rotation, BOUND)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    assert masked.measurements == 12
    assert 0.99 * best.lower_bound <= masked.lower_bound <= best.cost
    for bad in (dict(mask=[True] * 11), dict(tolerance=-1.0), dict(tolerance=np.nan)):
        with pytest.raises(ValueError, match=f"{next(iter(bad))} "):
            jax.jit(lambda a, b, bad=bad: certify_rotation(a, b, rotation, noise_bound=BOUND, **bad))(
                src, dst
            )


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(tolerance=1.0), "between 0 and 1"),
        (dict(tolerance=[1e-3]), "between 0 and 1"),
        (dict(iterations=-5), "iterations is -5"),
        (dict(iterations=2.5), "iterations is 2.5"),
        (dict(iterations=10**12), "iterations"),
        (dict(max_measurements=None), "max_measurements"),
        (dict(noise_bound=np.inf), "finite"),
        (dict(src=np.ones((12, 3), complex)), "complex"),
        (dict(src=np.zeros((0, 12, 3)), dst=np.zeros((0, 12, 3))), "holds no problem"),
        (dict(src=np.ones((2, 12, 3)), dst=np.ones((2, 12, 3)), noise_bound=np.ones(12)), "stack of 2"),
    ],
)
def test_odd_parameters_are_refused(unchecked, change, words):
    src, dst, rotation = draw_vectors(0, 12, 0.0)
    known = dict(src=src, dst=dst, rotation=rotation, noise_bound=BOUND) | change
    with pytest.raises(ValueError, match=words):
        certify_rotation(**known)


@pytest.mark.parametrize(("size", "bound"), [(1e200, 1e-200), (1, 1e-156), (1, 1e-300)])
def test_lengths_beyond_float64_are_undecidable(size, bound):
    src, dst, rotation = draw_vectors(0, 6, 0.0)
    found = certify_rotation(size * src, size * dst, rotation, noise_bound=bound)
    assert found.status in (CertificateStatus.UNDECIDABLE, CertificateStatus.NO_MEASUREMENTS)
    assert (found.suboptimality, found.absolute_gap) == (1, 1)
    assert np.isfinite(found.rotation).all()
    assert not found.is_optimal
    assert found.lower_bound == 0


def test_what_no_rotation_changes_has_no_gap():
    dst = np.ones((4, 3))
    found = certify_rotation(np.zeros((4, 3)), dst, np.eye(3), noise_bound=BOUND)
    assert found.status == CertificateStatus.NO_MEASUREMENTS
    assert found.lower_bound == found.cost == 4
    assert found.method == CertifiedBy.NOTHING


def test_too_large_ones_say_what_they_cost():
    src, dst, rotation = draw_vectors(1, 12, 0.2)
    full = certify_rotation(src, dst, 2 * rotation, noise_bound=BOUND)
    found = certify_rotation(src, dst, 2 * rotation, noise_bound=BOUND, max_measurements=5)
    assert_allclose(found.cost, full.cost)
    assert_allclose(found.rotation, rotation, atol=1e-12)
    assert_allclose(found.absolute_gap, full.cost / 12)


def test_malformed_certificates_are_refuted_and_never_raise():
    src, dst, rotation = draw_vectors(2, 12, 0.2)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    good = certify_rotation(src, dst, best, noise_bound=BOUND)
    bad = certify_rotation(src, dst, turned(best, 20), noise_bound=BOUND)
    known = dict(noise_bound=BOUND)
    assert verify(src, dst, best, good, **known)
    assert verify(src, dst, turned(best, 20), bad, **known)
    skew, diagonal = good.dual
    for odd in (
        None,
        tampered(good, dual=None),
        tampered(good, lower_bound=None),
        tampered(good, dual=(skew[:3, :3], diagonal)),
        tampered(good, dual=(diagonal, skew)),
        tampered(good, dual=(skew, diagonal[:, :3, :3])),
        tampered(good, rotation=np.eye(2)),
        tampered(good, measurements=99),
        tampered(good, absolute_gap=0.0),
        tampered(good, suboptimality=np.inf),
        tampered(good, lower_bound=-5.0, suboptimality=9.0),
        tampered(good, status=2),
    ):
        assert not verify(src, dst, best, odd, **known)
    for claims in (dict(is_optimal=True, status=0), dict(is_optimal=True)):
        assert not verify(src, dst, turned(best, 20), tampered(bad, **claims), **known)
    assert not verify(src, dst, best, good, noise_bound=-BOUND)
    assert not verify(src, dst, np.full((3, 3), np.nan), good, **known)
    with pytest.raises(ValueError, match="do not fit"):
        verify(src, dst[:5], best, good, **known)


@pytest.mark.parametrize("name", ["cbar2", "tolerance", "noise_bound", "rotation"])
@pytest.mark.parametrize("value", ["x", 1j, [1, [2]], {}])
def test_what_is_no_number_is_refused_by_verify_and_not_called_unproved(name, value, unchecked):
    known = dict(rotation=np.eye(3), noise_bound=1.0, cbar2=1.0, tolerance=1e-3) | {name: value}
    with pytest.raises(ValueError, match="no real numbers"):
        verify(np.ones((4, 3)), np.ones((4, 3)), known.pop("rotation"), None, **known)


def test_bounds_far_below_the_vectors_are_verified_without_a_warning():
    assert not verify(np.ones((4, 3)), np.ones((4, 3)), np.eye(3), None, noise_bound=1e-300)
