"""Eigenvalues: the projection on the cone, the smallest one beside padding, what a factorisation proves."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from teaser_jax.certify.semidefinite import (
    factorisation_error,
    project_semidefinite,
    reaches,
    smallest_eigenvalue,
)
from teaser_jax.stages.rotation.quadratic_form import Measurements


@pytest.fixture
def matrix() -> np.ndarray:
    """Symmetric, three blocks of four, with eigenvalues -1 and 1 to 11."""
    basis, _ = np.linalg.qr(np.random.default_rng(0).normal(size=(12, 12)))
    return basis @ np.diag([-1.0, *range(1, 12)]) @ basis.T


def nothing_measured() -> Measurements:
    zero = jnp.zeros((2, 3))
    return Measurements(zero, zero, jnp.asarray(1.0), jnp.zeros(2, bool))


def test_the_projection_keeps_what_is_positive(matrix, x64):
    projected = np.asarray(project_semidefinite(jnp.asarray(matrix)))
    assert_allclose(np.linalg.eigvalsh(projected), [0, *range(1, 12)], atol=1e-12)
    assert_allclose(project_semidefinite(jnp.asarray(projected)), projected, atol=1e-12)
    assert_allclose(np.linalg.norm(projected - matrix), 1)  # no semidefinite matrix is nearer


@pytest.mark.long
@pytest.mark.parametrize("place", [0, 1, 3])
def test_padding_is_no_direction_wherever_it_stands(place, matrix, x64):
    index = np.delete(np.arange(16), np.arange(4 * place, 4 * place + 4))
    wide = np.zeros((16, 16))
    wide[np.ix_(index, index)] = matrix + 5 * np.eye(12)  # padding has zeros, which would be the smallest
    exists = jnp.asarray(np.arange(4) != place, float)
    assert_allclose(smallest_eigenvalue(jnp.asarray(wide), exists), 4)


def test_one_factorisation_proves_what_eigenvalues_say(matrix, x64):
    m, w = nothing_measured(), jnp.asarray(matrix)
    assert bool(reaches(m, w, jnp.asarray(1 + 1e-9)))
    assert not bool(reaches(m, w, jnp.asarray(1 - 1e-9)))


def test_a_shift_that_rounding_could_swallow_proves_nothing(x64):
    m, w = nothing_measured(), jnp.eye(12)
    error = factorisation_error(m, w)
    assert 0 < error < 1e-12
    assert bool(reaches(m, w, 3 * error))
    assert not bool(reaches(m, w, error))
