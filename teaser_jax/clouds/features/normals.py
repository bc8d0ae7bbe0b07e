"""The direction across the surface at each point."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from teaser_jax.clouds.neighbours import Neighbours
from teaser_jax.ground.arrays import AnyArray, Number, namespace

FEWEST = 5  # points that make a surface, with the one in the middle


def normals(
    points: Float[Array, "n 3"],
    neighbours: Neighbours,
    radius: Float[Array, ""] | Number,
    viewpoint: Float[Array, "3"] | None = None,
) -> Float[Array, "n 3"]:
    """Compute the unit normal of the surface at each point: the direction in which its neighbours vary least.

    Works under jit and vmap.

    Args:
        points: About their middle [length].
        neighbours: Of each point.
        radius: Neighbours within it count [length].
        viewpoint: Where the sensor stood; normals then point towards it. None: either way, as no one
            can tell; the descriptors turn them by themselves.

    Returns:
        Unit vectors; zero where fewer than five points lie within the radius, or all on a line.

    Gradients: none worth having where two directions vary alike.
    """
    apart = points[neighbours.rows] - points[:, None]
    return oriented(across(apart, neighbours.squared, radius), points, viewpoint)


@jax.jit
def across(
    apart: Float[Array, "n k 3"], squared: Float[Array, "n k"], radius: Float[Array, ""] | Number
) -> Float[Array, "n 3"]:
    """Compute the direction across each neighbourhood, either way.

    Args:
        apart: From the point in the middle to its neighbours [length].
        squared: How far they are, squared; infinity: there is none.
        radius: Neighbours within it count [length].
    """
    near = (squared <= radius**2) & (squared > 0)
    count = 1 + jnp.sum(near, axis=1, dtype=jnp.int32)
    weight = near.astype(apart.dtype) / count[:, None].astype(apart.dtype)
    mean = jnp.sum(weight[..., None] * apart, axis=1)
    moments = jnp.einsum("nk,nki,nkj->nij", weight, apart, apart, precision=jax.lax.Precision.HIGHEST)
    spread = moments - mean[:, :, None] * mean[:, None, :]
    # In units of the neighbourhood, or float32 would lose small ones.
    size = jnp.trace(spread, axis1=1, axis2=2)
    values, axes = jnp.linalg.eigh(spread / jnp.where(size > 0, size, 1)[:, None, None])
    is_surface = (count >= FEWEST) & (values[:, 1] > 1e-4)
    return jnp.where(is_surface[:, None], axes[:, :, 0], 0)


def oriented(
    normals: Float[AnyArray, "n 3"], points: Float[AnyArray, "n 3"], viewpoint: Float[AnyArray, "3"] | None
) -> Float[AnyArray, "n 3"]:
    """Turn normals towards a viewpoint; None: leave them as they are."""
    if viewpoint is None:
        return normals
    xp = namespace(normals)
    away = xp.sum(normals * (points - viewpoint[None]), axis=1) > 0
    return xp.where(away[:, None], -normals, normals)
