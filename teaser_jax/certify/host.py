"""Certificates outside jit: sizes that fit, and the splitting only where the closed form proves nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Array

from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.dual import Dual
from teaser_jax.certify.proof import (
    Attempt,
    CertifyMethod,
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
from teaser_jax.stages.rotation.quadratic_form import Framed, in_frame_of

QUICKLY = WHOLE_SUMS | OLDER_EMITTERS


class Rows(NamedTuple):
    """Measurements in float64 on the host, those that count first, padded to one of a few sizes."""

    src: np.ndarray
    dst: np.ndarray
    noise_bound: np.ndarray
    cbar2: np.ndarray
    mask: np.ndarray


class State(NamedTuple):
    """What one program leaves to the next."""

    frame: Array
    claim: Claim
    attempt: Attempt


def at_once(work: Callable[[], Any]) -> Any:
    """In float64, and also while somebody's jit is traced around it: all numbers are there."""
    try:
        with jax.enable_x64(True):
            return work()
    except (jax.errors.TracerArrayConversionError, ValueError) as error:
        if isinstance(error, ValueError) and "compiler_options" not in str(error):  # at the top level only
            raise
        with jax.ensure_compile_time_eval(), jax.enable_x64(True):  # compiles constants one by one: slow
            return work()


def compacted(src: Any, dst: Any, noise_bound: Any, cbar2: Any, mask: Any) -> Rows:
    """Checked, and rows of the mask moved to the front. Raises ValueError on bad input."""
    src, dst, noise_bound, cbar2 = (np.asarray(x, np.float64) for x in (src, dst, noise_bound, cbar2))
    mask = np.asarray(mask, bool)
    n = len(src)
    if mask.shape != (n,) or noise_bound.shape not in ((), (n,)) or cbar2.shape != ():
        raise ValueError(
            f"noise_bound, cbar2 and mask have shapes {noise_bound.shape}, {cbar2.shape} and {mask.shape}: "
            f"expected () or ({n},), () and ({n},)."
        )
    bound = np.broadcast_to(noise_bound, (n,))
    if not (np.all((bound[mask] > 0) & (bound[mask] < np.inf)) and np.isfinite(cbar2) and cbar2 > 0):
        raise ValueError("noise_bound and cbar2 must be finite numbers above 0.")
    k = int(mask.sum())
    return padded(Rows(src[mask], dst[mask], bound[mask], cbar2, np.ones(k, bool)), padded_size(k))


def padded(rows: Rows, size: int) -> Rows:
    """The same with so many rows."""

    def longer(x: np.ndarray, fill: float) -> np.ndarray:
        return np.concatenate([x, np.full((size - len(x), *x.shape[1:]), fill, x.dtype)])

    return Rows(
        longer(rows.src, 0),
        longer(rows.dst, 0),
        longer(rows.noise_bound, 1),
        rows.cbar2,
        longer(rows.mask, 0),
    )


def padded_size(k: int) -> int:
    """The size of the programs that serve k measurements: an eighth more at most, sixteen at least."""
    step = max(8, 1 << max((k - 1).bit_length() - 3, 0))
    return max(16, -(-k // step) * step)


def certify_rows(
    rows: Rows, rotation: np.ndarray, tolerance: float, *, iterations: int, method: CertifyMethod, most: int
) -> Certificate:
    """Program by program: a proof from the closed form ends it, and most of the time does."""
    if rows.mask.sum() > most:
        return too_large(rows, rotation)

    def work() -> Certificate:
        if method == "reference":
            return jax.device_get(_published(rows, rotation, np.float64(tolerance), iterations=iterations))
        found, settled, hopeful, state = _first(rows, rotation, np.float64(tolerance))
        if not settled:
            found = go_on(state, hopeful=hopeful, iterations=iterations, method=method)
        return jax.device_get(found)

    found = at_once(work)
    return with_blocks(found, int(rows.mask.sum()) + 1)


def compile_ahead(most: int) -> None:
    """All programs that certify up to so many measurements."""

    def everything(rows: Rows) -> tuple[Certificate, Certificate]:
        state = _first(rows, np.eye(3), np.float64(1e-3))[-1]
        return _iterated(state, np.int32(0)), _bounded(state)

    three = Rows(np.eye(3), np.eye(3), np.ones(3), np.asarray(1.0), np.ones(3, bool))
    for size in sorted({padded_size(k) for k in range(1, most + 1)}):
        jax.block_until_ready(at_once(partial(everything, padded(three, size))))


def go_on(state: State, *, hopeful: Any, iterations: int, method: CertifyMethod) -> Certificate:
    """The certificate of what the closed form did not prove: a bound, and a proof where one can be had."""
    if method == "splitting" and hopeful:
        return _iterated(state, np.int32(iterations))
    return _bounded(state)


def cut(rows: Rows) -> Rows:
    """Without padding."""
    k = int(rows.mask.sum())
    return rows._replace(
        src=rows.src[:k], dst=rows.dst[:k], noise_bound=rows.noise_bound[:k], mask=rows.mask[:k]
    )


def with_blocks(found: Certificate, n: int) -> Certificate:
    """Its dual with n blocks: padding, which is zero, is cut off or added."""
    skew, diagonal = (x[:n] for x in found.dual)
    skew, diagonal, more = skew[:, :n], diagonal[: n - 1], n - len(skew)
    if more:
        skew = np.pad(skew, ((0, more), (0, more), (0, 0)))
        diagonal = np.pad(diagonal, ((0, more), (0, 0), (0, 0)))
    return replace(found, dual=Dual(skew, diagonal))


def too_large(rows: Rows, rotation: np.ndarray) -> Certificate:
    """Nothing is proved of measurements that are too many to look at; the cost is known."""
    framed = at_once(lambda: jax.device_get(_framed(rows, rotation)))
    count = np.sum(framed.measurements.mask)
    r2 = np.sum((framed.measurements.dst - framed.measurements.src) ** 2, axis=1)
    within = np.where(framed.measurements.mask, np.minimum(r2, rows.cbar2), 0).sum()
    none, false = np.float64(0), np.bool_(False)
    return Certificate(
        cost=within + framed.constant,
        lower_bound=none,
        suboptimality=np.float64(1),
        absolute_gap=(within + framed.constant) / (rows.cbar2 * max(count, 1)),
        is_optimal=false,
        is_unique=false,
        angle_bound=np.float64(np.inf),
        measurements=np.int32(count),
        iterations=np.int32(0),
        method=np.int32(CertifiedBy.NOTHING),
        status=np.int32(CertificateStatus.TOO_LARGE),
        rotation=framed.frame,
        angle=none,
        dual=Dual(np.zeros((1, 1, 6)), np.zeros((0, 4, 4))),
    )


@jax.jit
def _framed(rows: Rows, rotation: Array) -> Framed:
    return in_frame_of(rotation, **rows._asdict())


def closed_form(rows: Rows, rotation: Array, tolerance: Array) -> tuple[Certificate, Array, Array, State]:
    """The closed form: what it proves, whether that is all there is to say, whether more could be proved."""
    m, frame, constant = in_frame_of(rotation, **rows._asdict())
    claim = claim_of(m, constant, tolerance)
    attempt = direct(claim)
    found = read_off(frame, claim, attempt, -claim.shift)
    settled = attempt.proved | (found.method == CertifiedBy.ZERO_COST)
    settled |= found.status == CertificateStatus.NO_MEASUREMENTS
    hopeful = claim.possible & (found.status != CertificateStatus.UNDECIDABLE)
    return found, settled, hopeful, State(frame, claim, attempt)


_first = jax.jit(closed_form, compiler_options=QUICKLY)


@partial(jax.jit, compiler_options=QUICKLY)
def _bounded(state: State) -> Certificate:
    return read_off(*state, lowest_eigenvalue(state.claim, state.attempt))


@partial(jax.jit, compiler_options=QUICKLY)
def _iterated(state: State, iterations: Array) -> Certificate:
    attempt = iterate(state.claim, state.attempt, iterations)
    return read_off(state.frame, state.claim, attempt, lowest_if_unproved(state.claim, attempt))


@partial(jax.jit, static_argnames="iterations", compiler_options=QUICKLY)
def _published(rows: Rows, rotation: Array, tolerance: Array, *, iterations: int) -> Certificate:
    m, frame, constant = in_frame_of(rotation, **rows._asdict())
    return prove(m, frame, constant, tolerance, iterations=iterations, method="reference")
