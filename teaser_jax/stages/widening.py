"""How far the fit itself may carry a right match beyond its bound.

A bound says how far a match lies from the true pose. The fit is not the true pose: with few matches, right
ones at the bound fall out of its reach, and each that is lost makes it worse. So the graph, the cost and all
that follows use bounds that are wider by what the fit is uncertain of. That is about one and a half bounds
over the square root of the number of right matches, and how many these may be a few rows of the graph tell.
"""

from __future__ import annotations

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.stages.consistency import lengths_agree
from teaser_jax.stages.pairs import tim_bounds, tims, usable_pairs

# From 1.5 on the answer is as good as least squares on the right matches (errors uniform in a ball of the
# bound: 1.02 times its error; without widening 1.6 times). Wider ones let more wrong matches in.
SHARE = 1.5
PIVOTS = 32  # matches whose neighbours are counted
FEWEST = 4


def bound_widening(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    scale: Float[Array, ""],
    cbar2: Float[Array, ""],
    pairs: Int[Array, "m 2"] | None = None,
) -> Float[Array, ""]:
    """Find by how much to widen the bounds: 1 + 1.5 / sqrt(m), for about m right matches.

    m is the largest number of matches that agree with one of 32: at least the right ones, where there is
    one of them. Of given pairs it is estimated from the share that agrees.

    Args:
        src, dst: Clean matches, row i with row i [length].
        noise_bound: beta_i [length of the target].
        mask: Rows to use.
        scale: Known or voted [-].
        cbar2: Truncation [-].
        pairs: Index pairs to compare, or None: all.

    Returns:
        A factor between 1 and 1.75 [-].

    Gradients: none, inputs are stopped.
    """
    src, dst, noise_bound, scale, cbar2 = lax.stop_gradient((src, dst, noise_bound, scale, cbar2))
    scaled, reach = scale * src, jnp.sqrt(cbar2) * noise_bound
    if pairs is None:
        pivots = _spread(mask)
        a2, b2 = (sum((x[pivots, None, k] - x[None, :, k]) ** 2 for k in range(3)) for x in (scaled, dst))
        agree = lengths_agree(jnp.asarray(a2), jnp.asarray(b2), reach[pivots, None] + reach[None])
        agree &= mask[pivots, None] & mask[None]
        right = jnp.max(jnp.sum(agree, axis=1, dtype=jnp.int32), initial=0).astype(src.dtype)
    else:
        usable = usable_pairs(pairs, mask)
        a2, b2 = (jnp.sum(tims(x, pairs) ** 2, axis=1) for x in (scaled, dst))
        agree = usable & lengths_agree(a2, b2, tim_bounds(reach, pairs))
        counts = [jnp.sum(x, dtype=jnp.int32).astype(src.dtype) for x in (agree, usable, mask)]
        right = counts[2] * jnp.sqrt(counts[0] / jnp.maximum(counts[1], 1))
    return 1 + SHARE / jnp.sqrt(jnp.maximum(right, FEWEST))


def _spread(mask: Bool[Array, " n"]) -> Int[Array, " k"]:
    """Choose rows all over those that can be used, which come first."""
    n = mask.shape[0]
    count, most = jnp.sum(mask, dtype=jnp.int32), min(n, PIVOTS)
    # A product with n would not fit into 32 bits for millions of rows.
    return jnp.minimum((jnp.arange(most, dtype=jnp.float32) * (count / most)).astype(jnp.int32), n - 1)
