"""A certificate for one rotation: how far its cost can be from the best there is (section IX).

    polish    the candidate to the least squares rotation of its own inliers, if that is better
    direct    a dual matrix from a closed form, one Cholesky: enough for most right candidates
    split     otherwise iterate towards a dual matrix that proves it
    read off  bounds, the verdict on the rotation that was given, and the proof itself

A proof speaks of these measurements: it says optimal, never right.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import coupled_guess, dual_matrix, dual_of
from teaser_jax.certify.projection import smallest_eigenvalue
from teaser_jax.certify.quadratic_form import Measurements
from teaser_jax.certify.splitting import existing, reaches, reference, rounding, split
from teaser_jax.problem import is_traced
from teaser_jax.so3 import AnyArray

TOLERANCE = 1e-3
ITERATIONS = 200
MAX_MEASUREMENTS = 128  # under jit, where sizes are static
POLISH_ROUNDS = 50
# Costs below this share of one outlier's are zero: relative gaps say nothing there.
ABSOLUTE_TOLERANCE = 1e-6
# Curvatures away from the candidate that are tried, in units of the truncation.
CURVATURES = (1e-2, 1e-4)

CertifyMethod = Literal["splitting", "direct", "reference"]


def certify_rotation(
    src: Float[AnyArray, "k 3"],
    dst: Float[AnyArray, "k 3"],
    rotation: Float[AnyArray, "3 3"],
    *,
    noise_bound: Any,
    cbar2: Any = 1.0,
    mask: Bool[AnyArray, " k"] | None = None,
    tolerance: Any = TOLERANCE,
    iterations: int = ITERATIONS,
    method: CertifyMethod = "splitting",
) -> Certificate:
    """Bound how much better than ``rotation`` any rotation could fit ``dst_k ~ R src_k``.

    The candidate may come from anywhere. Everything is done in float64, whatever the input, without
    touching JAX's configuration. Outside jit the measurements that count are compacted first.

    Args:
        src, dst: Vectors, row k with row k [length]; a known scale is part of ``src``.
        rotation: The candidate; projected on SO(3) first.
        noise_bound: delta_k, the bound of the vectors as they are given, one or (k,) [length].
        cbar2: Truncation, c-bar squared [-].
        mask: (k,) rows to use; rows that are not finite are left out.
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting.
        method: ``"splitting"``, ``"direct"`` (closed form only, no iteration) or ``"reference"``
            (Algorithm 3 as published, slow).

    Returns:
        A ``Certificate``.

    Raises:
        ValueError: Shapes that do not fit, a method that is unknown.

    Gradients: none, inputs are stopped.

    References: Yang, Shi, Carlone, T-RO 2020, section IX, problems (19) and (23), Algorithm 3.
    """
    if method not in ("splitting", "direct", "reference"):
        raise ValueError(f"method is {method!r}: expected 'splitting', 'direct' or 'reference'.")
    shapes = np.shape(src), np.shape(dst), np.shape(rotation)
    if shapes[0] != shapes[1] or len(shapes[0]) != 2 or shapes[0][1] != 3 or shapes[2] != (3, 3):
        raise ValueError(
            f"src, dst and rotation have shapes {shapes}: expected (k, 3), (k, 3) and (3, 3); rows are "
            "measurements."
        )
    k = shapes[0][0]
    mask = np.ones(k, bool) if mask is None else mask
    if is_traced(src, dst, rotation, noise_bound, cbar2, mask, tolerance):
        dtype = jnp.result_type(src)
        arguments = lax.stop_gradient((src, dst, rotation, noise_bound, cbar2))
        with jax.enable_x64(True):
            m, frame, constant = _measurements(*arguments, mask)
            found = prove(m, frame, constant, tolerance, iterations=iterations, method=method)
            return jax.tree.map(
                lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, found
            )
    numbers = [np.asarray(x, np.float64) for x in (src, dst, rotation, noise_bound, cbar2)]
    return _outside_jit(numbers, np.asarray(mask, bool), float(tolerance), iterations, method)


def _measurements(
    src: Any, dst: Any, rotation: Any, noise_bound: Any, cbar2: Any, mask: Any
) -> tuple[Measurements, Float[Array, "3 3"], Float[Array, ""]]:
    """In units of the bounds and in the candidate's frame; the frame; the cost that no rotation changes."""
    src, dst, rotation, noise_bound, cbar2 = (
        jnp.asarray(x).astype(jnp.float64) for x in (src, dst, rotation, noise_bound, cbar2)
    )
    bound = jnp.broadcast_to(noise_bound, src.shape[:1])
    usable = mask & jnp.all(jnp.isfinite(src), axis=1) & jnp.all(jnp.isfinite(dst), axis=1)
    usable &= jnp.isfinite(bound) & (bound > 0) & jnp.isfinite(cbar2) & (cbar2 > 0)
    bound = jnp.where(usable, bound, 1)[:, None]
    src, dst = (jnp.where(usable[:, None], x, 0) / bound for x in (src, dst))
    frame = so3.nearest_rotation(jnp.where(jnp.all(jnp.isfinite(rotation)), rotation, jnp.eye(3)))
    # A vector of no length has the same residual under every rotation.
    length2 = jnp.sum(src**2, axis=1), jnp.sum(dst**2, axis=1)
    turns = usable & (length2[0] > 0) & (length2[1] > 0)
    rest = usable & ~turns
    constant = jnp.sum(jnp.where(rest, jnp.minimum(length2[0] + length2[1], cbar2), 0))
    src, dst = (jnp.where(turns[:, None], x, 0) for x in (src, dst))
    return Measurements(src, so3.rotate(frame.T, dst), cbar2, turns), frame, constant


def polish(m: Measurements) -> Float[Array, "3 3"]:
    """The turn from the candidate to the best of the rotations met when fitting inliers again and again.

    A candidate that is merely close cannot be certified: the proof needs a stationary one.
    """

    class State(NamedTuple):
        turn: Array
        best: Array
        cost: Array
        inliers: Array
        settled: Array
        rounds: Array

    def once(state: State) -> State:
        now = m.turned(state.turn)
        inliers = now.inliers
        weights = inliers.astype(m.src.dtype)[:, None]
        fitted = so3.nearest_rotation(jnp.matmul((weights * m.dst).T, m.src, precision=lax.Precision.HIGHEST))
        cost = m.turned(fitted).cost
        better = cost < state.cost
        return State(
            fitted,
            jnp.where(better, fitted, state.best),
            jnp.where(better, cost, state.cost),
            inliers,
            jnp.all(inliers == state.inliers) & (state.rounds > 0),
            state.rounds + 1,
        )

    eye = jnp.eye(3, dtype=m.src.dtype)
    start = State(eye, eye, m.cost, m.inliers, jnp.zeros((), bool), jnp.zeros((), jnp.int32))
    return lax.while_loop(lambda s: ~s.settled & (s.rounds < POLISH_ROUNDS), once, start).best


class Attempt(NamedTuple):
    """A dual matrix, whether it proves what was wanted, and how it was found."""

    matrix: Float[Array, "n4 n4"]
    proved: Bool[Array, ""]
    iterations: Int[Array, ""]
    method: Int[Array, ""]


class Claim(NamedTuple):
    """What is to be proved: the polished candidate, and how far eigenvalues may lie below zero for it."""

    polished: Measurements
    turn: Float[Array, "3 3"]
    given: Float[Array, ""]  # cost of the rotation that was given
    best: Float[Array, ""]  # cost of the polished one
    allowance: Float[Array, ""]  # by which the lower bound may lie below ``best``
    shift: Float[Array, ""]


def claim_of(m: Measurements, constant: Float[Array, ""], tolerance: Any) -> Claim:
    """The verdict is on the rotation as given; the bound comes from the polished one."""
    turn = polish(m)
    polished = m.turned(turn)
    given, best = m.cost + constant, polished.cost + constant
    tolerated = jnp.maximum(tolerance * given, ABSOLUTE_TOLERANCE * m.cbar2)
    allowance = tolerated - (given - best)
    count = jnp.sum(m.mask).astype(given.dtype) + 1
    return Claim(polished, turn, given, best, allowance, allowance / count)


def direct(claim: Claim) -> Attempt:
    """The closed form, with the correction for few outliers and without."""
    m = claim.polished

    def guess(correct: bool) -> tuple[Array, Array]:
        matrix = dual_matrix(m, coupled_guess(m, correct_outliers=correct))
        return matrix, reaches(m, matrix, claim.shift)

    corrected = guess(True)
    matrix, proved = lax.cond(corrected[1], lambda: corrected, lambda: guess(False))
    return Attempt(matrix, proved, jnp.int32(0), jnp.int32(CertifiedBy.DIRECT))


def iterate(claim: Claim, attempt: Attempt, iterations: int) -> Attempt:
    """The splitting, from the closed form without the correction, in which ``attempt`` ended."""
    found = split(claim.polished, attempt.matrix, claim.shift, iterations=iterations)
    return Attempt(found.matrix, found.proved, found.rounds, jnp.int32(CertifiedBy.SPLITTING))


def as_published(claim: Claim, iterations: int) -> Attempt:
    """Algorithm 3, then one test of its best matrix like those of the others."""
    m = claim.polished
    tolerance = jnp.maximum(claim.allowance, 0) / jnp.where(m.cost > 0, m.cost, 1)
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
    """All steps in one program."""
    claim = claim_of(m, constant, tolerance)
    if method == "reference":
        attempt = as_published(claim, iterations)
    else:
        attempt = direct(claim)
        if method == "splitting":
            hopeless = attempt.proved | (claim.allowance <= 0)
            first = attempt
            attempt = lax.cond(hopeless, lambda: first, lambda: iterate(claim, first, iterations))
    return read_off(frame, claim, attempt)


def read_off(frame: Float[Array, "3 3"], claim: Claim, attempt: Attempt) -> Certificate:
    """The certificate of an attempt: a bound always, a verdict where it is proved."""
    m, matrix = claim.polished, attempt.matrix
    measured = jnp.sum(m.mask)
    count = measured.astype(claim.given.dtype) + 1
    error = rounding(m, matrix)
    lowest = lax.cond(
        attempt.proved,
        lambda: -claim.shift,
        # Less than the smallest eigenvalue by so much that a Cholesky factorisation can confirm it.
        lambda: jnp.minimum(smallest_eigenvalue(matrix, 4 * (measured.astype(jnp.int32) + 1)), 0) - 3 * error,
    )
    zero = claim.given <= ABSOLUTE_TOLERANCE * m.cbar2
    lower = jnp.where(zero, 0, jnp.clip(claim.best + count * lowest, 0, claim.best))
    gap = claim.given - lower
    everything = m.cbar2 * jnp.maximum(measured, 1)
    some, optimal = measured > 0, (attempt.proved | zero) & (claim.allowance > 0)
    unique, angle_bound = lax.cond(
        optimal & some,
        lambda: _others(claim, matrix, error),
        lambda: (jnp.zeros((), bool), jnp.full((), jnp.inf, gap.dtype)),
    )
    angle = so3.rotation_angle(claim.turn)
    within = angle_bound + angle
    resolved = claim.shift > 2 * error
    status = jnp.int32(CertificateStatus.UNKNOWN)
    for holds, what in (
        (~resolved, CertificateStatus.UNDECIDABLE),
        (optimal, CertificateStatus.OPTIMAL),
        (claim.allowance <= 0, CertificateStatus.SUBOPTIMAL),
        (~some, CertificateStatus.NO_MEASUREMENTS),
    ):
        status = jnp.where(holds, jnp.int32(what), status)
    return Certificate(
        cost=claim.given,
        lower_bound=lower,
        suboptimality=jnp.where(zero, 0, gap / jnp.where(zero, 1, claim.given)),
        absolute_gap=gap / everything,
        is_optimal=optimal & some,
        is_unique=unique,
        angle_bound=jnp.where(within < np.pi, within, jnp.inf),
        iterations=attempt.iterations,
        method=jnp.where(zero, jnp.int32(CertifiedBy.ZERO_COST), attempt.method),
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
    unique, angle_bound = jnp.zeros((), bool), jnp.full((), jnp.inf, matrix.dtype)
    for curvature in CURVATURES:
        delta = curvature * m.cbar2
        positive = lax.cond(
            unique,
            lambda: jnp.zeros((), bool),
            lambda delta=delta: reaches(m, lifted - (delta + room) * jnp.eye(len(x)), room),
        )
        root = jnp.sqrt(leak**2 * count + delta * (spare + leak * count))
        across = (leak * jnp.sqrt(count) + root) / delta
        sine = across / jnp.sqrt(count)
        angle = jnp.where(sine < 1, 2 * jnp.arcsin(jnp.minimum(sine, 1)), jnp.inf)
        angle_bound = jnp.where(positive & ~unique, angle, angle_bound)
        unique |= positive
    return unique, angle_bound


@partial(jax.jit, static_argnames=("reference_rounds",))
def _first_program(
    src: Array, dst: Array, rotation: Array, noise_bound: Array, cbar2: Array, mask: Array,
    tolerance: Array, reference_rounds: int | None,
) -> tuple[Certificate, Any]:  # fmt: skip
    m, frame, constant = _measurements(src, dst, rotation, noise_bound, cbar2, mask)
    claim = claim_of(m, constant, tolerance)
    attempt = direct(claim) if reference_rounds is None else as_published(claim, reference_rounds)
    return read_off(frame, claim, attempt), (frame, claim, attempt)


@partial(jax.jit, static_argnames=("iterations",))
def _second_program(frame: Array, claim: Claim, attempt: Attempt, *, iterations: int) -> Certificate:
    return read_off(frame, claim, iterate(claim, attempt, iterations))


def padded_size(k: int) -> int:
    """The size of the programs that serve k measurements: an eighth more at most, sixteen at least."""
    step = max(8, 1 << max((k - 1).bit_length() - 3, 0))
    return max(16, -(-k // step) * step)


def _outside_jit(
    numbers: list[np.ndarray], mask: np.ndarray, tolerance: float, iterations: int, method: CertifyMethod
) -> Certificate:
    """Compacted and padded to a few sizes; the splitting only where the closed form proves nothing."""
    src, dst, rotation, noise_bound, cbar2 = numbers
    if mask.shape != src.shape[:1] or noise_bound.shape not in ((), src.shape[:1]) or cbar2.shape != ():
        raise ValueError(
            f"noise_bound, cbar2 and mask have shapes {noise_bound.shape}, {cbar2.shape} and {mask.shape}: "
            f"expected () or ({len(src)},), () and ({len(src)},)."
        )
    bound = np.broadcast_to(noise_bound, src.shape[:1])
    if not (np.all(bound[mask] > 0) and np.isfinite(cbar2) and cbar2 > 0 and 0 < tolerance < np.inf):
        raise ValueError("noise_bound, cbar2 and tolerance must be numbers above 0.")
    if not np.all(np.isfinite(rotation)):
        raise ValueError(f"rotation is not finite: {rotation.tolist()}.")
    k, size = int(mask.sum()), padded_size(int(mask.sum()))

    def compact(x: np.ndarray, fill: float) -> np.ndarray:
        full = np.full((size, *x.shape[1:]), fill)
        full[:k] = x[mask]
        return full

    rows = compact(src, 0.0), compact(dst, 0.0), rotation, compact(bound, 1.0), cbar2, np.arange(size) < k
    rounds = iterations if method == "reference" else None
    with jax.enable_x64(True):
        found, state = _first_program(*rows, np.float64(tolerance), rounds)
        if method == "splitting" and int(found.status) == CertificateStatus.UNKNOWN:
            found = _second_program(*state, iterations=iterations)
        return jax.device_get(found)
