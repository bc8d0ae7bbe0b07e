"""Whether a symmetric matrix is positive semidefinite: eigenvalues, and a test that accounts for rounding."""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.stages.rotation.quadratic_form import Measurements


def project_semidefinite(w: Float[Array, "m m"]) -> Float[Array, "m m"]:
    """Project a symmetric matrix on the positive semidefinite ones: negative eigenvalues become zero."""
    values, vectors = jnp.linalg.eigh(w)
    return jnp.matmul(vectors * jnp.maximum(values, 0)[None], vectors.T, precision=lax.Precision.HIGHEST)


def smallest_eigenvalue(w: Float[Array, "n4 n4"], exists: Float[Array, " n"]) -> Float[Array, ""]:
    """Find the smallest eigenvalue over the blocks that exist; padding is no direction, wherever it stands.

    Args:
        w: Symmetric, in blocks of four.
        exists: 1 for blocks that exist, 0 for padding.
    """
    padding = jnp.repeat(exists == 0, 4, total_repeat_length=w.shape[0])
    filled = w + jnp.diag(jnp.where(padding, jnp.max(jnp.abs(w)) + 1, 0))
    return jnp.linalg.eigvalsh(0.5 * (filled + filled.T))[0]


def factorisation_error(m: Measurements, matrix: Float[Array, "n4 n4"]) -> Float[Array, ""]:
    """Bound how far below zero eigenvalues may lie although a Cholesky factorisation came to its end.

    The bound is the backward error of the factorisation, (N + 2) eps trace, and that of making the matrix.
    """
    eps = jnp.finfo(matrix.dtype).eps
    terms = jnp.sum(m.src**2) + jnp.sum(m.dst**2) + jnp.sum(m.mask, dtype=m.cbar2.dtype) * m.cbar2
    return eps * ((matrix.shape[0] + 2) * jnp.sum(jnp.abs(jnp.diagonal(matrix))) + 32 * terms)


def reaches(m: Measurements, matrix: Float[Array, "n4 n4"], shift: Float[Array, ""]) -> Bool[Array, ""]:
    """Prove that no eigenvalue lies below -shift, by one Cholesky factorisation, or return False.

    Rounding is accounted for: a shift that it could swallow proves nothing.
    """
    error = factorisation_error(m, matrix)
    shifted = 0.5 * (matrix + matrix.T) + (shift - error) * jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return (shift > 2 * error) & jnp.all(jnp.isfinite(jnp.linalg.cholesky(shifted)))
