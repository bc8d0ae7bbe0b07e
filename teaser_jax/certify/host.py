"""Certificates outside jit: sizes that fit, and the splitting only where the closed form proves nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple, TypeVar

import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import Dual
from teaser_jax.certify.host_measurements import HostMeasurements, padded, padded_count
from teaser_jax.certify.options import CertifyMethod, Options
from teaser_jax.certify.proof import (
    Attempt,
    Claim,
    claim_of,
    direct,
    iterate,
    lowest_eigenvalue,
    lowest_if_unproved,
    prove,
    read_off,
)
from teaser_jax.engine.compiler import OLDER_EMITTERS, WHOLE_SUMS
from teaser_jax.ground.arrays import AnyArray, inside_jit
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.stages.rotation.quadratic_form import Framed, in_frame_of

QUICKLY = WHOLE_SUMS | OLDER_EMITTERS
COMPILED_AHEAD = 128  # measurements: larger programs take longest to compile and are rarely asked for

Result = TypeVar("Result")


class Pending(NamedTuple):
    """A proof that the closed form has begun: what the next program goes on from."""

    frame: Float[AnyArray, "*batch 3 3"]
    claim: Claim
    attempt: Attempt


class ClosedForm(NamedTuple):
    """What the closed form came to: a certificate, and what is left to do.

    Attributes:
        certificate: What it proves.
        settled: Whether that is all there is to say.
        hopeful: Whether iterations could prove more.
        pending: What they go on from.
    """

    certificate: Certificate
    settled: Bool[AnyArray, "*batch"]
    hopeful: Bool[AnyArray, "*batch"]
    pending: Pending


def in_float64(work: Callable[[], Result]) -> Result:
    """Do work on concrete numbers in float64, also while somebody's jit is traced around it."""
    if not inside_jit():
        with as_on_the_host():
            return work()
    # Programs with options of the compiler cannot be traced into others. Here they are constants, and what
    # they hold is compiled piece by piece, which is slow.
    with jax.ensure_compile_time_eval(), as_on_the_host():
        return work()


def certify_on_host(
    measurements: HostMeasurements, rotation: Float[np.ndarray, "3 3"], options: Options, *, rounds: int
) -> Certificate:
    """Certify one rotation, program by program: most of the time the closed form proves enough.

    Args:
        measurements: What the rotation is held against.
        rotation: The candidate.
        options: How to certify.
        rounds: Cap on rounds of the splitting.
    """
    if measurements.measured > options.max_measurements:
        return too_large(measurements, rotation)
    tolerance = np.float64(options.tolerance)

    def work() -> Certificate:
        if options.method == "reference":
            return jax.device_get(_published(measurements, rotation, tolerance, iterations=rounds))
        found = _closed_form(measurements, rotation, tolerance)
        if found.settled:
            return jax.device_get(found.certificate)
        return jax.device_get(
            after_closed_form(found.pending, hopeful=found.hopeful, rounds=rounds, method=options.method)
        )

    return with_blocks(in_float64(work), measurements.measured + 1)


def compile_ahead(most: int) -> None:
    """Compile all programs that certify up to so many measurements, 128 at most."""

    def everything(measurements: HostMeasurements) -> tuple[Certificate, Certificate]:
        pending = _closed_form(measurements, np.eye(3), np.float64(1e-3)).pending
        return _iterated(pending, np.int32(0)), _bounded(pending)

    three = HostMeasurements(np.eye(3), np.eye(3), np.ones(3), np.asarray(1.0), np.ones(3, bool))
    for size in sorted({padded_count(k) for k in range(1, min(most, COMPILED_AHEAD) + 1)}):
        jax.block_until_ready(in_float64(partial(everything, padded(three, size))))


def after_closed_form(
    pending: Pending, *, hopeful: Bool[AnyArray, ""], rounds: int, method: CertifyMethod
) -> Certificate:
    """Certify what the closed form did not prove: a bound, and a proof where one can be had."""
    if method == "splitting" and hopeful:
        return _iterated(pending, np.int32(rounds))
    return _bounded(pending)


def with_blocks(found: Certificate, n: int) -> Certificate:
    """Give the dual of a certificate n blocks: padding, which is zero, is cut off or added."""
    skew, diagonal = (x[:n] for x in found.dual)
    skew, diagonal, missing = skew[:, :n], diagonal[: n - 1], n - len(skew)
    if missing:
        skew = np.pad(skew, ((0, missing), (0, missing), (0, 0)))
        diagonal = np.pad(diagonal, ((0, missing), (0, 0), (0, 0)))
    return replace(found, dual=Dual(skew, diagonal))


def too_large(measurements: HostMeasurements, rotation: Float[np.ndarray, "3 3"]) -> Certificate:
    """Prove nothing of measurements that are too many to look at; the cost is known all the same."""
    m, frame, constant = in_float64(lambda: jax.device_get(framed(measurements, rotation)))
    count = np.sum(m.mask)
    r2 = np.sum((m.dst - m.src) ** 2, axis=1)
    cost = np.where(m.mask, np.minimum(r2, measurements.cbar2), 0).sum() + constant
    zero, false = np.float64(0), np.bool_(False)
    return Certificate(
        cost=cost,
        lower_bound=zero,
        suboptimality=np.float64(1),
        absolute_gap=cost / (measurements.cbar2 * max(count, 1)),
        is_optimal=false,
        is_unique=false,
        angle_bound=np.float64(np.inf),
        measurements=np.int32(count),
        iterations=np.int32(0),
        method=np.int32(CertifiedBy.NOTHING),
        status=np.int32(CertificateStatus.TOO_LARGE),
        rotation=frame,
        angle=zero,
        dual=Dual(np.zeros((1, 1, 6)), np.zeros((0, 4, 4))),
    )


@jax.jit
def framed(measurements: HostMeasurements, rotation: Float[Array, "3 3"]) -> Framed:
    """Turn the measurements into the frame of the rotation, and nothing else."""
    return in_frame_of(rotation, **measurements._asdict())


def closed_form(
    measurements: HostMeasurements, rotation: Float[Array, "3 3"], tolerance: Float[Array, ""]
) -> ClosedForm:
    """Try the closed form, and say whether more is to be proved and could be."""
    m, frame, constant = in_frame_of(rotation, **measurements._asdict())
    claim = claim_of(m, constant, tolerance)
    attempt = direct(claim)
    found = read_off(frame, claim, attempt, -claim.shift)
    settled = attempt.proved | (found.method == CertifiedBy.ZERO_COST)
    settled |= found.status == CertificateStatus.NO_MEASUREMENTS
    hopeful = claim.possible & (found.status != CertificateStatus.UNDECIDABLE)
    return ClosedForm(found, settled, hopeful, Pending(frame, claim, attempt))


_closed_form = jax.jit(closed_form, compiler_options=QUICKLY)


@partial(jax.jit, compiler_options=QUICKLY)
def _bounded(pending: Pending) -> Certificate:
    """Read a bound off the closed form, from the eigenvalues of its matrix."""
    return read_off(*pending, lowest_eigenvalue(pending.claim, pending.attempt))


@partial(jax.jit, compiler_options=QUICKLY)
def _iterated(pending: Pending, iterations: Int[Array, ""]) -> Certificate:
    """Continue a proof by the splitting, and read the certificate off where it ends."""
    attempt = iterate(pending.claim, pending.attempt, iterations)
    lowest = lowest_if_unproved(pending.claim, attempt)
    return read_off(pending.frame, pending.claim, attempt, lowest)


@partial(jax.jit, static_argnames="iterations", compiler_options=QUICKLY)
def _published(
    measurements: HostMeasurements,
    rotation: Float[Array, "3 3"],
    tolerance: Float[Array, ""],
    *,
    iterations: int,
) -> Certificate:
    """Certify a rotation by Algorithm 3 as published."""
    m, frame, constant = in_frame_of(rotation, **measurements._asdict())
    return prove(m, frame, constant, tolerance, iterations=iterations, method="reference")
