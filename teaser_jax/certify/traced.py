"""Certificates under jit and vmap: all steps in one program of the size of its input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.options import Options
from teaser_jax.certify.proof import prove
from teaser_jax.ground.arrays import float32_or_wider
from teaser_jax.stages.rotation.quadratic_form import in_frame_of


def certify_traced(
    src: Any,
    dst: Any,
    rotation: Any,
    *,
    noise_bound: Any,
    cbar2: Any,
    mask: Any,
    options: Options,
    rounds: int,
) -> Certificate:
    """Certify one rotation in the program that is being traced, in float64 whatever it computes in.

    Args:
        src, dst, rotation, noise_bound, cbar2, mask: See ``certify_rotation``.
        options: How to certify.
        rounds: Cap on rounds of the splitting.

    Raises:
        ValueError: More measurements than the options allow, or a mask of another shape.
    """
    k, most = len(src), options.max_measurements
    if k > most:
        raise ValueError(f"{k} measurements are more than max_measurements, {most}.")
    dtype = float32_or_wider(jnp.result_type(src))
    mask = traced_mask(mask, (k,))
    src, dst, rotation, noise_bound, cbar2 = lax.stop_gradient((src, dst, rotation, noise_bound, cbar2))
    with jax.enable_x64(True):
        m, frame, constant = in_frame_of(rotation, src, dst, noise_bound=noise_bound, cbar2=cbar2, mask=mask)
        found = prove(m, frame, constant, options.tolerance, iterations=rounds, method=options.method)
        return _narrowed(found, dtype)


def traced_mask(mask: Any, shape: tuple[int, ...]) -> Bool[Array, " k"]:
    """Read the mask of traced measurements; ValueError if it is not one value a row."""
    mask = jnp.asarray(mask)
    if mask.shape != shape:
        raise ValueError(f"mask has shape {mask.shape}: expected {shape}.")
    return mask.astype(bool)


def _narrowed(found: Certificate, dtype: Any) -> Certificate:
    """Convert a certificate to the input's dtype, as JAX may have no float64 outside; round claims down."""

    def narrow(x: Array) -> Array:
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    found = jax.tree.map(narrow, found)
    if dtype == jnp.float64:
        return found
    eps = 2 * jnp.finfo(dtype).eps
    return replace(
        found,
        lower_bound=found.lower_bound * (1 - eps),
        suboptimality=found.suboptimality + eps,
        absolute_gap=found.absolute_gap + eps,
    )
