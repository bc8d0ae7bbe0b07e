"""The translation, one axis at a time (section VI-C)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.stages.vote.sweep import Criterion, vote


def estimate_translation(
    offsets: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    cbar2: Float[Array, ""],
    criterion: Criterion = "tls",
) -> tuple[Float[Array, "3"], Bool[Array, "n 3"]]:
    """Estimate the TLS translation of each axis (13), and find the points that agree with it.

    Runs in float64 whatever the dtype of the offsets.

    Args:
        offsets: b_i - s R a_i [length].
        noise_bound: beta_i [length].
        mask: Points that vote.

    Gradients: none, the set is a choice. ``translation_of_points`` is the differentiable read-out.

    References: eq. (13), Algorithm 1 line 10.
    """
    dtype = offsets.dtype
    offsets, noise_bound, cbar2 = lax.stop_gradient((offsets, noise_bound, cbar2))
    with jax.enable_x64(True):
        values, bounds, cbar2 = (x.astype(jnp.float64) for x in (offsets, noise_bound, cbar2))
        won = jax.vmap(
            lambda axis: vote(axis, bounds, mask=mask, cbar2=cbar2, criterion=criterion),
            in_axes=1,
        )(values)
        return won.estimate.astype(dtype), won.members.T


def translation_of_points(
    offsets: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    confidence: Float[Array, " n"],
    chosen: Bool[Array, "n 3"],
) -> Float[Array, "3"]:
    """Compute the weighted mean of each axis over its chosen points, weights confidence / beta^2.

    An axis without points gets 0. Gradients: exact.
    """
    weight = jnp.where(chosen, (confidence / noise_bound**2)[:, None], 0)
    total = jnp.sum(weight, axis=0)
    return jnp.sum(weight * offsets, axis=0) / jnp.where(total > 0, total, 1)
