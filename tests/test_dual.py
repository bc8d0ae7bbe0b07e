"""Dual matrices: golden numbers, the bound that every one gives, and the projection onto the family."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from numpy.testing import assert_allclose
from oracles import BOUND, draw_vectors, rotation_cost, turned

from teaser_jax.certify.dual import Dual, coupled_guess, dual_matrix, dual_of, reference_guess
from teaser_jax.certify.projection import project_dual
from teaser_jax.certify.splitting import reference
from teaser_jax.stages.rotation.quadratic_form import Measurements, cost_matrix

matrix_of, free_numbers_of, published = jax.jit(dual_matrix), jax.jit(dual_of), jax.jit(reference_guess)
coupled = jax.jit(coupled_guess, static_argnames="correct_outliers")
project, quadratic = jax.jit(project_dual), jax.jit(cost_matrix)


def measurements(seed, k, wrong):
    src, dst, rotation = draw_vectors(seed, k, wrong)
    return Measurements(src / BOUND, dst / BOUND @ rotation, np.asarray(1.0), np.ones(k, bool))


@pytest.fixture(scope="module", params=["certification_small_1", "certification_small_2"])
def golden(request, data_dir):
    """Made by the MATLAB and C++ code of TEASER++'s authors, with the candidate and bound it holds."""
    return dict(np.load(data_dir / "teaser_fixtures" / f"{request.param}.npz"))


def of_golden(z) -> tuple[Measurements, float]:
    bound = float(z["param_noise_bound"])
    src, dst = z["v1"].T / bound, z["v2"].T / bound @ z["R_est"]
    return Measurements(src, dst, np.asarray(1.0), np.ones(len(src), bool)), bound


@pytest.mark.long
def test_golden_matrices(golden, x64):
    m, bound = of_golden(golden)
    k = len(m.src)
    assert_allclose(float(m.cost) * bound**2, golden["mu"].item(), rtol=1e-12)
    # Theirs keeps the signs and is in the user's frame.
    signs = np.repeat(np.append(1.0, golden["theta_est"][0]), 4)
    ours = np.array(quadratic(m)) * bound**2
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
    moved = np.array(project(golden["W_1st_iter"] * gauge, np.ones(k + 1))) * gauge
    assert_allclose(moved, golden["W_dual_1st_iter"], atol=1e-9)
    assert_allclose(first + moved, golden["M_affine_1st_iter"], atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", ["certification_small_1", "certification_small_2", "certification_large_1"])
def test_golden_trajectories(name, data_dir, x64):
    z = np.load(data_dir / "teaser_fixtures" / f"{name}.npz")
    expected = z["suboptimality_traj"][0]
    m, _ = of_golden(z)
    found = jax.jit(lambda m: reference(m, tolerance=1e-6, iterations=len(expected)))(m)
    assert int(found.rounds) == len(expected)
    assert_allclose(found.suboptimality, np.maximum(expected, 0), atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("wrong", [0.0, 0.4])
def test_every_dual_bounds_the_cost_of_every_rotation(seed, wrong, x64):
    # Not only good ones: any numbers in a Dual give a bound.
    k = 8
    src, dst, rotation = draw_vectors(seed, k, wrong)
    m = measurements(seed, k, wrong)
    rng = np.random.default_rng(seed)
    random = Dual(rng.normal(size=(k + 1, k + 1, 6)), rng.normal(size=(k, 4, 4)))
    rotations = [turned(rotation, angle, s) for s, angle in enumerate(np.linspace(0, 180, 200))]
    least = min(rotation_cost(src, dst, r) for r in rotations)
    for dual in (random, published(m), coupled(m, correct_outliers=True)):
        matrix = np.asarray(matrix_of(m, dual))
        assert_allclose(matrix, matrix.T, atol=1e-12)
        assert float(m.cost) + (k + 1) * min(0, np.linalg.eigvalsh(matrix)[0]) <= least + 1e-9


def test_projection_is_one(x64):
    rng = np.random.default_rng(0)
    n = 6
    w, v = (x + x.T for x in rng.normal(size=(2, 4 * n, 4 * n)))
    projected = lambda x: np.asarray(project(x, np.ones(n)))
    p = projected(w)
    assert_allclose(projected(p), p, atol=1e-12)  # idempotent
    assert_allclose(np.sum(p * v), np.sum(w * projected(v)), atol=1e-10)  # self-adjoint
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
