"""The scale, from the lengths of pairs of matches alone (section VI-A)."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.stages.invariants import (
    PairSlice,
    fold_pairs,
    safe_norm,
    safe_sqrt,
    squared_norm,
    tim_bounds,
    tims,
    trims,
    words,
)  # fmt: skip
from teaser_jax.stages.voting import vote
from teaser_jax.types import Criterion

ScalePairs = UInt32[Array, "n w"] | Bool[Array, " m"]


def estimate_scale(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    cbar2: Float[Array, ""],
    pairs: Int[Array, "m 2"] | None = None,
    criterion: Criterion = "tls",
    scale_range: tuple[Any, Any] = (0.0, float("inf")),
) -> tuple[Float[Array, ""], ScalePairs]:
    """The TLS scale of all TRIMs (11), or of those of the given pairs, and its consensus set.

    Runs in float64 whatever the dtype of the points, because running sums of a million terms
    cancel; JAX's configuration is left as it was.

    Returns:
        Scale [-] in the dtype of the points, 0 where nothing can vote, and the pairs that agree
        with it: packed bit rows, or a mask of the given pairs.

    Gradients: none, the set is a choice. ``scale_of_pairs`` is the differentiable read-out.

    References: eq. (11), Algorithm 1 line 7.
    """
    dtype = src.dtype
    stopped = lax.stop_gradient((src, dst, noise_bound, cbar2))
    with jax.enable_x64(True):
        src, dst, noise_bound, cbar2 = (x.astype(jnp.float64) for x in stopped)
        low, high = (jnp.asarray(x).astype(jnp.float64) for x in scale_range)
        if pairs is None:
            values, bounds, usable = _complete_trims(src, dst, noise_bound, mask)
        else:
            values, bounds = trims(tims(src, pairs), tims(dst, pairs), tim_bounds(noise_bound, pairs))
            usable = usable_pairs(pairs, mask)
        won = vote(values, bounds, mask=usable, cbar2=cbar2, criterion=criterion, interval=(low, high))
        chosen = (
            won.members
            if pairs is not None
            else _agreeing_pairs(src, dst, noise_bound, mask, won.witness, cbar2)
        )
        return won.estimate.astype(dtype), chosen


def scale_of_pairs(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    confidence: Float[Array, " n"],
    chosen: ScalePairs,
    *,
    pairs: Int[Array, "m 2"] | None = None,
) -> Float[Array, ""]:
    """The weighted mean (14) of the chosen TRIMs, with weights confidence / alpha_ij^2.

    Written as sum w |a||b| / sum w |a|^2 with w = confidence / delta^2, which divides by nothing
    small. An empty choice gives 0.

    Gradients: exact in points, bounds and confidences.
    """
    if pairs is not None:
        a, b = safe_norm(tims(src, pairs)), safe_norm(tims(dst, pairs))
        weight = confidence[pairs[:, 0]] * confidence[pairs[:, 1]] / tim_bounds(noise_bound, pairs) ** 2
        weight = jnp.where(chosen, weight, 0)
        above, below = jnp.sum(weight * a * b), jnp.sum(weight * a * a)
    else:
        # Weights per pair are products c_i c_j: fold them in as rows against columns.
        def add(sums: tuple[Array, Array], lane: Array, visited: PairSlice) -> tuple[Array, Array]:
            hit = ((chosen >> lane.astype(jnp.uint32)) & 1).astype(bool) & visited.valid
            column = _columns(confidence, lane)
            weight = jnp.where(hit, confidence[:, None] * column[None] / visited.bounds**2, 0)
            a2, b2 = squared_norm(visited.src_tims), squared_norm(visited.dst_tims)
            return sums[0] + jnp.sum(weight * safe_sqrt(a2 * b2)), sums[1] + jnp.sum(weight * a2)

        zero = jnp.zeros((), src.dtype)
        everything = jnp.ones(src.shape[0], bool)
        above, below = fold_pairs(add, (zero, zero), src, dst, noise_bound, everything)
    return jnp.where(below > 0, above / jnp.where(below > 0, below, 1), 0)


def usable_pairs(pairs: Int[Array, "m 2"], mask: Bool[Array, " n"]) -> Bool[Array, " m"]:
    """Pairs of two different usable matches."""
    return mask[pairs[:, 0]] & mask[pairs[:, 1]] & (pairs[:, 0] != pairs[:, 1])


def _columns(values: Float[Array, " n"], lane: Int[Array, ""]) -> Float[Array, " w"]:
    """The entries at columns 32 w + lane."""
    w = words(values.shape[0])
    return jnp.pad(values, (0, 32 * w - values.shape[0])).reshape(w, 32)[:, lane]


def _complete_trims(src: Array, dst: Array, noise_bound: Array, mask: Array) -> tuple[Array, Array, Array]:
    """TRIMs of every unordered pair once: row k holds the pairs (i, i + k mod n)."""
    n = src.shape[0]
    half = n // 2
    wrap = lambda x: jnp.concatenate([x, x[..., :half]], axis=-1)
    a2, b2, beta2, mask2 = (wrap(x) for x in (src.T, dst.T, noise_bound, mask))

    index = jnp.arange(n, dtype=jnp.int32)

    def row(k: Array) -> tuple[Array, Array, Array]:
        shift = lambda x: lax.dynamic_slice_in_dim(x, k, n, axis=-1)
        a, b = shift(a2) - src.T, shift(b2) - dst.T
        values, bounds = trims(a.T, b.T, shift(beta2) + noise_bound)
        once = (2 * k != n) | (index < half)  # half way round, pairs would come twice
        return values, bounds, shift(mask2) & mask & once

    rows = lax.map(row, jnp.arange(1, half + 1, dtype=jnp.int32))
    return tuple(x.reshape(-1) for x in rows)


def _agreeing_pairs(
    src: Array, dst: Array, noise_bound: Array, mask: Array, scale: Array, cbar2: Array
) -> UInt32[Array, "n w"]:
    """Pairs with | |b_ij| - s |a_ij| | <= c delta_ij and a length to divide by, as bit rows."""
    c = jnp.sqrt(cbar2)

    def mark(rows: Array, lane: Array, visited: PairSlice) -> Array:
        a2, b2 = squared_norm(visited.src_tims), squared_norm(visited.dst_tims)
        agree = jnp.abs(jnp.sqrt(b2) - scale * jnp.sqrt(a2)) <= c * visited.bounds
        agree &= visited.valid & (a2 > 0)
        return rows | (agree.astype(jnp.uint32) << lane.astype(jnp.uint32))

    n = src.shape[0]
    empty = jnp.zeros((n, words(n)), jnp.uint32)
    return fold_pairs(mark, empty, src, dst, noise_bound, mask)
