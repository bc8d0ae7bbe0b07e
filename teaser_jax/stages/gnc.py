"""Graduated non-convexity: truncated least squares, softened by a control mu (section VIII).

At small mu the cost is nearly convex, as mu grows it stiffens into the truncated cost. Residuals
are in units of their bounds throughout.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def gnc_weights(
    r2: Float[Array, "*k"], gnc_mu: Float[Array, ""], cbar2: Float[Array, ""]
) -> Float[Array, "*k"]:
    """1 below mu/(mu+1) c^2, 0 above (mu+1)/mu c^2, and c sqrt(mu (mu+1)) / r - mu between.

    The derivative of ``gnc_cost`` by r^2.

    Gradients: exact in all arguments; zero where the weight is 0 or 1.

    References: Yang, Antonante, Tzoumas, Carlone, RA-L 2020 (GNC-TLS).
    """
    # Clipping reproduces both thresholds of the piecewise formula. The floor lies below the first one: it
    # changes no weight, and keeps the derivative at r = 0 finite.
    floor = jnp.maximum(0.25 * cbar2 * gnc_mu / (gnc_mu + 1), jnp.finfo(r2.dtype).tiny)
    # mu outside the root: mu^2 would overflow sooner than mu.
    return jnp.clip(gnc_mu * (jnp.sqrt((1 + 1 / gnc_mu) * cbar2 / jnp.maximum(r2, floor)) - 1), 0, 1)


def gnc_cost(r2: Float[Array, "*k"], gnc_mu: Float[Array, ""], cbar2: Float[Array, ""]) -> Float[Array, "*k"]:
    """r^2 below the first threshold, c^2 above the second, 2 c r sqrt(mu (mu+1)) - mu (c^2 + r^2) between.

    Gradients: exact and continuous in r^2.

    References: RA-L 2020 (GNC-TLS), the surrogate of the truncated cost.
    """
    low, high = cbar2 * gnc_mu / (gnc_mu + 1), cbar2 * (gnc_mu + 1) / gnc_mu
    within = jnp.clip(r2, low, high)
    between = gnc_mu * (2 * jnp.sqrt((1 + 1 / gnc_mu) * cbar2 * within) - cbar2 - within)
    return jnp.where(r2 <= low, r2, jnp.where(r2 >= high, cbar2, between))
