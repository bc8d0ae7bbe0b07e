"""Sets of TIMs as the rotation stage sees them: how to pass over one, and how to fit a rotation to it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, UInt32

from teaser_jax import so3
from teaser_jax.ground import bits
from teaser_jax.ground.loops import until_settled
from teaser_jax.stages.pairs import PairSlice, fold_pairs

Weigh: TypeAlias = Callable[[Array], Array]  # squared residuals in units of their bounds -> weights in [0, 1]
Chosen: TypeAlias = Bool[Array, " k"] | UInt32[Array, "n w"]  # a mask of listed TIMs, or packed bit rows


class Measured(NamedTuple):
    """What one pass over the TIMs finds at a rotation, under a weight function."""

    correlation: Float[Array, "3 3"]  # sum of w / delta^2 b a^T
    cost: Float[Array, ""]  # sum of w r^2
    soft: Float[Array, ""]  # how many weights lie strictly between 0 and 1


class Tims(NamedTuple):
    """A set of TIMs: how to pass over it, and how to write down which of them count."""

    measure: Callable[[Float[Array, "3 3"], Weigh], Measured]
    largest: Callable[[Float[Array, "3 3"]], Float[Array, ""]]  # squared residual
    members: Callable[[Float[Array, "3 3"], Weigh], Chosen]


class Rotation(NamedTuple):
    """The rotation, the TIMs that it rests on, and whether the iteration settled."""

    rotation: Float[Array, "3 3"]
    members: Chosen
    converged: Bool[Array, ""]


def listed_tims(
    src_tims: Float[Array, "k 3"],
    dst_tims: Float[Array, "k 3"],
    bounds: Float[Array, " k"],
    mask: Bool[Array, " k"],
) -> Tims:
    """Make the set of TIMs that are given one by one. Source TIMs carry the scale already."""
    inverse2 = jnp.where(mask, 1 / jnp.where(mask, bounds, 1) ** 2, 0)
    columns = jnp.concatenate([src_tims, jnp.ones_like(src_tims[:, :1])], axis=1)

    def residuals(rotation: Array) -> Array:
        turned = [sum(rotation[i, j] * src_tims[:, j] for j in range(3)) for i in range(3)]
        return sum((dst_tims[:, i] - turned[i]) ** 2 for i in range(3)) * inverse2

    def measure(rotation: Array, weigh: Weigh) -> Measured:
        r2 = residuals(rotation)
        w = jnp.where(mask, weigh(r2), 0)
        soft = ((w > 0) & (w < 1)).astype(w.dtype)
        # One product makes all sums: the correlation, the cost and the count.
        rows = jnp.stack([*(w * inverse2 * dst_tims[:, i] for i in range(3)), w * r2, soft])
        sums = jnp.matmul(rows, columns, precision=lax.Precision.HIGHEST)
        return Measured(sums[:3, :3], sums[3, 3], sums[4, 3])

    def largest(rotation: Array) -> Array:
        return jnp.max(residuals(rotation), initial=0)

    def members(rotation: Array, weigh: Weigh) -> Array:
        return mask & (weigh(residuals(rotation)) > 0.5)

    return Tims(measure, largest, members)


def complete_tims(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
) -> Tims:
    """Make the set of all TIMs among the points of the mask, in O(n^2) work but never O(n^2) numbers."""
    dtype = src.dtype

    def weighed(rotation: Array, weigh: Weigh, visited: PairSlice) -> tuple[Array, Array]:
        difference = [
            visited.dst_tims[i] - sum(rotation[i, j] * visited.src_tims[j] for j in range(3))
            for i in range(3)
        ]
        r2 = sum(d * d for d in difference) / visited.bounds**2
        return jnp.where(visited.valid, r2, 0), jnp.where(visited.valid, weigh(r2), 0)

    def measure(rotation: Array, weigh: Weigh) -> Measured:
        def add(so_far: Measured, _: Array, visited: PairSlice) -> Measured:
            r2, w = weighed(rotation, weigh, visited)
            return Measured(
                so_far.correlation + _pair_correlation(w / visited.bounds**2, visited),
                so_far.cost + jnp.sum(w * r2),
                so_far.soft + jnp.sum((w > 0) & (w < 1), dtype=jnp.int32).astype(dtype),
            )

        zero = jnp.zeros((), dtype)
        start = Measured(jnp.zeros((3, 3), dtype), zero, zero)
        return fold_pairs(add, start, src, dst, noise_bound, mask)

    def largest(rotation: Array) -> Array:
        def reach(so_far: Array, _: Array, visited: PairSlice) -> Array:
            return jnp.maximum(so_far, jnp.max(weighed(rotation, jnp.ones_like, visited)[0], initial=0))

        return fold_pairs(reach, jnp.zeros((), dtype), src, dst, noise_bound, mask)

    def members(rotation: Array, weigh: Weigh) -> Array:
        def mark(rows: Array, lane: Array, visited: PairSlice) -> Array:
            return bits.with_lane(rows, lane, weighed(rotation, weigh, visited)[1] > 0.5)

        return fold_pairs(mark, bits.no_bits(src.shape[0]), src, dst, noise_bound, mask)

    return Tims(measure, largest, members)


def descend(
    tims: Tims, rotation: Float[Array, "3 3"], *, cbar2: Float[Array, ""], iterations: int = 50
) -> tuple[Rotation, Float[Array, ""]]:
    """Fit the TIMs within their bounds again and again until the cost (12) stops falling.

    Returns:
        The best rotation met, and its cost [-].

    Gradients: none; inputs must be stopped by the caller.
    """
    dtype = rotation.dtype
    within = lambda r2: (r2 <= cbar2).astype(dtype)
    # Weights that make w r^2 the truncated residual.
    truncated = lambda r2: jnp.minimum(1, cbar2 / jnp.maximum(r2, jnp.finfo(dtype).tiny))

    class Best(NamedTuple):
        rotation: Array
        cost: Array

    def step(best: Best) -> tuple[Best, Array]:
        fitted = so3.nearest_rotation(tims.measure(best.rotation, within).correlation)
        cost = tims.measure(fitted, truncated).cost
        better = cost < best.cost * (1 - 8 * jnp.finfo(dtype).eps)
        return Best(jnp.where(better, fitted, best.rotation), jnp.where(better, cost, best.cost)), ~better

    start = Best(rotation, tims.measure(rotation, truncated).cost)
    best, settled = until_settled(step, start, iterations=iterations)
    return Rotation(best.rotation, tims.members(best.rotation, within), settled), best.cost


def correlation(
    weights: Float[Array, " k"], src_tims: Float[Array, "k 3"], dst_tims: Float[Array, "k 3"]
) -> Float[Array, "3 3"]:
    """Compute the correlation H = sum_k w_k b_k a_k^T; its nearest rotation is the fit. Gradients: exact."""
    return jnp.einsum("k,ki,kj->ij", weights, dst_tims, src_tims, precision=lax.Precision.HIGHEST)


def correlation_of_pairs(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    confidence: Float[Array, " n"],
    chosen: UInt32[Array, "n w"],
) -> Float[Array, "3 3"]:
    """Compute the correlation H over pairs that packed bit rows choose, with weights c_i c_j / delta_ij^2.

    Gradients: exact.
    """

    def add(total: Array, lane: Array, visited: PairSlice) -> Array:
        hit = bits.lane_of(chosen, lane) & visited.valid
        weight = jnp.where(hit, confidence[:, None] * by_lane[lane][None] / visited.bounds**2, 0)
        return total + _pair_correlation(weight, visited)

    by_lane, everything = bits.in_lanes(confidence), jnp.ones(src.shape[0], bool)
    return fold_pairs(add, jnp.zeros((3, 3), src.dtype), src, dst, noise_bound, everything)


def _pair_correlation(weight: Array, visited: PairSlice) -> Array:
    """Compute what a slice of pairs adds to the correlation H, component by component."""
    return jnp.stack(
        [jnp.stack([jnp.sum(weight * b * a) for a in visited.src_tims]) for b in visited.dst_tims]
    )
