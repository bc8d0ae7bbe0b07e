"""Rotation search by itself, the robust Wahba problem (12): min over R of sum_k min(|b_k - R a_k|^2, c^2).

    gnc      graduated non-convexity: milliseconds, right below some 80 % wrong measurements
    global   the same, then a search over all pairs of measurements: never worse, right beyond 90 %
    sdp      the semidefinite relaxation (23) by a conic solver: seconds, the oracle

Each ends in a certificate: what is proved of the rotation, and not what the method promises.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import QUICKLY, Rows, at_once, certify_rows, compacted
from teaser_jax.certify.proof import CertifyMethod
from teaser_jax.certify.relaxation import relaxed_rotation
from teaser_jax.certify.rotation import (
    MAX_MEASUREMENTS,
    TOLERANCE,
    as_mask,
    certify_rotation,
    check_tolerance,
    default_iterations,
)  # fmt: skip
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import is_traced
from teaser_jax.so3 import AnyArray
from teaser_jax.stages.quadratic_form import in_frame_of
from teaser_jax.stages.rotation import estimate_rotation, listed_tims
from teaser_jax.stages.rotation_global import search
from teaser_jax.stages.rotation_sdp import Relaxation
from teaser_jax.types import RotationMethod


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["rotation", "inliers", "cost", "certificate"],
    meta_fields=["relaxation"],
)
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

    rotation: Float[AnyArray, "3 3"]
    inliers: Bool[AnyArray, " k"]
    cost: Float[AnyArray, ""]
    certificate: Certificate | None = None
    relaxation: Relaxation | None = None

    def __repr__(self) -> str:
        if isinstance(self.cost, jax.core.Tracer) or np.shape(self.cost) != ():
            return f"RotationSolution(inliers of shape {np.shape(self.inliers)})"
        found = (
            f"{int(np.sum(self.inliers))} of {len(self.inliers)} measurements, cost={float(self.cost):.6g}"
        )
        return f"RotationSolution({found}, {self.certificate!r})"


def solve_rotation(
    src: Float[AnyArray, "k 3"],
    dst: Float[AnyArray, "k 3"],
    *,
    noise_bound: Any,
    method: RotationMethod = "global",
    cbar2: Any = 1.0,
    mask: Bool[AnyArray, " k"] | None = None,
    proof: CertifyMethod | None = "splitting",
    tolerance: Any = TOLERANCE,
    iterations: int | None = None,
) -> RotationSolution:
    """The rotation behind vector pairs ``dst_k ~ R src_k``, many of them wrong, and what is proved of it.

    Args:
        src, dst: Vectors, row k with row k [length]; rows that are not finite are left out.
        noise_bound: delta_k, the bound of the vectors as they are given, one or (k,) [length].
        method: ``"gnc"``, ``"global"`` or ``"sdp"``; the last needs the extra ``sdp``, runs outside jit only
            and takes up to 100 measurements: 2, 8 and 50 seconds for 20, 30 and 50.
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

    References: Yang, Shi, Carlone, T-RO 2020, section VIII, (12), (19), (23), Theorem 13; GNC: Yang,
    Antonante, Tzoumas, Carlone, RA-L 2020.
    """
    if method not in ("gnc", "global", "sdp"):
        raise ValueError(f"method is {method!r}: expected 'gnc', 'global' or 'sdp'.")
    if proof not in (None, "splitting", "direct", "reference"):
        raise ValueError(f"proof is {proof!r}: expected 'splitting', 'direct', 'reference' or None.")
    if np.shape(src) != np.shape(dst) or np.ndim(src) != 2 or np.shape(src)[1] != 3:
        raise ValueError(
            f"src and dst have shapes {np.shape(src)} and {np.shape(dst)}: expected (k, 3) both, rows are "
            "measurements."
        )
    k = np.shape(src)[0]
    mask = np.ones(k, bool) if mask is None else mask
    rounds = default_iterations(k) if iterations is None else whole_number("iterations", iterations, 0)
    if any(np.iscomplexobj(x) for x in (src, dst) if not is_traced(x)):
        raise ValueError("src and dst are real; complex numbers were received.")
    if is_traced(src, dst, noise_bound, cbar2, mask, tolerance):
        mask = as_mask(mask, (k,))
        # Rows of zeros that are masked: programs want something to look at.
        grown = (0, max(0, 2 - k))
        src, dst = (jnp.pad(jnp.asarray(x), (grown, (0, 0))) for x in (src, dst))
        src, dst = (x.astype(jnp.promote_types(x.dtype, jnp.float32)) for x in (src, dst))
        noise_bound = jnp.pad(jnp.broadcast_to(jnp.asarray(noise_bound), (k,)), grown, constant_values=1)
        mask = jnp.pad(mask, grown)
        if method == "sdp":
            raise ValueError("method='sdp' calls a conic solver and runs outside jit only: take 'global'.")
        src, dst, noise_bound, cbar2 = lax.stop_gradient((src, dst, noise_bound, cbar2))
        found = _search(src, dst, noise_bound, cbar2, mask, method=method)
        if proof is not None:
            certificate = certify_rotation(
                src, dst, found.rotation,
                noise_bound=noise_bound, cbar2=cbar2, mask=mask, tolerance=tolerance, iterations=rounds,
                method=proof,
            )  # fmt: skip
            found = replace(found, certificate=certificate)
        return replace(found, inliers=found.inliers[:k])
    rows, tolerance = compacted(src, dst, noise_bound, cbar2, mask), check_tolerance(tolerance)
    found = at_once(lambda: jax.device_get(_compiled(rows, method="gnc" if method == "gnc" else "global")))
    if method == "sdp":
        found = _by_relaxation(rows, found, tolerance, proof, rounds)
    elif proof is not None:
        certificate = certify_rows(
            rows, found.rotation, tolerance, iterations=rounds, method=proof, most=MAX_MEASUREMENTS
        )
        found = replace(found, certificate=certificate)
    inliers = np.zeros(k, bool)
    inliers[np.flatnonzero(mask)] = found.inliers[: int(rows.mask.sum())]
    return replace(found, inliers=inliers)


@partial(jax.jit, static_argnames="method", compiler_options=QUICKLY)
def _compiled(rows: Rows, *, method: Literal["gnc", "global"]) -> RotationSolution:
    return _search(**rows._asdict(), method=method)


def _search(
    src: Any, dst: Any, noise_bound: Any, cbar2: Any, mask: Any, *, method: Literal["gnc", "global"]
) -> RotationSolution:
    src, dst = jnp.asarray(src), jnp.asarray(dst)
    dtype, eye = src.dtype, jnp.eye(3, dtype=src.dtype)
    m, _, constant = in_frame_of(eye, src, dst, noise_bound=noise_bound, cbar2=cbar2, mask=mask, dtype=dtype)
    tims = listed_tims(m.src, m.dst, jnp.ones(len(m.src), dtype), m.mask)
    rotation = estimate_rotation(tims, cbar2=m.cbar2, dtype=dtype).rotation
    if method == "global":
        rotation = jnp.matmul(rotation, search(m.turned(rotation)), precision=lax.Precision.HIGHEST)
    r2 = jnp.sum((dst - so3.rotate(rotation, src)) ** 2, axis=1)
    return RotationSolution(
        rotation, mask & (r2 <= cbar2 * noise_bound**2), m.turned(rotation).cost + constant
    )


def _by_relaxation(
    rows: Rows, start: RotationSolution, tolerance: float, proof: CertifyMethod | None, rounds: int
) -> RotationSolution:
    found = relaxed_rotation(rows, start.rotation, tolerance)
    certificate = found.certificate if proof is not None else None
    if certificate is not None and proof is not None and not certificate.is_optimal:
        other = certify_rows(
            rows, found.rotation, tolerance, iterations=rounds, method=proof, most=MAX_MEASUREMENTS
        )
        certificate = min(certificate, other, key=lambda c: (not c.is_optimal, float(c.suboptimality)))
    r2 = np.sum((rows.dst - rows.src @ found.rotation.T) ** 2, axis=1)
    inliers = rows.mask & (r2 <= rows.cbar2 * rows.noise_bound**2)
    return RotationSolution(found.rotation, inliers, np.float64(found.cost), certificate, found.relaxation)
