"""Rotation search by itself, the robust Wahba problem (12): min over R of sum_k min(|b_k - R a_k|^2, c^2).

    gnc      graduated non-convexity: milliseconds, right below some 80 % wrong measurements
    global   the same, then a search over all pairs of measurements: never worse, right beyond 90 %
    sdp      the semidefinite relaxation (23) by a conic solver: seconds, the oracle

Each ends in a certificate: what is proved of the rotation, and not what the method promises.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import QUICKLY, certify_on_host, in_float64
from teaser_jax.certify.host_measurements import HostMeasurements, comparable, read_measurements
from teaser_jax.certify.options import MAX_MEASUREMENTS, TOLERANCE, CertifyMethod, Options, checked_options
from teaser_jax.certify.relaxation import relaxed_rotation
from teaser_jax.certify.traced import certify_traced, traced_mask
from teaser_jax.ground.arrays import AnyArray, Placeholder, at_least_float32, is_traced
from teaser_jax.ground.checks import one_of
from teaser_jax.ground.numbers import as_record
from teaser_jax.reading import real_numbers
from teaser_jax.settings import ROTATIONS, RotationMethod, check_record
from teaser_jax.stages.rotation.gnc import Gnc, gnc_rotation
from teaser_jax.stages.rotation.pair_search import PairSearch
from teaser_jax.stages.rotation.quadratic_form import in_frame_of
from teaser_jax.stages.rotation.relaxation import Relaxation, RelaxationReport
from teaser_jax.stages.rotation.tims import listed_tims


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class RotationSolution:
    """The answer of ``solve_rotation``.

    Attributes:
        rotation: R with dst_k ~ R src_k; the identity where nothing could be used.
        inliers: Measurements within their bounds, in the user's order.
        cost: The truncated cost (12) in units of the bounds [-].
        certificate: What is proved of the rotation; None if no proof was asked for.
        relaxation: What the conic solver said, for ``method="sdp"``.
    """

    rotation: Float[AnyArray, "... 3 3"] | Placeholder
    inliers: Bool[AnyArray, "... k"] | Placeholder
    cost: Float[AnyArray, "..."] | Placeholder
    certificate: Certificate | None = None
    relaxation: RelaxationReport | None = field(default=None, metadata=dict(static=True))

    def __repr__(self) -> str:
        if isinstance(self.cost, jax.core.Tracer) or np.shape(self.cost) != ():
            return f"RotationSolution(inliers of shape {np.shape(self.inliers)})"
        found = (
            f"{int(np.sum(self.inliers))} of {len(self.inliers)} measurements, cost={float(self.cost):.6g}"
        )
        return f"RotationSolution({found}, {self.certificate!r})"


def solve_rotation(
    src: Any,
    dst: Any,
    *,
    noise_bound: Any,
    method: RotationMethod | str = "global",
    cbar2: Any = 1.0,
    mask: Any = None,
    proof: CertifyMethod | None = "splitting",
    tolerance: Any = TOLERANCE,
    iterations: int | np.integer | None = None,
) -> RotationSolution:
    """Find the rotation behind vector pairs ``dst_k ~ R src_k``, many of them wrong, and prove what can be.

    Args:
        src, dst: (k, 3) vectors, row k with row k [length]; rows that are not finite are left out.
        noise_bound: delta_k, the bound of the vectors as they are given, one or (k,) [length]. Inside jit,
            rows too large or too small to be squared and compared are left out.
        method: ``"gnc"``, ``"global"`` or ``"sdp"``, or the record that one of them stands for
            (``teaser_jax.settings.Gnc``, ``PairSearch``, ``Relaxation``). The last needs the extra ``sdp``,
            runs outside jit only and takes up to 100 measurements: 2, 8 and 50 seconds for 20, 30 and 50.
        cbar2: Truncation, c-bar squared [-].
        mask: (k,) rows to use.
        proof: How to certify, see ``certify_rotation``; None: not at all. Under vmap take ``"direct"``
            or None.
        tolerance, iterations: Of the certificate.

    Returns:
        A ``RotationSolution``. Outside jit everything is computed in float64; inside, the rotation follows
        the input's dtype and the proof is made in float64.

    Raises:
        ValueError: Shapes that do not fit, bounds not above 0, an unknown method, ``"sdp"`` inside jit or for
            too many measurements.
        ImportError: ``"sdp"`` without the extra.

    Gradients: none, inputs are stopped. ``refit`` has the derivative on chosen measurements.

    References: Yang, Shi, Carlone, T-RO 2021, section VIII, (12), (19), (23), Theorem 13; GNC: Yang,
    Antonante, Tzoumas, Carlone, RA-L 2020.
    """
    chosen: RotationMethod = as_record("method", method, ROTATIONS)
    check_record("method", chosen, ROTATIONS)
    one_of("proof", proof, (*get_args(CertifyMethod), None))
    src, dst = real_numbers(src, "src"), real_numbers(dst, "dst")
    _check_vectors(src, dst)
    options = checked_options(tolerance, iterations, proof or "splitting", MAX_MEASUREMENTS)
    mask = np.ones(np.shape(src)[0], bool) if mask is None else mask
    known = dict(noise_bound=noise_bound, cbar2=cbar2, mask=mask)
    how = _traced if is_traced(src, dst, *known.values(), tolerance) else _on_host
    return how(src, dst, **known, method=chosen, options=options, certified=proof is not None)


def _check_vectors(src: Any, dst: Any) -> None:
    """Raise ValueError unless the vectors are (k, 3) both."""
    if np.shape(src) != np.shape(dst) or np.ndim(src) != 2 or np.shape(src)[1] != 3:
        raise ValueError(
            f"src and dst have shapes {np.shape(src)} and {np.shape(dst)}: expected (k, 3) both, rows are "
            "measurements."
        )


def _check_sizes(m: HostMeasurements) -> None:
    """Raise ValueError for finite rows that are too large or too small to be squared and compared."""
    finite = m.mask & np.isfinite(m.src).all(axis=1) & np.isfinite(m.dst).all(axis=1)
    for row in np.flatnonzero(finite & ~comparable(m.src, m.dst, m.noise_bound))[:1]:
        reach = max(np.abs(m.src[row]).max(), np.abs(m.dst[row]).max())
        raise ValueError(
            f"vectors reach {reach:.3g} with a noise_bound of {m.noise_bound[row]:.3g}, beyond what float64 "
            "can square and compare: rescale all to a sensible unit."
        )


def _traced(
    src: Any, dst: Any, *, noise_bound: Any, cbar2: Any, mask: Any,
    method: RotationMethod, options: Options, certified: bool,
) -> RotationSolution:  # fmt: skip
    """Find the rotation in the program that is being traced."""
    if method.needs_host:
        raise ValueError("method='sdp' calls a conic solver and runs outside jit only: take 'global'.")
    k = np.shape(src)[0]
    # Rows of zeros that are masked: programs want something to look at.
    grown = (0, max(0, 2 - k))
    mask = jnp.pad(traced_mask(mask, (k,)), grown)
    src, dst = (jnp.pad(at_least_float32(x), (grown, (0, 0))) for x in (src, dst))
    noise_bound = jnp.pad(jnp.broadcast_to(jnp.asarray(noise_bound), (k,)), grown, constant_values=1)
    src, dst, noise_bound, cbar2 = lax.stop_gradient((src, dst, noise_bound, cbar2))
    mask &= comparable(src, dst, noise_bound)
    found = _search(src, dst, noise_bound, cbar2, mask, method)
    if certified:
        certificate = certify_traced(
            src, dst, found.rotation,
            noise_bound=noise_bound, cbar2=cbar2, mask=mask, options=options, rounds=options.rounds(k),
        )  # fmt: skip
        found = replace(found, certificate=certificate)
    return replace(found, inliers=found.inliers[:k])


def _on_host(
    src: Any, dst: Any, *, noise_bound: Any, cbar2: Any, mask: Any,
    method: RotationMethod, options: Options, certified: bool,
) -> RotationSolution:  # fmt: skip
    """Find the rotation outside jit, in float64."""
    k = np.shape(src)[0]
    measurements = read_measurements(src, dst, noise_bound, cbar2, mask)
    _check_sizes(measurements)
    rounds = options.rounds(k)
    # What runs on the host starts from a good rotation of the device's.
    first = PairSearch(gnc=method.gnc) if isinstance(method, Relaxation) else method
    found = in_float64(lambda: jax.device_get(_searched(measurements, first)))
    if method.needs_host:
        found = _by_relaxation(measurements, found, options, rounds=rounds, certified=certified)
    elif certified:
        certificate = certify_on_host(measurements, found.rotation, options, rounds=rounds)
        found = replace(found, certificate=certificate)
    inliers = np.zeros(k, bool)
    inliers[np.flatnonzero(mask)] = found.inliers[: measurements.measured]
    return replace(found, inliers=inliers)


@partial(jax.jit, compiler_options=QUICKLY)
def _searched(measurements: HostMeasurements, method: RotationMethod) -> RotationSolution:
    """Search for the rotation in one compiled program."""
    return _search(**measurements._asdict(), method=method)


def _search(
    src: Float[Array, "k 3"], dst: Float[Array, "k 3"], noise_bound: Any, cbar2: Any, mask: Any,
    method: RotationMethod,
) -> RotationSolution:  # fmt: skip
    """Find a rotation by graduated non-convexity, and turn it as the method asks."""
    dtype, eye = src.dtype, jnp.eye(3, dtype=src.dtype)
    m, _, constant = in_frame_of(eye, src, dst, noise_bound=noise_bound, cbar2=cbar2, mask=mask, dtype=dtype)
    listed = listed_tims(m.src, m.dst, jnp.ones(len(m.src), dtype), m.mask)
    gnc = method if isinstance(method, Gnc) else method.gnc
    rotation = gnc_rotation(listed, gnc, cbar2=m.cbar2, dtype=dtype).rotation
    if not isinstance(method, Gnc):
        turn = method.turn(m.turned(rotation))
        rotation = jnp.matmul(rotation, turn, precision=lax.Precision.HIGHEST)
    r2 = jnp.sum((dst - so3.rotate(rotation, src)) ** 2, axis=1)
    inliers = mask & (r2 <= cbar2 * noise_bound**2)
    return RotationSolution(rotation, inliers, m.turned(rotation).cost + constant)


def _by_relaxation(
    measurements: HostMeasurements, start: RotationSolution, options: Options, *, rounds: int, certified: bool
) -> RotationSolution:
    """Solve the relaxation from a good rotation; of its own certificate and ours the better one counts."""
    found = relaxed_rotation(measurements, start.rotation, float(options.tolerance))
    certificate = found.certificate if certified else None
    if certificate is not None and not certificate.is_optimal:
        other = certify_on_host(measurements, found.rotation, options, rounds=rounds)
        certificate = min(certificate, other, key=lambda c: (not c.is_optimal, float(c.suboptimality)))
    r2 = np.sum((measurements.dst - measurements.src @ found.rotation.T) ** 2, axis=1)
    inliers = measurements.mask & (r2 <= measurements.cbar2 * measurements.noise_bound**2)
    return RotationSolution(found.rotation, inliers, np.float64(found.cost), certificate, found.relaxation)
