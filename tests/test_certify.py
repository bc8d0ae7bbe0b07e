"""Certificates: golden numbers, the bound that every dual gives, verdicts, and a check of each by itself."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import teaser_jax as tj
from teaser_jax import CertificateStatus, CertifiedBy, certify_rotation
from teaser_jax.certify.dual import Dual, coupled_guess, dual_matrix, dual_of, reference_guess
from teaser_jax.certify.host import padded_size
from teaser_jax.certify.projection import project_dual
from teaser_jax.certify.splitting import reference
from teaser_jax.certify.verify import verify
from teaser_jax.so3 import rotation_angle
from teaser_jax.stages.quadratic_form import Measurements, cost_matrix
from teaser_jax.synthetic import random_rotation

SIGMA, BOUND = 0.01, 0.0554
matrix_of, free_numbers_of, published = jax.jit(dual_matrix), jax.jit(dual_of), jax.jit(reference_guess)
coupled = jax.jit(coupled_guess, static_argnames="correct_outliers")


def draw(seed, k: int, wrong: float):
    """Vectors of a unit cube, wrong ones of the right length, and the rotation behind the others."""
    rng = np.random.default_rng(seed)
    src, rotation = rng.uniform(-0.5, 0.5, (k, 3)), random_rotation(rng)
    dst = src @ rotation.T + np.clip(SIGMA * rng.normal(size=(k, 3)), -0.03, 0.03)
    bad = rng.permutation(k)[: round(wrong * k)]
    odd = rng.normal(size=(len(bad), 3))
    dst[bad] = odd * (np.linalg.norm(src[bad], axis=1) / np.linalg.norm(odd, axis=1))[:, None]
    return src, dst, rotation


def turned(rotation, degrees: float, seed=0):
    """The rotation, turned about a random axis."""
    axis = np.random.default_rng(seed).normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross, angle = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]), np.deg2rad(degrees)
    return rotation @ (np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


def cost(src, dst, rotation, bound=BOUND):
    return np.minimum(np.sum(((dst - src @ rotation.T) / bound) ** 2, axis=1), 1).sum()


def measurements(seed, k, wrong):
    src, dst, rotation = draw(seed, k, wrong)
    return Measurements(
        jnp.asarray(src / BOUND), jnp.asarray(dst / BOUND @ rotation), jnp.asarray(1.0), jnp.ones(k, bool)
    )


@pytest.fixture(scope="module", params=["certification_small_1", "certification_small_2"])
def golden(request, data_dir):
    """Made by the MATLAB and C++ code of TEASER++'s authors, with the candidate and bound it holds."""
    return dict(np.load(data_dir / "teaser_fixtures" / f"{request.param}.npz"))


def of_golden(z) -> tuple[Measurements, float]:
    bound = float(z["param_noise_bound"])
    src, dst = z["v1"].T / bound, z["v2"].T / bound @ z["R_est"]
    return Measurements(jnp.asarray(src), jnp.asarray(dst), jnp.asarray(1.0), jnp.ones(len(src), bool)), bound


def test_golden_matrices(golden, x64):
    m, bound = of_golden(golden)
    k = len(m.src)
    assert_allclose(float(m.cost) * bound**2, golden["mu"].item(), rtol=1e-12)
    # Theirs keeps the signs and is in the user's frame.
    signs = np.repeat(np.append(1.0, golden["theta_est"][0]), 4)
    ours = np.array(cost_matrix(m)) * bound**2
    turn = golden["block_diag_omega"]
    theirs = turn.T @ golden["Q_cost"] @ turn * signs[:, None] * signs
    assert_allclose(ours, theirs, atol=1e-12)
    # The first dual matrix, and the projection of a matrix that their test holds.
    gauge = signs[:, None] * signs
    first = np.array(matrix_of(m, published(m))) * bound**2 * gauge
    corner = np.zeros_like(first)
    corner[:4, :4] = golden["mu"].item() * np.eye(4)
    theirs = turn.T @ golden["Q_cost"] @ turn - corner - golden["lambda_bar_init"]
    assert_allclose(first, theirs, atol=1e-9)
    moved = np.array(project_dual(jnp.asarray(golden["W_1st_iter"] * gauge), jnp.ones(k + 1))) * gauge
    assert_allclose(moved, golden["W_dual_1st_iter"], atol=1e-9)
    assert_allclose(first + moved, golden["M_affine_1st_iter"], atol=1e-9)


@pytest.mark.parametrize("name", ["certification_small_1", "certification_small_2", "certification_large_1"])
def test_golden_trajectories(name, data_dir, x64):
    z = np.load(data_dir / "teaser_fixtures" / f"{name}.npz")
    expected = z["suboptimality_traj"][0]
    m, _ = of_golden(z)
    found = jax.jit(lambda m: reference(m, tolerance=1e-6, iterations=len(expected)))(m)
    assert int(found.rounds) == len(expected)
    assert_allclose(found.suboptimality, np.maximum(expected, 0), atol=1e-9)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_every_dual_bounds_the_cost_of_every_rotation(seed, wrong, x64):
    # Not only good ones: any numbers in a Dual give a bound.
    k = 8
    src, dst, rotation = draw(seed, k, wrong)
    m = measurements(seed, k, wrong)
    rng = np.random.default_rng(seed)
    random = Dual(jnp.asarray(rng.normal(size=(k + 1, k + 1, 6))), jnp.asarray(rng.normal(size=(k, 4, 4))))
    rotations = [turned(rotation, angle, s) for s, angle in enumerate(np.linspace(0, 180, 200))]
    least = min(cost(src, dst, r) for r in rotations)
    for dual in (random, published(m), coupled(m, correct_outliers=True)):
        matrix = np.asarray(matrix_of(m, dual))
        assert_allclose(matrix, matrix.T, atol=1e-12)
        assert float(m.cost) + (k + 1) * min(0, np.linalg.eigvalsh(matrix)[0]) <= least + 1e-9


def test_projection_is_one(x64):
    rng = np.random.default_rng(0)
    n = 6
    w, v = (x + x.T for x in rng.normal(size=(2, 4 * n, 4 * n)))
    exists = jnp.ones(n)
    project = lambda x: np.asarray(project_dual(jnp.asarray(x), exists))
    p = project(w)
    assert_allclose(project(p), p, atol=1e-12)  # idempotent
    assert_allclose(np.sum(p * v), np.sum(w * project(v)), atol=1e-10)  # self-adjoint
    assert_allclose(p @ np.tile([0, 0, 0, 1], n), 0, atol=1e-12)  # annihilates the candidate
    blocks = p.reshape(n, 4, n, 4)
    assert_allclose(sum(blocks[i, :, i, :] for i in range(n)), 0, atol=1e-12)
    for i in range(n):
        for j in range(n):
            if i != j:
                assert_allclose(blocks[i, :, j, :], -blocks[i, :, j, :].T, atol=1e-12)


def test_a_dual_comes_back_from_its_matrix(x64):
    m = measurements(1, 10, 0.3)
    matrix = matrix_of(m, coupled(m, correct_outliers=False))
    assert_allclose(matrix_of(m, free_numbers_of(m, matrix)), matrix, atol=1e-10)


@pytest.mark.parametrize("k", [5, 20, 40])
@pytest.mark.parametrize("wrong", [0.0, 0.2, 0.4, 0.6])
def test_right_rotations_are_certified_and_the_proof_holds(k, wrong):
    for seed in range(3):
        src, dst, rotation = draw((k, seed), k, wrong)
        if k == 5 and wrong > 0.2:
            continue  # two or three right ones prove nothing
        found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
        best = found.rotation
        found = certify_rotation(src, dst, best, noise_bound=BOUND)
        assert found.is_optimal, found
        assert found.status == CertificateStatus.OPTIMAL
        assert found.suboptimality <= 1e-3 + 1e-12
        assert_allclose(found.cost, cost(src, dst, best), rtol=1e-9)
        assert verify(src, dst, best, found, noise_bound=BOUND)
        if wrong == 0:
            assert found.method == CertifiedBy.DIRECT
            assert found.iterations == 0


@pytest.mark.parametrize("degrees", [1, 5, 30, 90, 180])
@pytest.mark.parametrize("wrong", [0.0, 0.3, 0.6])
def test_moved_rotations_are_never_optimal(degrees, wrong):
    for seed in range(10):
        src, dst, rotation = draw(seed, 12, wrong)
        best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
        moved = turned(best, degrees, seed)
        found = certify_rotation(src, dst, moved, noise_bound=BOUND, method="direct")
        known = min(cost(src, dst, best), cost(src, dst, found.rotation))
        allowed = max(1e-3 * cost(src, dst, moved), 1e-6)
        if cost(src, dst, moved) - known > allowed:
            assert not found.is_optimal
        assert found.lower_bound <= known + 1e-9
        assert (
            verify(src, dst, moved, found, noise_bound=BOUND)
            or found.lower_bound == 0
            or (not found.is_optimal)
        )


def test_tampered_proofs_are_refuted():
    src, dst, rotation = draw(0, 20, 0.2)
    rotation = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    known = dict(noise_bound=BOUND)
    assert verify(src, dst, rotation, found, **known)
    rng = np.random.default_rng(0)
    noisy = Dual(found.dual.skew + rng.normal(size=found.dual.skew.shape), found.dual.diagonal)
    for wrong in (
        replace(found, dual=noisy),
        replace(found, dual=Dual(np.nan * found.dual.skew, found.dual.diagonal)),
        replace(found, lower_bound=found.cost * 1.01),
        replace(found, suboptimality=0.0),
        replace(found, cost=found.cost / 2),
        replace(found, rotation=-found.rotation),
        replace(found, rotation=1.1 * found.rotation),
    ):
        assert not verify(src, dst, rotation, wrong, **known)
    assert not verify(src, dst, turned(rotation, 20), found, **known)
    assert not verify(src, dst + 0.02, rotation, found, **known)


def test_all_wrong_may_be_optimal_but_no_false_claim():
    for seed in range(10):
        src, dst, _ = draw(seed, 10, 1.0)
        found = certify_rotation(src, dst, np.eye(3), noise_bound=BOUND, iterations=20)
        assert found.status in (
            CertificateStatus.UNKNOWN,
            CertificateStatus.SUBOPTIMAL,
            CertificateStatus.OPTIMAL,
        )
        if found.is_optimal:
            assert verify(src, dst, np.eye(3), found, noise_bound=BOUND)


def test_a_rotation_that_can_be_polished_is_suboptimal_and_the_better_one_is_given():
    src, dst, rotation = draw(3, 20, 0.2)
    found = certify_rotation(src, dst, turned(rotation, 3), noise_bound=BOUND)
    assert found.status == CertificateStatus.SUBOPTIMAL
    assert not found.is_optimal
    assert cost(src, dst, found.rotation) < found.cost
    assert_allclose(
        np.degrees(found.angle), np.degrees(rotation_angle(turned(rotation, 3).T @ found.rotation))
    )


def test_the_angle_bound_holds_every_rotation_as_good():
    src, dst, rotation = draw(1, 40, 0.0)
    given = turned(certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation, 0.02)
    found = certify_rotation(src, dst, given, noise_bound=BOUND)
    assert found.is_unique
    assert 0 < found.angle_bound < np.deg2rad(5)
    for seed in range(200):
        other = turned(given, np.degrees(found.angle_bound) * 1.01 + seed, seed)
        assert cost(src, dst, other) > found.cost


@pytest.mark.parametrize("scale", [1.0, -1.0])
def test_what_is_no_rotation_is_projected_first(scale):
    src, dst, rotation = draw(2, 12, 0.0)
    rotation = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    found = certify_rotation(src, dst, scale * 3 * rotation, noise_bound=BOUND)
    assert_allclose(np.linalg.det(found.rotation), 1)
    assert bool(found.is_optimal) == (scale > 0)


def test_awkward_measurements():
    src, dst, rotation = draw(4, 12, 0.0)
    best = certify_rotation(src, dst, rotation, noise_bound=BOUND).rotation
    zero = src.copy(), dst.copy()
    zero[0][3], zero[1][5] = 0, 0
    found = certify_rotation(*zero, best, noise_bound=BOUND)
    assert_allclose(found.cost, cost(*zero, best))
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
    assert_allclose(certify_rotation(src, odd, best, noise_bound=BOUND).cost, cost(src[1:], dst[1:], best))


def test_bounds_far_below_the_lengths_cannot_be_decided():
    src, dst, rotation = draw(0, 12, 0.0)
    tiny = 1e-9
    dst = src @ rotation.T + tiny * np.random.default_rng(0).uniform(-0.4, 0.4, src.shape)
    found = certify_rotation(src, dst, rotation, noise_bound=tiny)
    assert not found.is_optimal or verify(src, dst, rotation, found, noise_bound=tiny)


def test_units_do_not_matter():
    src, dst, rotation = draw(7, 16, 0.25)
    ones = certify_rotation(src, dst, rotation, noise_bound=BOUND)
    thousands = certify_rotation(1e3 * src, 1e3 * dst, rotation, noise_bound=1e3 * BOUND)
    assert_allclose(thousands.cost, ones.cost)
    assert thousands.is_optimal == ones.is_optimal


def test_padding_and_masks_change_nothing():
    assert all(padded_size(k) >= max(k, 16) for k in range(1000))
    assert all(padded_size(k) <= max(16, k + 8, 1.26 * k) for k in range(1000))
    src, dst, rotation = draw(5, 21, 0.2)
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


def test_under_jit_and_vmap_it_says_the_same():
    src, dst, rotation = draw(6, 16, 0.2)
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
        (dict(tolerance=0.0), "above 0"),
        (dict(mask=np.ones(3, bool)), "mask"),
    ],
)
def test_bad_input_is_refused(change, words):
    src, dst, rotation = draw(0, 12, 0.0)
    known = dict(src=src, dst=dst, rotation=rotation, noise_bound=BOUND) | change
    with pytest.raises(ValueError, match=words):
        certify_rotation(**known)


@pytest.mark.parametrize("about", ["pose", "chain", "complete"])
def test_answers_of_the_cascade_are_certified(about):
    for seed in range(3):
        drawn = tj.synthetic.random_problem(seed, n=40, outlier_rate=0.7)
        graph = "complete" if about == "complete" else "chain"
        settings = tj.Settings(tim_graph=graph)
        result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, settings=settings)
        problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        found = tj.certify(problem, result.solution, about=about, iterations=60)
        assert found.is_optimal, (seed, found)
        assert found.inlier_gap >= 0
        assert 0 <= found.explained_gap < 0.2


def test_nothing_explained_is_said():
    drawn = tj.synthetic.random_problem(0, n=200, outlier_rate=0.95)
    result = tj.register(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    none = np.zeros(200, bool)
    nothing = replace(result.solution, inliers=none, cost=np.float64(200.0))
    assert tj.certify(problem, nothing).explained_gap > 0.9


def test_certify_under_jit_and_too_large():
    drawn = tj.synthetic.random_problem(0, n=40, outlier_rate=0.25)
    with jax.enable_x64(True):
        problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
        solution = jax.jit(tj.solve)(problem)
        inside = jax.jit(lambda p, s: tj.certify(p, s))(problem, solution)
        outside = tj.certify(problem, solution)
        assert_allclose(inside.cost, outside.cost)
        assert bool(inside.is_optimal)
        small = jax.jit(lambda p, s: tj.certify(p, s, max_measurements=8))(problem, solution)
        assert int(small.status) == CertificateStatus.TOO_LARGE
        assert not bool(small.is_optimal)
    with pytest.raises(ValueError, match="about"):
        tj.certify(problem, solution, about="everything")
