"""Douglas-Rachford splitting: a dual matrix that is both of the family and semidefinite (Algorithm 3).

Alternates between the semidefinite cone and the affine set of dual matrices that annihilate the candidate.
Two changes make it a multiple faster than as published: coordinates in which vector parts are half as
large, and a margin inside the cone, so that the affine iterate becomes semidefinite sooner.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.certify.dual import dual_matrix, reference_guess
from teaser_jax.certify.projection import project_dual, project_semidefinite, smallest_eigenvalue
from teaser_jax.stages.rotation.quadratic_form import Measurements

RELAXATION = 1.999999  # any number below 2 converges, and the largest is the fastest in practice
VECTOR_SCALE = 0.5
# How deep inside the cone to aim, in units of the truncation, up to which round. Wide is right for the easy.
# Of problems with 40 measurements, 90 % wrong, it proves 25 in 30; 0.05 to round 40 and then none: 8.
MARGINS, UNTIL = (0.03, 0.02, 0.01), (20, 60)


class Split(NamedTuple):
    """The last affine iterate, whether it is semidefinite enough, and the rounds it took."""

    matrix: Float[Array, "n4 n4"]
    proved: Bool[Array, ""]
    rounds: Int[Array, ""]


def existing(m: Measurements) -> Float[Array, " n"]:
    """1 for the blocks of the quaternion and of measurements that exist."""
    return jnp.concatenate([jnp.ones(1, m.src.dtype), m.mask.astype(m.src.dtype)])


def rounding(m: Measurements, matrix: Float[Array, "n4 n4"]) -> Float[Array, ""]:
    """How far below zero eigenvalues may be although a Cholesky factorisation came to its end.

    The backward error of the factorisation, (N + 2) eps trace, and that of making the matrix.
    """
    eps = jnp.finfo(matrix.dtype).eps
    terms = jnp.sum(m.src**2) + jnp.sum(m.dst**2) + jnp.sum(m.mask) * m.cbar2
    return eps * ((matrix.shape[0] + 2) * jnp.sum(jnp.abs(jnp.diagonal(matrix))) + 32 * terms)


def reaches(m: Measurements, matrix: Float[Array, "n4 n4"], shift: Float[Array, ""]) -> Bool[Array, ""]:
    """Whether it is proved that no eigenvalue is below -shift: one Cholesky, rounding accounted for.

    A shift that rounding could swallow proves nothing.
    """
    error = rounding(m, matrix)
    shifted = 0.5 * (matrix + matrix.T) + (shift - error) * jnp.eye(matrix.shape[0], dtype=matrix.dtype)
    return (shift > 2 * error) & jnp.all(jnp.isfinite(jnp.linalg.cholesky(shifted)))


def split(
    m: Measurements,
    start: Float[Array, "n4 n4"],
    shift: Float[Array, ""],
    *,
    iterations: Int[Array, ""] | int = 200,
) -> Split:
    """Iterate from a dual matrix until one is proved to have no eigenvalue below ``-shift``."""
    exists = existing(m)
    scale = jnp.tile(jnp.array([VECTOR_SCALE] * 3 + [1.0], start.dtype), exists.shape[0])
    first = start * scale[:, None] * scale
    margins = jnp.asarray(MARGINS, start.dtype) * m.cbar2 * VECTOR_SCALE**2
    across = _across(exists)

    class State(NamedTuple):
        iterate: Array
        affine: Array
        proved: Array
        rounds: Array

    def once(state: State) -> State:
        inside = margins[jnp.sum(state.rounds >= jnp.array(UNTIL))] * across
        cone = project_semidefinite(state.iterate - inside) + inside
        affine = first + project_dual(2 * cone - state.iterate - first, exists)
        proved = reaches(m, affine / scale[:, None] / scale, shift)
        return State(state.iterate + RELAXATION * (affine - cone), affine, proved, state.rounds + 1)

    state = State(first, first, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    final = lax.while_loop(lambda s: ~s.proved & (s.rounds < iterations), once, state)
    return Split(final.affine / scale[:, None] / scale, final.proved, final.rounds)


def _across(exists: Float[Array, " n"]) -> Float[Array, "n4 n4"]:
    """The projection that takes out the candidate, x = (e4, ..., e4), on the blocks that exist."""
    candidate = jnp.kron(exists, jnp.array([0, 0, 0, 1], exists.dtype)) / jnp.sqrt(jnp.sum(exists))
    return jnp.diag(jnp.repeat(exists, 4, total_repeat_length=4 * exists.shape[0])) - jnp.outer(
        candidate, candidate
    )


class Trajectory(NamedTuple):
    """The published method, round by round: suboptimality of each affine iterate, NaN behind the end."""

    suboptimality: Float[Array, " t"]
    matrix: Float[Array, "n4 n4"]  # the affine iterate of the smallest one
    rounds: Int[Array, ""]


def reference(m: Measurements, *, tolerance: Float[Array, ""] | float, iterations: int = 200) -> Trajectory:
    """Algorithm 3 as published: plain guess and coordinates, the smallest eigenvalue in every round.

    Slow, and here for comparison and conformance.
    """
    first, exists, mu = dual_matrix(m, reference_guess(m)), existing(m), m.cost
    count = jnp.sum(exists)

    class State(NamedTuple):
        iterate: Array
        found: Trajectory
        best: Array

    def once(state: State) -> State:
        cone = project_semidefinite(state.iterate)
        affine = first + project_dual(2 * cone - state.iterate - first, exists)
        eta = jnp.maximum(-smallest_eigenvalue(affine, exists), 0) * count / mu
        past, better = state.found, eta < state.best
        found = Trajectory(
            past.suboptimality.at[past.rounds].set(eta),
            jnp.where(better, affine, past.matrix),
            past.rounds + 1,
        )
        return State(state.iterate + RELAXATION * (affine - cone), found, jnp.where(better, eta, state.best))

    empty = Trajectory(jnp.full(iterations, np.nan, first.dtype), first, jnp.zeros((), jnp.int32))
    start = State(first, empty, jnp.asarray(jnp.inf, first.dtype))
    return lax.while_loop(lambda s: (s.best >= tolerance) & (s.found.rounds < iterations), once, start).found
