"""From a candidate rotation to a proof: what is to be shown, how it is tried, what follows.

    claim_of   polish the candidate; how far below zero may eigenvalues lie?
    direct     a dual matrix from a closed form, one Cholesky: enough for most right candidates
    iterate    otherwise go on towards a dual matrix that proves it
    read_off   bounds, the verdict on the rotation that was given, and the proof itself

These are the steps of ``certify_rotation``, in the frame of the candidate and in units of the bounds.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import coupled_guess, dual_matrix, dual_of, existing
from teaser_jax.certify.options import CertifyMethod
from teaser_jax.certify.semidefinite import factorisation_error, reaches, smallest_eigenvalue
from teaser_jax.certify.splitting import reference, split
from teaser_jax.ground.loops import until_settled
from teaser_jax.stages.rotation.pair_search import polish
from teaser_jax.stages.rotation.quadratic_form import Measurements

# Costs below this share of one outlier's are zero: relative gaps say nothing there.
ABSOLUTE_TOLERANCE = 1e-6
# Curvatures away from the candidate that are tried, in units of the truncation.
CURVATURES = (1e-2, 1e-4)


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


def claim_of(m: Measurements, constant: Float[Array, ""], tolerance: Float[Array, ""] | float) -> Claim:
    """Say what is to be proved: the verdict is on the rotation given, the bound comes from the polished one.

    Where the given one costs more than the polished one by the tolerance or more, it is refuted, and what is
    left to prove is the polished one.
    """
    turn = polish(m)
    polished = m.turned(turn)
    given, best = m.cost + constant, polished.cost + constant
    # A hair less than the tolerance, so that the suboptimality does not read a hair more.
    share, least = jnp.asarray((1 - 1e-9) * tolerance, given.dtype), ABSOLUTE_TOLERANCE * m.cbar2
    tolerated = jnp.maximum(share * given, least) - (given - best)
    aim = jnp.where(tolerated > 0, tolerated, jnp.maximum(share * best, least))
    count = jnp.sum(m.mask).astype(given.dtype) + 1
    return Claim(polished, turn, given, best, tolerated > 0, aim / count)


def direct(claim: Claim) -> Attempt:
    """Try the closed form, with the correction for few outliers and, if that proves nothing, without."""
    m = claim.polished

    class State(NamedTuple):
        matrix: Array
        guesses: Array

    def guess(state: State) -> tuple[State, Array]:
        # One guess in the program, and not two: it is half of what there is to compile.
        matrix = dual_matrix(m, coupled_guess(m, correct_outliers=state.guesses == 0))
        return State(matrix, state.guesses + 1), reaches(m, matrix, claim.shift)

    size = 4 * m.src.shape[0] + 4
    start = State(jnp.zeros((size, size), m.src.dtype), jnp.int32(0))
    last, proved = until_settled(guess, start, iterations=2)
    return Attempt(last.matrix, proved, jnp.int32(0), jnp.int32(CertifiedBy.DIRECT))


def iterate(claim: Claim, attempt: Attempt, iterations: Int[Array, ""] | int) -> Attempt:
    """Continue ``attempt`` by the splitting: it ended in the closed form without the correction."""
    found = split(claim.polished, attempt.matrix, claim.shift, iterations=iterations)
    return Attempt(found.matrix, found.proved, found.rounds, jnp.int32(CertifiedBy.SPLITTING))


def as_published(claim: Claim, iterations: int) -> Attempt:
    """Run Algorithm 3, then test its best matrix once, as the other methods test theirs."""
    m = claim.polished
    count = jnp.sum(m.mask, dtype=claim.shift.dtype) + 1
    tolerance = claim.shift * count / jnp.where(m.cost > 0, m.cost, 1)
    found = reference(m, tolerance=0.99 * tolerance, iterations=iterations)
    proved = reaches(m, found.matrix, claim.shift)
    return Attempt(found.matrix, proved, found.rounds, jnp.int32(CertifiedBy.REFERENCE))


def prove(
    m: Measurements,
    frame: Float[Array, "3 3"],
    constant: Float[Array, ""],
    tolerance: Float[Array, ""] | float,
    *,
    iterations: int,
    method: CertifyMethod,
) -> Certificate:
    """Take all steps of a proof in one program, for jit and vmap.

    Args:
        m: The measurements, in the frame of the rotation that was given.
        frame: That rotation.
        constant: Cost of the measurements that no rotation changes [-].
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting.
        method: Where a dual matrix comes from.
    """
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
    """Bound all eigenvalues from below; none are computed where a proof has said enough."""
    return lax.cond(attempt.proved, lambda: -claim.shift, lambda: lowest_eigenvalue(claim, attempt))


def lowest_eigenvalue(claim: Claim, attempt: Attempt) -> Float[Array, ""]:
    """Find a number so far below all eigenvalues that a Cholesky factorisation can confirm it."""
    m = claim.polished
    lowest = smallest_eigenvalue(attempt.matrix, existing(m))
    return jnp.minimum(lowest, 0) - 3 * factorisation_error(m, attempt.matrix)


def read_off(
    frame: Float[Array, "3 3"], claim: Claim, attempt: Attempt, lowest: Float[Array, ""]
) -> Certificate:
    """Read the certificate off an attempt: a bound always, a verdict where it is proved.

    Args:
        frame: The rotation that was given.
        claim, attempt: What was wanted, and what came of it.
        lowest: A number that no eigenvalue of the attempt's matrix lies below.
    """
    m, matrix = claim.polished, attempt.matrix
    measured, error = jnp.sum(m.mask), factorisation_error(m, matrix)
    some, known = measured > 0, jnp.isfinite(claim.given) & jnp.isfinite(error) & jnp.isfinite(lowest)
    zero = some & (claim.given <= ABSOLUTE_TOLERANCE * m.cbar2)
    lower = _lower_bound(claim, measured, lowest)
    lower = jnp.where(some, jnp.where(zero | ~known, 0, lower), claim.given)
    gap = claim.given - lower
    everything = m.cbar2 * jnp.maximum(measured, 1).astype(m.cbar2.dtype)
    optimal = (attempt.proved | zero) & claim.possible & known
    unique, angle_bound = lax.cond(
        attempt.proved & optimal & some,
        lambda: _others(claim, matrix, error),
        lambda: (jnp.zeros((), bool), jnp.full((), jnp.inf, gap.dtype)),
    )
    angle = so3.rotation_angle(claim.turn)
    within = angle_bound + angle
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
        status=_status(claim, optimal=optimal, known=known, some=some, error=error),
        rotation=so3.rotate(frame, claim.turn.T).T,
        angle=angle,
        dual=dual_of(m, matrix),
    )


def _lower_bound(claim: Claim, measured: Int[Array, ""], lowest: Float[Array, ""]) -> Float[Array, ""]:
    """Bound the cost of every rotation from below, by a number that no eigenvalue lies below."""
    count = measured.astype(claim.given.dtype) + 1
    unchanged = (claim.best - claim.polished.cost) * (1 - 1e-9)  # by any rotation
    return jnp.clip(claim.best + count * lowest, unchanged, claim.best)


def _status(
    claim: Claim,
    *,
    optimal: Bool[Array, ""],
    known: Bool[Array, ""],
    some: Bool[Array, ""],
    error: Float[Array, ""],
) -> Int[Array, ""]:
    """Choose the status of a certificate; of all that hold the last in the list counts."""
    status = jnp.int32(CertificateStatus.UNKNOWN)
    for holds, what in (
        (claim.shift <= 2 * error, CertificateStatus.UNDECIDABLE),
        (optimal, CertificateStatus.OPTIMAL),
        (~claim.possible, CertificateStatus.SUBOPTIMAL),
        (~known, CertificateStatus.UNDECIDABLE),
        (~some, CertificateStatus.NO_MEASUREMENTS),
    ):
        status = jnp.where(holds, jnp.int32(what), status)
    return status


def _others(
    claim: Claim, matrix: Float[Array, "n4 n4"], error: Float[Array, ""]
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Tell whether M is positive away from the candidate x, and how far from x an equal rotation can be.

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
    room = 3 * factorisation_error(m, lifted)
    spare = claim.given - claim.best

    curvatures = jnp.asarray(CURVATURES, matrix.dtype)

    class State(NamedTuple):
        delta: Array
        curvature: Array  # which one is tried next

    def across(state: State) -> tuple[State, Array]:
        delta = curvatures[state.curvature] * m.cbar2
        positive = reaches(m, lifted - (delta + room) * jnp.eye(len(x)), room)
        return State(delta, state.curvature + 1), positive

    # The larger one first; one factorisation in the program, and not two.
    start = State(jnp.ones((), matrix.dtype), jnp.int32(0))
    (delta, _), unique = until_settled(across, start, iterations=len(CURVATURES))
    root = jnp.sqrt(leak**2 * count + delta * (spare + leak * count))
    sine = (leak * jnp.sqrt(count) + root) / (delta * jnp.sqrt(count))
    angle = jnp.where(sine < 1, 2 * jnp.arcsin(jnp.minimum(sine, 1)), jnp.inf)
    return unique, jnp.where(unique, angle, jnp.inf)
