"""Whether matches were made by position: each point with its nearest neighbour in the frames as given.

Such matches agree on hardly any motion at all, whatever the motion was: a point and what lies nearest to it
look like a match of a cloud that stands still. What gives them away are the matches that the pose does not
explain. Of descriptors these are wrong, and lie anywhere; of nearest neighbours they are nearest
neighbours, too.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray

FEWEST = 20  # matches unexplained, below which there is no evidence
ASKED, FEWEST_HEARD = 24, 8  # of them, and without those that share a point
# A match is near if so few of the other points, or so small a share of them, lie nearer. Of real descriptor
# matches in aligned clouds 0.3 at most of the unexplained are near, of nearest neighbours nearly all.
FEW, SMALL_SHARE = 3, 0.01
MOST_NEAR = 0.75
FAR = 3.0  # bounds: right matches of a bound too small lie nearer


def matched_by_position(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    r2: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    cbar2: Float[Array, ""],
    offset: Float[AnyArray, "3"] | None = None,
) -> Bool[Array, ""]:
    """Tell whether the matches that a pose does not explain are nearest neighbours as given.

    Some of them are asked, of those that lie far from the pose if these are enough. Chance makes one in a
    hundred near.

    Args:
        src, dst: Clean matches, row i with row i [length].
        r2: Their squared residuals under the pose, in squared bounds [-].
        mask: Rows to use.
        cbar2: Truncation [-].
        offset: What to add to a source, as both stand here, to compare it with a target in the frames as
            given; None: nothing.

    Gradients: none; inputs must be stopped by the caller.
    """
    n = mask.shape[0]
    if n < FEWEST:
        return jnp.zeros((), bool)
    unexplained, far = mask & (r2 > cbar2), mask & (r2 > FAR**2 * cbar2)
    chosen = jnp.where(jnp.sum(far, dtype=jnp.int32) >= FEWEST, far, unexplained)
    count = jnp.sum(chosen, dtype=jnp.int32)
    asked = bits.listed(chosen)[: min(n, ASKED)]
    given = src if offset is None else src + offset[None]
    usable = jnp.sum(mask, dtype=jnp.int32).astype(src.dtype)
    few = jnp.maximum(FEW, SMALL_SHARE * usable)
    near = jnp.zeros(len(asked), bool)
    for here, there in ((given, dst), (dst, given)):
        # |c - a|^2 < |b - a|^2 of a match (a, b) and a point c, without their digits where a is far away.
        aside = [there[None, :, k] - there[asked, None, k] for k in range(3)]
        apart = [there[asked, None, k] - here[asked, None, k] for k in range(3)]
        excess = jnp.asarray(sum(x * (x + 2 * y) for x, y in zip(aside, apart, strict=True)))
        nearer = jnp.sum(mask[None] & ~(excess >= 0), axis=1, dtype=jnp.int32)
        near |= nearer.astype(src.dtype) <= few
    # Points that many matches share are asked once: all matches that lead to one point lead to the nearest.
    index = jnp.arange(len(asked), dtype=jnp.int32)
    fresh = (index < count) & ~_seen_before(src[asked]) & ~_seen_before(dst[asked])
    heard, hits = (jnp.sum(x, dtype=jnp.int32).astype(src.dtype) for x in (fresh, fresh & near))
    return (count >= FEWEST) & (heard >= FEWEST_HEARD) & (hits >= MOST_NEAR * heard)


def _seen_before(points: Float[Array, "k 3"]) -> Bool[Array, " k"]:
    """Tell which points equal an earlier one."""
    equal = jnp.all(points[:, None] == points[None], axis=2)
    return jnp.any(equal & np.tri(len(points), k=-1, dtype=bool), axis=1)
