"""From a candidate rotation to a proof: what is to be shown, how it is tried, what follows.

    claim_of   polish the candidate; how far below zero may eigenvalues lie?
    direct     a dual matrix from a closed form, one Cholesky: enough for most right candidates
    iterate    otherwise go on towards a dual matrix that proves it
    read_off   bounds, the verdict on the rotation that was given, and the proof itself

These are the steps of ``certify_rotation``, in the frame of the candidate and in units of the bounds.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import coupled_guess, dual_matrix, dual_of
from teaser_jax.certify.projection import smallest_eigenvalue
from teaser_jax.certify.splitting import existing, reaches, reference, rounding, split
from teaser_jax.stages.rotation.pair_search import polish
from teaser_jax.stages.rotation.quadratic_form import Measurements

# Costs below this share of one outlier's are zero: relative gaps say nothing there.
ABSOLUTE_TOLERANCE = 1e-6
# Curvatures away from the candidate that are tried, in units of the truncation.
CURVATURES = (1e-2, 1e-4)

CertifyMethod = Literal["splitting", "direct", "reference"]


class Claim(NamedTuple):
    """What is to be proved: the polished candidate, and how far eigenvalues may lie below zero for it."""

    polished: Measurements
    turn: Float[Array, "3 3"]  # from the rotation that was given to the polished one
    given: Float[Array, ""]  # cost of the rotation that was given
    best: Float[Array, ""]  # cost of the polished one
    possible: Bool[Array, ""]  # whether any proof could make the given one optimal
    shift: Float[Array, ""]


class Attempt(NamedTuple):
    """A dual matrix, whether it proves what was wanted, and how it was found."""

    matrix: Float[Array, "n4 n4"]
    proved: Bool[Array, ""]
    iterations: Int[Array, ""]
    method: Int[Array, ""]


def claim_of(m: Measurements, constant: Float[Array, ""], tolerance: Any) -> Claim:
    """The verdict is on the rotation as given; the bound comes from the polished one.

    Where the given one costs more than the polished one by the tolerance or more, it is refuted, and what is
    left to prove is the polished one.
    """
    turn = polish(m)
    polished = m.turned(turn)
    given, best = m.cost + constant, polished.cost + constant
    # A hair less than the tolerance, so that the suboptimality does not read a hair more.
    least = ABSOLUTE_TOLERANCE * m.cbar2
    tolerated = jnp.maximum((1 - 1e-9) * tolerance * given, least) - (given - best)
    aim = jnp.where(tolerated > 0, tolerated, jnp.maximum((1 - 1e-9) * tolerance * best, least))
    count = jnp.sum(m.mask).astype(given.dtype) + 1
    return Claim(polished, turn, given, best, tolerated > 0, aim / count)


def direct(claim: Claim) -> Attempt:
    """The closed form, with the correction for few outliers and, if that proves nothing, without."""
    m = claim.polished

    def guess(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        # One guess in the program, and not two: it is half of what there is to compile.
        _, _, tries = state
        matrix = dual_matrix(m, coupled_guess(m, correct_outliers=tries == 0))
        return matrix, reaches(m, matrix, claim.shift), tries + 1

    size = 4 * m.src.shape[0] + 4
    start = jnp.zeros((size, size), m.src.dtype), jnp.zeros((), bool), jnp.int32(0)
    matrix, proved, _ = lax.while_loop(lambda s: ~s[1] & (s[2] < 2), guess, start)
    return Attempt(matrix, proved, jnp.int32(0), jnp.int32(CertifiedBy.DIRECT))


def iterate(claim: Claim, attempt: Attempt, iterations: Int[Array, ""] | int) -> Attempt:
    """The splitting, from the closed form without the correction, in which ``attempt`` ended."""
    found = split(claim.polished, attempt.matrix, claim.shift, iterations=iterations)
    return Attempt(found.matrix, found.proved, found.rounds, jnp.int32(CertifiedBy.SPLITTING))


def as_published(claim: Claim, iterations: int) -> Attempt:
    """Algorithm 3, then one test of its best matrix like those of the others."""
    m = claim.polished
    count = jnp.sum(m.mask) + 1
    tolerance = claim.shift * count / jnp.where(m.cost > 0, m.cost, 1)
    found = reference(m, tolerance=0.99 * tolerance, iterations=iterations)
    proved = reaches(m, found.matrix, claim.shift)
    return Attempt(found.matrix, proved, found.rounds, jnp.int32(CertifiedBy.REFERENCE))


def prove(
    m: Measurements,
    frame: Float[Array, "3 3"],
    constant: Float[Array, ""],
    tolerance: Any,
    *,
    iterations: int,
    method: CertifyMethod,
) -> Certificate:
    """All steps in one program, for jit and vmap."""
    claim = claim_of(m, constant, tolerance)
    if method == "reference":
        attempt = as_published(claim, iterations)
    else:
        attempt = direct(claim)
        if method == "splitting":
            ended, first = attempt.proved | ~claim.possible, attempt
            attempt = lax.cond(ended, lambda: first, lambda: iterate(claim, first, iterations))
    return read_off(frame, claim, attempt, lowest_if_unproved(claim, attempt))


def lowest_if_unproved(claim: Claim, attempt: Attempt) -> Float[Array, ""]:
    """No eigenvalues are computed where a proof has said enough."""
    return lax.cond(attempt.proved, lambda: -claim.shift, lambda: lowest_eigenvalue(claim, attempt))


def lowest_eigenvalue(claim: Claim, attempt: Attempt) -> Float[Array, ""]:
    """A number below all eigenvalues, by so much that a Cholesky factorisation can confirm it."""
    m = claim.polished
    lowest = smallest_eigenvalue(attempt.matrix, existing(m))
    return jnp.minimum(lowest, 0) - 3 * rounding(m, attempt.matrix)


def read_off(
    frame: Float[Array, "3 3"], claim: Claim, attempt: Attempt, lowest: Float[Array, ""]
) -> Certificate:
    """The certificate of an attempt: a bound always, a verdict where it is proved.

    Args:
        frame: The rotation that was given.
        claim, attempt: What was wanted, and what came of it.
        lowest: A number that no eigenvalue of the attempt's matrix lies below.
    """
    m, matrix = claim.polished, attempt.matrix
    measured = jnp.sum(m.mask)
    count = measured.astype(claim.given.dtype) + 1
    error = rounding(m, matrix)
    some, known = measured > 0, jnp.isfinite(claim.given)
    zero = some & (claim.given <= ABSOLUTE_TOLERANCE * m.cbar2)
    unchanged = (claim.best - m.cost) * (1 - 1e-9)  # by any rotation
    lower = jnp.clip(claim.best + count * lowest, unchanged, claim.best)
    lower = jnp.where(some, jnp.where(zero | ~known, 0, lower), claim.given)
    gap = claim.given - lower
    everything = m.cbar2 * jnp.maximum(measured, 1)
    optimal = (attempt.proved | zero) & claim.possible & known
    unique, angle_bound = lax.cond(
        attempt.proved & optimal & some,
        lambda: _others(claim, matrix, error),
        lambda: (jnp.zeros((), bool), jnp.full((), jnp.inf, gap.dtype)),
    )
    angle = so3.rotation_angle(claim.turn)
    within = angle_bound + angle
    status = jnp.int32(CertificateStatus.UNKNOWN)
    for holds, what in (
        (claim.shift <= 2 * error, CertificateStatus.UNDECIDABLE),
        (optimal, CertificateStatus.OPTIMAL),
        (~claim.possible, CertificateStatus.SUBOPTIMAL),
        (~known, CertificateStatus.UNDECIDABLE),
        (~some, CertificateStatus.NO_MEASUREMENTS),
    ):
        status = jnp.where(holds, jnp.int32(what), status)
    return Certificate(
        cost=claim.given,
        lower_bound=lower,
        suboptimality=jnp.where(zero | ~some, 0, jnp.where(known, gap / jnp.where(zero, 1, claim.given), 1)),
        absolute_gap=jnp.where(known, gap / everything, 1),
        is_optimal=optimal & some,
        is_unique=unique,
        angle_bound=jnp.where(within < np.pi, within, jnp.inf),
        measurements=measured.astype(jnp.int32),
        iterations=attempt.iterations,
        method=jnp.where(
            zero, jnp.int32(CertifiedBy.ZERO_COST), jnp.where(some, attempt.method, CertifiedBy.NOTHING)
        ).astype(jnp.int32),
        status=status,
        rotation=so3.rotate(frame, claim.turn.T).T,
        angle=angle,
        dual=dual_of(m, matrix),
    )


def _others(
    claim: Claim, matrix: Float[Array, "n4 n4"], error: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Whether M is positive away from the candidate x, and how far from it an equal rotation can be.

    If M >= delta across x, a rotation at angle phi from the polished candidate costs at least
    delta n sin^2(phi / 2) more, but for what rounding leaves of M x.
    """
    m = claim.polished
    exists = existing(m)
    count = jnp.sum(exists)
    x = jnp.kron(exists, jnp.array([0, 0, 0, 1.0], exists.dtype)) / jnp.sqrt(count)
    # Padding is no direction.
    padding = jnp.diag(jnp.repeat(1 - exists, 4, total_repeat_length=len(x)))
    high = lax.Precision.HIGHEST
    leak = jnp.linalg.norm(jnp.matmul(matrix, x, precision=high)) + error
    heavy = jnp.trace(matrix) / count + m.cbar2
    lifted = matrix + heavy * (jnp.outer(x, x) + padding)
    room = 3 * rounding(m, lifted)
    spare = claim.given - claim.best

    def across(curvature: Array) -> tuple[Array, Array]:
        delta = curvature * m.cbar2
        return delta, reaches(m, lifted - (delta + room) * jnp.eye(len(x)), room)

    # The larger one first; one factorisation in the program, and not two.
    curvatures = jnp.asarray(CURVATURES, matrix.dtype)
    delta, unique, _ = lax.while_loop(
        lambda s: ~s[1] & (s[2] < len(CURVATURES)),
        lambda s: (*across(curvatures[s[2]]), s[2] + 1),
        (jnp.ones((), matrix.dtype), jnp.zeros((), bool), jnp.int32(0)),
    )
    root = jnp.sqrt(leak**2 * count + delta * (spare + leak * count))
    sine = (leak * jnp.sqrt(count) + root) / (delta * jnp.sqrt(count))
    angle = jnp.where(sine < 1, 2 * jnp.arcsin(jnp.minimum(sine, 1)), jnp.inf)
    return unique, jnp.where(unique, angle, jnp.inf)
