"""The rotation by graduated non-convexity on truncated least squares (section X, TEASER++).

The cost (12) is softened by a control mu. At small mu it is nearly convex, so that the fit may start
anywhere; as mu grows round by round it stiffens, until every TIM counts fully or not at all. Residuals are in
units of their bounds throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.ground.loops import until_settled
from teaser_jax.ground.numbers import TracedNumber, count, named, number, settle
from teaser_jax.stages.rotation.tims import Rotation, Tims, Weigh


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Gnc:
    """Find the rotation by graduated non-convexity: fast, and right where most TIMs are.

    Attributes:
        factor: Growth of the control each round, traced [-].
        tolerance: Relative change of the cost that counts as none, traced [-].
        iterations: Cap on the rounds; static.
    """

    name: str = named("gnc")
    factor: TracedNumber = number(1.4, above=1)
    tolerance: TracedNumber = number(1e-6, least=0)
    iterations: int = count(100)
    needs_host: ClassVar[bool] = False

    def __post_init__(self) -> None:
        settle(self)


def gnc_rotation(tims: Tims, gnc: Gnc = Gnc(), *, cbar2: float | Float[AnyArray, ""], dtype: Any) -> Rotation:
    """Find the rotation that GNC-TLS ends at, and the TIMs that agree with it.

    The first fit uses all TIMs; if all agree with it, it is final. Otherwise they are weighed by
    ``gnc_weights``, under a control that grows round by round.

    Args:
        tims: What to fit.
        gnc: How to go on.
        cbar2: Truncation of the squared residual [-].
        dtype: Of the rotation.

    Gradients: none, the members are a choice; inputs must be stopped by the caller.

    References: Yang, Antonante, Tzoumas, Carlone, RA-L 2020 (GNC-TLS); eq. (12).
    """
    cbar2 = jnp.asarray(cbar2, dtype)

    def weigh(gnc_mu: Array) -> Weigh:
        return lambda r2: gnc_weights(r2, gnc_mu, cbar2)

    class Round(NamedTuple):
        correlation: Array
        gnc_mu: Array  # of the weights behind `correlation`; infinite: all weights 1
        cost: Array
        is_first: Array

    def one_round(state: Round) -> tuple[Round, Array]:
        # One fit a round, and only one in the program: it is what takes longest to compile.
        rotation = so3.nearest_rotation(state.correlation)
        excess = 2 * tims.largest(rotation) - cbar2
        opening = cbar2 / jnp.where(excess > 0, excess, 1)
        gnc_mu = jnp.where(state.is_first, opening, state.gnc_mu * gnc.factor)
        found = tims.measure(rotation, weigh(gnc_mu))
        still = jnp.abs(found.cost - state.cost) <= gnc.tolerance * jnp.maximum(found.cost, cbar2)
        all_agree = state.is_first & (excess <= 0)
        kept = jnp.where(all_agree, state.correlation, found.correlation)
        settled = all_agree | still | (found.soft < 0.5)
        return Round(kept, gnc_mu, found.cost, jnp.zeros((), bool)), settled

    everything = tims.measure(jnp.eye(3, dtype=dtype), jnp.ones_like).correlation
    start = Round(everything, jnp.ones((), dtype), jnp.asarray(jnp.inf, dtype), jnp.ones((), bool))
    final, settled = until_settled(one_round, start, iterations=gnc.iterations)
    rotation = so3.nearest_rotation(final.correlation)
    kept = tims.members(rotation, lambda r2: (r2 <= cbar2).astype(dtype))
    return Rotation(rotation, kept, settled)


def gnc_weights(
    r2: Float[Array, "*k"], gnc_mu: float | Float[AnyArray, ""], cbar2: float | Float[AnyArray, ""]
) -> Float[Array, "*k"]:
    """Compute the weight of each measurement under a control mu.

    It is 1 below mu/(mu+1) c^2, 0 above (mu+1)/mu c^2, and c sqrt(mu (mu+1)) / r - mu between.

    It is the derivative of ``gnc_cost`` by r^2.

    Gradients: exact in all arguments; zero where the weight is 0 or 1.

    References: Yang, Antonante, Tzoumas, Carlone, RA-L 2020 (GNC-TLS).
    """
    # Clipping reproduces both thresholds of the piecewise formula. The floor lies below the first one: it
    # changes no weight, and keeps the derivative at r = 0 finite.
    floor = jnp.maximum(0.25 * cbar2 * gnc_mu / (gnc_mu + 1), jnp.finfo(r2.dtype).tiny)
    # mu outside the root: mu^2 would overflow sooner than mu.
    return jnp.clip(gnc_mu * (jnp.sqrt((1 + 1 / gnc_mu) * cbar2 / jnp.maximum(r2, floor)) - 1), 0, 1)


def gnc_cost(
    r2: Float[Array, "*k"], gnc_mu: float | Float[AnyArray, ""], cbar2: float | Float[AnyArray, ""]
) -> Float[Array, "*k"]:
    """Compute the softened cost of each measurement under a control mu.

    It is r^2 below the first threshold of ``gnc_weights``, c^2 above the second, and
    2 c r sqrt(mu (mu+1)) - mu (c^2 + r^2) between.

    Gradients: exact and continuous in r^2.

    References: RA-L 2020 (GNC-TLS), the surrogate of the truncated cost.
    """
    low, high = cbar2 * gnc_mu / (gnc_mu + 1), cbar2 * (gnc_mu + 1) / gnc_mu
    within = jnp.clip(r2, low, high)
    between = gnc_mu * (2 * jnp.sqrt((1 + 1 / gnc_mu) * cbar2 * within) - cbar2 - within)
    return jnp.where(r2 <= low, r2, jnp.where(r2 >= high, cbar2, between))
