"""The consistency graph: which pairs of matches agree on the scale (section VI-D).

Inliers form a clique in it (Theorem 6), and the inliers of *every* pose do: so a proved bound on
the clique number bounds what any pose could explain. That holds only if no true edge is lost,
which is why the test is widened by the rounding it may suffer.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.stages.pairs import PairSlice, fold_pairs, squared_norm, tim_bounds, tims, usable_pairs


def rounding_margin(
    src: Float[Array, "n 3"], dst: Float[Array, "n 3"], mask: Bool[Array, " n"], scale: Float[Array, ""]
) -> Float[Array, ""]:
    """Bound how far | |b_ij| - s |a_ij| | may be off by rounding, input and arithmetic together [length].

    A coordinate x is known to eps |x| / 2; two points and the handful of operations on their
    difference make at most five times eps times the largest norm on either side. Eight covers the
    sum and the addition of the bounds.
    """
    reach = [jnp.sqrt(jnp.max(jnp.where(mask, jnp.sum(x * x, axis=1), 0), initial=0)) for x in (src, dst)]
    return margin_of(src.dtype, jnp.abs(scale) * reach[0] + reach[1])


def margin_of(dtype: Any, reach: Any) -> Any:
    """Compute the rounding margin of a dtype, for points of both clouds that together reach so far [length].

    Args:
        dtype: The type in which edges are tested.
        reach: The largest distances from the origin, s |a| + |b| [length]; numbers or arrays of them.
    """
    return 8 * float(jnp.finfo(dtype).eps) * reach


def lengths_agree(
    src_squared: Float[Array, "*k"], dst_squared: Float[Array, "*k"], tolerance: Float[Array, "*k"]
) -> Bool[Array, "*k"]:
    """Test | |b| - |a| | <= d by squared lengths: (A - B)^2 <= d^2 (2 (A + B) - d^2), or A + B <= d^2.

    That spares the square roots, which would be most of the work. Both cases are
    (A - B)^2 <= d^2 max(2 (A + B) - d^2, A + B): the second term is the larger one where
    A + B <= d^2, and then (A - B)^2 <= (A + B)^2 is below. Where one length is nearly zero and the
    other nearly d, both sides are d^4 and their difference has a double root: there the rounding
    of d^4 itself is added, which admits lengths up to d (1 + sqrt(8 eps)). A tolerance of NaN
    agrees with nothing.
    """
    difference, total, tolerance2 = src_squared - dst_squared, src_squared + dst_squared, tolerance**2
    rounding = 8 * jnp.finfo(total.dtype).eps * tolerance2
    return difference**2 <= tolerance2 * (jnp.maximum(2 * total - tolerance2, total) + rounding)


def reach_of(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    scale: Float[Array, ""],
    cbar2: Float[Array, ""],
) -> Float[Array, " n"]:
    """Find how far each match may be off, rounding included: two agree within the sum of both [length]."""
    return jnp.sqrt(cbar2) * noise_bound + rounding_margin(src, dst, mask, scale) / 2


def are_zero(components: tuple[Float[Array, "*k"], ...]) -> Bool[Array, "*k"]:
    """Tell which vectors, given by component, join equal points."""
    x, y, z = components
    return (x == 0) & (y == 0) & (z == 0)


def consistency_graph(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    scale: Float[Array, ""],
    cbar2: Float[Array, ""],
    pairs: Int[Array, "m 2"] | None = None,
    one_to_one: bool | Bool[Array, ""] = False,
) -> UInt32[Array, "n w"]:
    """Find edges between matches with | |b_ij| - s |a_ij| | <= c (beta_i + beta_j), as packed bit rows.

    Bit t of word j in row i is the edge (i, 32 j + t); the rows are symmetric, without loops, and
    empty for masked matches. With ``pairs`` only those are tested and every other pair counts as
    consistent: a pair that was not tested excludes nothing. With ``one_to_one``, and no pairs, matches of
    one point of either cloud have no edge.

    Gradients: none; inputs are stopped.

    References: section VI-D, eq. (9), Theorem 6.
    """
    src, dst, noise_bound, scale, cbar2 = lax.stop_gradient((src, dst, noise_bound, scale, cbar2))
    n = src.shape[0]
    scaled, reach = scale * src, reach_of(src, dst, noise_bound, mask, scale, cbar2)

    if pairs is None:

        def mark(rows: Array, lane: Array, visited: PairSlice) -> Array:
            edge = lengths_agree(
                squared_norm(visited.src_tims), squared_norm(visited.dst_tims), visited.bounds
            )
            if one_to_one is not False:
                edge &= ~(one_to_one & (are_zero(visited.src_tims) | are_zero(visited.dst_tims)))
            return bits.with_lane(rows, lane, edge)

        # Masked matches reach NaN far, which spares a test in each of n^2 pairs.
        rows = fold_pairs(mark, bits.no_bits(n), scaled, dst, jnp.where(mask, reach, jnp.nan), mask)
        return rows & bits.others(n)

    agree = lengths_agree(
        jnp.sum(tims(scaled, pairs) ** 2, axis=1),
        jnp.sum(tims(dst, pairs) ** 2, axis=1),
        tim_bounds(reach, pairs),
    )
    dense = mask[:, None] & mask[None] & ~jnp.eye(n, dtype=bool)
    clear = ~agree & usable_pairs(pairs, mask)
    # Pairs that may stay are sent out of range, so that no pair can set a bit again.
    i, j = (jnp.where(clear, pairs[:, k], n) for k in range(2))
    dense = dense.at[i, j].set(False, mode="drop").at[j, i].set(False, mode="drop")
    return bits.pack(dense)
