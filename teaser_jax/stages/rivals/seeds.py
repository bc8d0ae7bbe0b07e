"""Where answers start: matches with the matches that agree with them and with one another.

A right match agrees on lengths with all right ones, and these agree among themselves; a wrong one agrees
with some by chance, and these do not. So a match is told by the triangles that it makes with another one:
the matches that agree with both.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.stages.consistency import lengths_agree, rounding_margin
from teaser_jax.stages.pairs import squared_norm

# In bounds of one match. Half of what the graph of the paper allows: right matches rarely use it up, and
# wrong ones agree by chance twice as often. A length this short agrees with any other as short.
TIGHT, SHORT = 1.0, 4.0


class Seeds(NamedTuple):
    """Matches to start from, each with its best company.

    Attributes:
        row: Which match it is.
        members: Itself and its companions.
        weights: What each of them counts: the triangles that it makes with the seed; 0 if it does not agree.
    """

    row: Int[Array, " k"]
    members: Int[Array, "k c"]
    weights: Float[Array, "k c"]


def tight_graph(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
) -> Bool[Array, "n n"]:
    """Find which pairs of matches agree on their length within half of what two bounds allow.

    Args:
        src, dst: Clean matches about the origin, of one scale [length].
        noise_bound: beta_i [length].
        mask: Rows to use.
    """
    here, there = (
        squared_norm(tuple(points[:, None, k] - points[None, :, k] for k in range(3)))
        for points in (src, dst)
    )
    bound = (noise_bound[:, None] + noise_bound[None]) / 2
    margin = rounding_margin(src, dst, mask, jnp.ones((), src.dtype))
    long = (SHORT * bound) ** 2
    agree = lengths_agree(here, there, TIGHT * bound + margin) & (here > long) & (there > long)
    return agree & mask[:, None] & mask[None]


def triangles(edges: Bool[Array, "n n"]) -> Float[Array, "n n"]:
    """Count for each pair that agrees the matches that agree with both; 0 for other pairs.

    One product of matrices in float32: whole numbers below 2^24 are exact there in any order.
    """
    ones = edges.astype(jnp.float32)
    return jnp.where(edges, jnp.matmul(ones, ones), 0)


def best_seeds(counts: Float[Array, "n n"], *, seeds: int, companions: int) -> Seeds:
    """Choose the matches whose best companions make most triangles with them.

    Of equal ones the first.

    Args:
        counts: From ``triangles``.
        seeds, companions: How many of each, at most as many as there are matches.
    """
    best, members = lax.top_k(counts, min(companions, counts.shape[0]))
    _, row = lax.top_k(jnp.sum(best, axis=1), min(seeds, counts.shape[0]))
    weights, members = best[row], members[row]
    return Seeds(
        row,
        jnp.concatenate([row[:, None], members], axis=1),
        jnp.concatenate([weights[:, :1], weights], axis=1),
    )
