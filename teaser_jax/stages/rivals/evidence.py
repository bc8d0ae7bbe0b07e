"""What speaks for an answer: places that its matches join, each counted once.

Many matches in one spot, or of one point with many, are one piece of evidence. So not matches are counted
but cells of either cloud that hold some, at two radii: what lies closer counts twice.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground import bits

CELL = 2.0  # bounds


def evidence(
    r2: Float[Array, "k n"],
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
) -> Float[Array, " k"]:
    """Count what speaks for each of some answers [-].

    The sum over the radii of one and two bounds of the number of occupied cells, of the cloud that has fewer,
    and of what each inlier is nearer than its bound, 1 - r^2 / beta^2: it tells copies of one pose apart.

    Args:
        r2: Squared residuals of the matches under each answer, in squared bounds [-].
        src, dst: Clean matches about the origin [length].
        noise_bound: beta_i, above 0 [length].
        mask: Rows to use.
    """
    used = jnp.maximum(jnp.sum(mask, dtype=src.dtype), 1)
    size = CELL * jnp.sum(jnp.where(mask, noise_bound, 0)) / used
    cells = [_numbered(points, jnp.where(size > 0, size, 1), mask) for points in (src, dst)]
    total = jnp.zeros(r2.shape[0], jnp.int32)
    for radius in (1.0, 2.0):
        inliers = ((r2 <= radius**2) & mask[None]).T
        total += jnp.minimum(*(_occupied(inliers, cell) for cell in cells))
    nearer = jnp.sum(jnp.where(mask[None], jnp.maximum(1 - r2, 0), 0), axis=1)
    return total.astype(r2.dtype) + nearer


def _occupied(inliers: Bool[Array, "n k"], cell: Int[Array, " n"]) -> Int[Array, " k"]:
    """Count the cells that hold inliers of each answer."""
    return jnp.sum(jnp.zeros(inliers.shape, bool).at[cell].max(inliers), axis=0, dtype=jnp.int32)


def _numbered(
    points: Float[Array, "n 3"], size: Float[Array, ""], mask: Bool[Array, " n"]
) -> Int[Array, " n"]:
    """Number the cells that points lie in; what the mask leaves out lies in one of its own."""
    n = points.shape[0]
    place = jnp.where(mask[:, None], jnp.floor(points / size), jnp.inf).T
    *sorted_places, order = lax.sort((*place, jnp.arange(n, dtype=jnp.int32)), num_keys=3)
    fresh = jnp.stack([x[1:] != x[:-1] for x in sorted_places]).any(axis=0)
    number = bits.rank(jnp.pad(fresh, (1, 0), constant_values=True)) - 1
    return jnp.zeros(n, jnp.int32).at[order].set(number)
