"""The relaxation: the optimum and its proof from a conic solver, the oracle of the other methods."""

from __future__ import annotations

import sys

import jax
import numpy as np
import pytest
from oracles import BOUND, best_rotation, draw_vectors, rotation_cost

import teaser_jax as tj
from teaser_jax.certify.certificate import CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import Dual, dual_matrix
from teaser_jax.certify.relaxation import turned_dual
from teaser_jax.stages.rotation import relaxation
from teaser_jax.stages.rotation.quadratic_form import Measurements, cost_matrix
from teaser_jax.stages.rotation.relaxation import MAX_RELAXED, relax

pytest.importorskip("scs")


@pytest.mark.long
@pytest.mark.parametrize(("k", "wrong"), [(6, 0.0), (8, 0.25), (10, 0.5)])
def test_it_is_tight_and_agrees_with_the_other_methods(k, wrong):
    src, dst, _ = draw_vectors((k, 1), k, wrong)
    found = tj.solve_rotation(src, dst, noise_bound=BOUND, method="sdp")
    fast = tj.solve_rotation(src, dst, noise_bound=BOUND)
    _, least = best_rotation(src, dst)
    assert found.cost == pytest.approx(least, rel=1e-6)
    assert fast.cost == pytest.approx(least, rel=1e-6)
    assert found.relaxation.rank == 1
    assert found.relaxation.is_tight
    assert found.relaxation.value == pytest.approx(least, rel=1e-3)
    assert found.certificate.method == CertifiedBy.RELAXATION
    assert found.certificate.is_optimal
    assert tj.verify(src, dst, found.rotation, found.certificate, noise_bound=BOUND)


@pytest.mark.long
def test_it_finds_the_rotation_from_a_wrong_start(x64):
    # GNC fails here, so rank one of the relaxation is not the merit of its start.
    src, dst, truth = draw_vectors(5, 10, 0.5)
    m = Measurements(src / BOUND, dst / BOUND, np.asarray(1.0), np.ones(10, bool))
    from teaser_jax.stages.rotation.relaxation import solve_relaxation

    best = solve_relaxation(m)
    assert rotation_cost(src, dst, best.turn) == pytest.approx(best_rotation(src, dst)[1], rel=1e-6)


@pytest.mark.long
def test_its_value_is_a_lower_bound_where_it_is_not_tight():
    # All wrong: the optimum fits one or two by chance, and the relaxation may lie below it.
    src, dst, _ = draw_vectors(0, 8, 1.0)
    found = tj.solve_rotation(src, dst, noise_bound=BOUND, method="sdp")
    # Up to the accuracy of the solver, if it got there: older ones do not; the certificate's bound is exact.
    assert not found.relaxation.converged or found.relaxation.value <= found.cost + 1e-4
    assert found.certificate.lower_bound <= best_rotation(src, dst)[1] + 1e-9


def test_constraints_of_the_relaxation_hold(x64):
    src, dst, _ = draw_vectors(2, 5, 0.2)
    m = Measurements(src / BOUND, dst / BOUND, np.asarray(1.0), np.ones(5, bool))
    found = relax(np.asarray(jax.jit(cost_matrix)(m)))
    blocks = found.matrix.reshape(6, 4, 6, 4)
    assert np.trace(blocks[0, :, 0, :]) == pytest.approx(1, abs=1e-4)
    for i in range(6):
        np.testing.assert_allclose(blocks[i, :, i, :], blocks[0, :, 0, :], atol=1e-4)
        for j in range(6):
            np.testing.assert_allclose(blocks[i, :, j, :], blocks[i, :, j, :].T, atol=1e-4)
    # Weak duality, with the rounded value of the dual.
    assert np.linalg.eigvalsh(found.matrix)[0] > -1e-6


@pytest.mark.long
def test_a_dual_in_another_frame_proves_the_same(x64):
    src, dst, truth = draw_vectors(3, 6, 0.4)
    rng = np.random.default_rng(0)
    m = Measurements(src / BOUND, dst / BOUND, np.asarray(1.0), np.ones(6, bool))
    dual = Dual(rng.normal(size=(7, 7, 6)), rng.normal(size=(6, 4, 4)))
    there = jax.jit(turned_dual)(m, dual, truth)
    here = np.array(jax.jit(dual_matrix)(m, dual))
    here[:4, :4] += (float(m.cost) - float(m.turned(truth).cost)) * np.eye(4)  # mu is another one
    np.testing.assert_allclose(np.linalg.eigvalsh(there), np.linalg.eigvalsh(here), atol=1e-9)


@pytest.mark.long
def test_too_many_and_inside_jit_are_refused(small):
    many = np.ones((MAX_RELAXED + 1, 3))
    with pytest.raises(ValueError, match="takes up to"):
        tj.solve_rotation(many, many, noise_bound=BOUND, method="sdp")
    src, dst, _ = draw_vectors(0, 6, 0.0)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda a, b: tj.solve_rotation(a, b, noise_bound=BOUND, method="sdp"))(src, dst)
    problem = tj.make_problem(small.src, small.dst, noise_bound=small.noise_bound)
    with pytest.raises(ValueError, match="outside jit"):
        jax.jit(lambda p: tj.solve(p, tj.Settings(rotation="sdp", clique="greedy")))(problem)


@pytest.mark.slow
def test_in_the_cascade(solved, small):
    result = tj.register(
        small.src, small.dst, noise_bound=small.noise_bound, settings=tj.Settings(rotation="sdp")
    )
    assert result.ok
    np.testing.assert_allclose(result.pose.matrix, solved.pose.matrix, atol=1e-9)


def test_without_the_extra_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scs", None)
    src, dst, _ = draw_vectors(0, 6, 0.0)
    with pytest.raises(ImportError, match=r"pip install 'teaser-jax\[sdp\]'"):
        tj.solve_rotation(src, dst, noise_bound=BOUND, method="sdp")


def test_no_proof_asked_for():
    src, dst, _ = draw_vectors(0, 6, 0.0)
    found = tj.solve_rotation(src, dst, noise_bound=BOUND, method="sdp", proof=None)
    assert found.certificate is None
    assert found.relaxation.is_tight
    assert CertificateStatus.OPTIMAL.advice


@pytest.mark.long
@pytest.mark.parametrize("extent", [40, 400, 4000])
def test_a_value_above_a_known_cost_is_not_called_converged(extent, monkeypatch):
    """Errors as large as the bound, points that reach over many bounds, and two wrong ones.

    What is small beside the cost matrix is large beside the cost there. A solver that is told to stop early
    shows in a second what one of full accuracy met in minutes: a value that is no bound is called solved.
    """
    values = []

    def hasty(matrix):
        values.append(relax(matrix, accuracy=1e-2))
        return values[-1]

    monkeypatch.setattr(relaxation, "relax", hasty)
    rng = np.random.default_rng(extent)
    src = rng.uniform(-extent / 2, extent / 2, (6, 3))
    noise = rng.normal(size=(6, 3))
    dst = src @ tj.synthetic.draw_rotation(rng).T + noise / np.linalg.norm(noise, axis=1, keepdims=True)
    dst[:2] = rng.uniform(-extent / 2, extent / 2, (2, 3))
    found = tj.solve_rotation(src, dst, noise_bound=1.0, method="sdp", proof=None)
    assert values[0].converged
    if extent > 40:
        assert values[0].value > 1.01 * found.cost
    assert found.relaxation.converged == (values[0].value <= found.cost + 1e-3 * max(found.cost, 1))
    assert found.relaxation.is_tight <= found.relaxation.converged
