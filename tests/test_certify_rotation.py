"""Certificates of rotations: verdicts, jit and stacks, and a check of each by itself."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import BOUND, draw_vectors, rotation_cost, tampered, turned

from teaser_jax import certify_rotation
from teaser_jax.certify.certificate import CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import Dual
from teaser_jax.certify.verify import verify
from teaser_jax.so3 import rotation_angle


@pytest.mark.long
@pytest.mark.parametrize("k", [5, 20, 40])
@pytest.mark.parametrize("wrong", [0.0, 0.2, 0.4, 0.6])
def test_right_rotations_are_certified_and_the_proof_holds(k, wrong):
    for seed in range(3):
        src, dst, rotation = draw_vectors((k, seed), k, wrong)
        if k == 5 and wrong > 0.2:
            continue  # two or three right ones prove nothing
        found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
        best = found.rotation
        found = certify_rotation(src, dst, best, noise_bound=BOUND)
        assert found.is_optimal, found
        assert found.status == CertificateStatus.OPTIMAL
        assert found.suboptimality <= 1e-3 + 1e-12
        assert_allclose(found.cost, rotation_cost(src, dst, best), rtol=1e-9)
        assert verify(src, dst, best, found, noise_bound=BOUND)
        if wrong == 0:
            assert found.method == CertifiedBy.DIRECT
            assert found.iterations == 0


@pytest.mark.long
@pytest.mark.parametrize("degrees", [1, 5, 30, 90, 180])
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_moved_rotations_are_never_optimal(degrees, wrong):
    for seed in range(10):
        src, dst, rotation = draw_vectors(seed, 12, wrong)
        best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
        moved = turned(best, degrees, seed)
        found = certify_rotation(src, dst, moved, noise_bound=BOUND, method="direct")
        known = min(rotation_cost(src, dst, best), rotation_cost(src, dst, found.rotation))
        allowed = max(1e-3 * rotation_cost(src, dst, moved), 1e-6)
        if rotation_cost(src, dst, moved) - known > allowed:
            assert not found.is_optimal
        assert found.lower_bound <= known + 1e-9
        assert (
            verify(src, dst, moved, found, noise_bound=BOUND)
            or found.lower_bound == 0
            or (not found.is_optimal)
        )


def test_tampered_proofs_are_refuted():
    src, dst, rotation = draw_vectors(0, 20, 0.2)
    rotation = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    known = dict(noise_bound=BOUND)
    assert verify(src, dst, rotation, found, **known)
    rng = np.random.default_rng(0)
    noisy = Dual(found.dual.skew + rng.normal(size=found.dual.skew.shape), found.dual.diagonal)
    for wrong in (
        tampered(found, dual=noisy),
        tampered(found, dual=Dual(np.nan * found.dual.skew, found.dual.diagonal)),
        tampered(found, lower_bound=found.cost * 1.01),
        tampered(found, suboptimality=0.0),
        tampered(found, cost=found.cost / 2),
        tampered(found, rotation=-found.rotation),
        tampered(found, rotation=1.1 * found.rotation),
    ):
        assert not verify(src, dst, rotation, wrong, **known)
    assert not verify(src, dst, turned(rotation, 20), found, **known)
    assert not verify(src, dst + 0.02, rotation, found, **known)


def test_all_wrong_may_be_optimal_but_no_false_claim():
    for seed in range(10):
        src, dst, _ = draw_vectors(seed, 10, 1.0)
        found = certify_rotation(src, dst, np.eye(3), noise_bound=BOUND, iterations=20)
        assert found.status in (
            CertificateStatus.UNKNOWN,
            CertificateStatus.SUBOPTIMAL,
            CertificateStatus.OPTIMAL,
        )
        if found.is_optimal:
            assert verify(src, dst, np.eye(3), found, noise_bound=BOUND)


def test_a_rotation_that_can_be_polished_is_suboptimal_and_the_better_one_is_given():
    src, dst, rotation = draw_vectors(3, 20, 0.2)
    found = certify_rotation(src, dst, turned(rotation, 3), noise_bound=BOUND)
    assert found.status == CertificateStatus.SUBOPTIMAL
    assert not found.is_optimal
    assert rotation_cost(src, dst, found.rotation) < found.cost
    assert_allclose(
        np.degrees(found.angle), np.degrees(rotation_angle(turned(rotation, 3).T @ found.rotation))
    )


def test_the_angle_bound_holds_every_rotation_as_good():
    src, dst, rotation = draw_vectors(1, 40, 0.0)
    given = turned(certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation, 0.02)
    found = certify_rotation(src, dst, given, noise_bound=BOUND)
    assert found.is_unique
    assert 0 < found.angle_bound < np.deg2rad(5)
    for seed in range(200):
        other = turned(given, np.degrees(found.angle_bound) * 1.01 + seed, seed)
        assert rotation_cost(src, dst, other) > found.cost


@pytest.mark.parametrize("scale", [1.0, -1.0])
def test_what_is_no_rotation_is_projected_first(scale):
    src, dst, rotation = draw_vectors(2, 12, 0.0)
    rotation = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, scale * 3 * rotation, noise_bound=BOUND)
    assert_allclose(np.linalg.det(found.rotation), 1)
    assert bool(found.is_optimal) == (scale > 0)


def test_awkward_measurements():
    src, dst, rotation = draw_vectors(4, 12, 0.0)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    zero = src.copy(), dst.copy()
    zero[0][3], zero[1][5] = 0, 0
    found = certify_rotation(*zero, best, noise_bound=BOUND)
    assert_allclose(found.cost, rotation_cost(*zero, best))
    assert verify(*zero, best, found, noise_bound=BOUND)
    exact = certify_rotation(src, src @ rotation.T, rotation, noise_bound=BOUND)
    assert (exact.is_optimal, exact.method) == (True, CertifiedBy.ZERO_COST)
    line = np.linspace(-1, 1, 10)[:, None] * [1.0, 2.0, 3.0]
    along = certify_rotation(line, line @ rotation.T + 0.001, rotation, noise_bound=BOUND)
    assert not along.is_unique
    hidden = certify_rotation(src, dst, best, noise_bound=BOUND, mask=np.zeros(12, bool))
    assert (hidden.status, bool(hidden.is_optimal)) == (CertificateStatus.NO_MEASUREMENTS, False)
    odd = dst.copy()
    odd[0] = np.nan
    assert_allclose(
        certify_rotation(src, odd, best, noise_bound=BOUND).cost, rotation_cost(src[1:], dst[1:], best)
    )


def test_bounds_far_below_the_lengths_cannot_be_decided():
    src, dst, rotation = draw_vectors(0, 12, 0.0)
    tiny = 1e-9
    dst = src @ rotation.T + tiny * np.random.default_rng(0).uniform(-0.4, 0.4, src.shape)
    found = certify_rotation(src, dst, rotation, noise_bound=tiny)
    assert not found.is_optimal or verify(src, dst, rotation, found, noise_bound=tiny)


def test_units_do_not_matter():
    src, dst, rotation = draw_vectors(7, 16, 0.25)
    ones = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    thousands = certify_rotation(1e3 * src, 1e3 * dst, rotation, noise_bound=1e3 * BOUND)
    assert_allclose(thousands.cost, ones.cost)
    assert thousands.is_optimal == ones.is_optimal


@pytest.mark.long
def test_padding_and_masks_change_nothing():
    src, dst, rotation = draw_vectors(5, 21, 0.2)
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    order = np.random.default_rng(0).permutation(30)
    wide = np.ones((30, 3)), np.full((30, 3), np.nan)
    where = np.sort(order[:21])
    wide[0][where], wide[1][where] = src, dst
    mask = np.isin(np.arange(30), where)
    masked = certify_rotation(*wide, rotation, noise_bound=BOUND, mask=mask)
    assert_allclose(masked.cost, found.cost)
    assert masked.is_optimal == found.is_optimal
    assert_allclose(masked.dual.skew[:22, :22], found.dual.skew[:22, :22], atol=1e-9)


@pytest.mark.long
def test_under_jit_and_vmap_it_says_the_same():
    src, dst, rotation = draw_vectors(6, 16, 0.2)
    rotation = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    outside = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    with jax.enable_x64(True):
        inside = jax.jit(lambda *x: certify_rotation(*x, noise_bound=BOUND))(src, dst, rotation)
        assert_allclose(inside.cost, outside.cost)
        assert bool(inside.is_optimal) == bool(outside.is_optimal)
        moved = jnp.stack([rotation, turned(rotation, 10)])
        several = jax.jit(
            jax.vmap(lambda r: certify_rotation(src, dst, r, noise_bound=BOUND, method="direct"))
        )(moved)
    assert several.status[1] == CertificateStatus.SUBOPTIMAL
    # In float32 JAX the proof is made in float64 all the same.
    narrow = jax.jit(lambda *x: certify_rotation(*x, noise_bound=BOUND))(
        *(jnp.asarray(x, jnp.float32) for x in (src, dst, rotation))
    )
    assert narrow.cost.dtype == jnp.float32
    assert bool(narrow.is_optimal)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(method="magic"), "method"),
        (dict(src=np.ones((3, 12))), "shapes"),
        (dict(rotation=np.eye(4)), "shapes"),
        (dict(rotation=np.full((3, 3), np.nan)), "not finite"),
        (dict(noise_bound=0.0), "above 0"),
        (dict(tolerance=0.0), "between 0 and 1"),
        (dict(mask=np.ones(3, bool)), "mask"),
    ],
)
def test_bad_input_is_refused(unchecked, change, words):
    src, dst, rotation = draw_vectors(0, 12, 0.0)
    known = dict(src=src, dst=dst, rotation=rotation, noise_bound=BOUND) | change
    with pytest.raises(ValueError, match=words):
        certify_rotation(**known)


@pytest.mark.long
def test_a_stack_says_what_its_items_say():
    drawn = [draw_vectors(seed, k, 0.3) for seed, k in enumerate((12, 12, 20, 20))]
    src, dst = np.zeros((4, 20, 3)), np.zeros((4, 20, 3))
    mask = np.zeros((4, 20), bool)
    rotations = []
    for i, (a, b, rotation) in enumerate(drawn):
        src[i, : len(a)], dst[i, : len(a)], mask[i, : len(a)] = a, b, True
        rotations.append(certify_rotation(a, b, rotation, noise_bound=BOUND).rotation)
    rotations[3] = turned(rotations[3], 20)
    stack = certify_rotation(src, dst, np.stack(rotations), noise_bound=BOUND, mask=mask)
    for i, (a, b, _) in enumerate(drawn):
        alone = certify_rotation(a, b, rotations[i], noise_bound=BOUND)
        assert stack.status[i] == alone.status
        assert stack.iterations[i] == alone.iterations
        assert stack.measurements[i] == len(a)
        assert_allclose(stack.lower_bound[i], alone.lower_bound, rtol=1e-6)
        n = len(a) + 1
        assert_allclose(stack.dual.skew[i, :n, :n], alone.dual.skew, atol=1e-7)
        assert not np.any(stack.dual.skew[i, n:])
    assert set(stack.status) == {CertificateStatus.OPTIMAL, CertificateStatus.SUBOPTIMAL}
    with pytest.raises(ValueError, match="use jax.vmap"):
        jax.jit(lambda a: certify_rotation(a, dst, np.eye(3), noise_bound=BOUND))(src)


@pytest.mark.long
def test_the_work_of_many_measurements_is_bounded():
    # Where iterations cannot be afforded the direct test still is.
    src, dst, rotation = draw_vectors(0, 250, 0.0)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND, method="direct").rotation
    found = certify_rotation(src, dst, best, noise_bound=BOUND)
    assert found.is_optimal
    assert found.iterations == 0


@pytest.mark.long
def test_concrete_numbers_inside_somebody_elses_jit():
    src, dst, rotation = draw_vectors(0, 12, 0.0)
    outside = certify_rotation(src, dst, rotation, noise_bound=BOUND)

    @jax.jit
    def inside(x):
        return x + certify_rotation(src, dst, rotation, noise_bound=BOUND).cost

    assert_allclose(inside(1.0), 1 + outside.cost, rtol=1e-6)


@pytest.mark.long
def test_the_reference_method_proves_the_same():
    src, dst, rotation = draw_vectors(1, 10, 0.2)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, best, noise_bound=BOUND, method="reference")
    assert (found.is_optimal, found.method) == (True, CertifiedBy.REFERENCE)
    assert 0 < found.iterations < 50
    assert verify(src, dst, best, found, noise_bound=BOUND)
