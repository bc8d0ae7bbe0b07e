"""What is proved of a rotation: the certificate and its words."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.certify.dual import Dual
from teaser_jax.ground.arrays import AnyArray, Placeholder
from teaser_jax.ground.numbers import NamedNumber


class CertificateStatus(NamedNumber):
    """What a certificate came to. Held as int32 inside JAX."""

    OPTIMAL = 0
    UNKNOWN = 1
    SUBOPTIMAL = 2
    UNDECIDABLE = 3
    TOO_LARGE = 4
    NO_MEASUREMENTS = 5

    @property
    def advice(self) -> str:
        """One sentence that says what is proved, and what to try."""
        return _ADVICE[self]


_ADVICE = {
    CertificateStatus.OPTIMAL: "No rotation fits these measurements better, beyond the stated gap.",
    CertificateStatus.UNKNOWN: (
        "Neither proved nor refuted: the rotation may still be the best. Measurements whose residual is near "
        "the bound, or very many wrong ones, do that; more iterations may help."
    ),
    CertificateStatus.SUBOPTIMAL: (
        "A better rotation for these measurements is known: Certificate.rotation holds it."
    ),
    CertificateStatus.UNDECIDABLE: (
        "The gap asked for is below what float64 resolves for these measurements: their noise bounds are "
        "tiny against their lengths; ask for a larger tolerance."
    ),
    CertificateStatus.TOO_LARGE: (
        "More measurements than max_measurements: raise it, or certify outside jit, where it is 1000."
    ),
    CertificateStatus.NO_MEASUREMENTS: "There is nothing to certify: no usable measurement.",
}


class CertifiedBy(NamedNumber):
    """How the lower bound of a certificate was found. Held as int32 inside JAX."""

    NOTHING = 0
    ZERO_COST = 1
    DIRECT = 2
    SPLITTING = 3
    REFERENCE = 4
    RELAXATION = 5


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Certificate:
    """What is proved of a rotation, given its measurements. False until proved.

    Fields are numpy's where the certificate was made on the host and JAX's under jit; of a stack of problems
    each has a leading axis.

    Attributes:
        cost: Truncated least squares cost of the rotation that was given [-].
        lower_bound: No rotation costs less: proved [-].
        suboptimality: (cost - lower_bound) / cost: no rotation saves more than this share [-]. It is what
            was proved, most of the time just the tolerance; 0 where the cost is below a millionth of c-bar
            squared.
        absolute_gap: cost - lower_bound over the cost of calling everything an outlier [-].
        is_optimal: Whether the suboptimality is within the tolerance, or the gap below a millionth of c-bar
            squared: relative gaps of costs near zero say nothing.
        is_unique: Whether no other rotation costs as little as the polished one.
        angle_bound: Every rotation that costs no more lies within this angle; infinite: none follows [rad].
        measurements: How many were certified; those of no length, which no rotation changes, are not counted.
        iterations: Rounds of the splitting, or of the conic solver.
        method: A ``CertifiedBy`` as int32.
        status: A ``CertificateStatus`` as int32.
        rotation: The given rotation after polishing, which makes it least squares on its own inliers.
        angle: How far the polished rotation lies from the given one [rad].
        dual: The proof: with the measurements and ``rotation`` it can be checked by ``verify``.
        inlier_gap: No pose explains more than so many matches beyond this one's; None without a clique.
        explained_gap: (cost - cost of a pose that explains as many as the clique's bound allows, with no
            residual) / the cost of these. 0: it explains all there is, exactly; 1: nothing. None without a
            clique.
    """

    cost: Float[AnyArray, "..."] | Placeholder
    lower_bound: Float[AnyArray, "..."] | Placeholder
    suboptimality: Float[AnyArray, "..."] | Placeholder
    absolute_gap: Float[AnyArray, "..."] | Placeholder
    is_optimal: Bool[AnyArray, "..."] | Placeholder
    is_unique: Bool[AnyArray, "..."] | Placeholder
    angle_bound: Float[AnyArray, "..."] | Placeholder
    measurements: Int[AnyArray, "..."] | Placeholder
    iterations: Int[AnyArray, "..."] | Placeholder
    method: Int[AnyArray, "..."] | Placeholder
    status: Int[AnyArray, "..."] | Placeholder
    rotation: Float[AnyArray, "... 3 3"] | Placeholder
    angle: Float[AnyArray, "..."] | Placeholder
    dual: Dual
    inlier_gap: Int[AnyArray, "..."] | Placeholder | None = None
    explained_gap: Float[AnyArray, "..."] | Placeholder | None = None

    def __repr__(self) -> str:
        if isinstance(self.status, jax.core.Tracer) or np.shape(self.status) != ():
            return f"Certificate(status={self.status!r})"
        status, by = CertificateStatus(int(self.status)), CertifiedBy(int(self.method))
        return (
            f"Certificate({status.name}, suboptimality <= {float(self.suboptimality):.3g}, "
            f"by {by.name.lower()}, iterations={int(self.iterations)})"
        )
