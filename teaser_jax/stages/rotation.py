"""The rotation, by graduated non-convexity on truncated least squares (section VIII, TEASER++).

The cost (12) is made convex enough to start anywhere and is then stiffened round by round until
every TIM counts fully or not at all.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax import so3
from teaser_jax.stages import bits
from teaser_jax.stages.gnc import gnc_weights
from teaser_jax.stages.invariants import PairSlice, fold_pairs, words

Weigh = Callable[[Array], Array]  # squared residuals in units of their bounds -> weights in [0, 1]


class Measured(NamedTuple):
    """What one pass over the TIMs finds at a rotation, under a weight function."""

    correlation: Float[Array, "3 3"]  # sum of w / delta^2 b a^T
    cost: Float[Array, ""]  # sum of w r^2
    soft: Float[Array, ""]  # how many weights lie strictly between 0 and 1


class Tims(NamedTuple):
    """A set of TIMs: how to pass over it, and how to write down which of them count."""

    measure: Callable[[Float[Array, "3 3"], Weigh], Measured]
    largest: Callable[[Float[Array, "3 3"]], Float[Array, ""]]  # squared residual
    members: Callable[[Float[Array, "3 3"], Weigh], Array]


class Rotation(NamedTuple):
    """The rotation, the TIMs it rests on (mask or packed bit rows), and whether GNC settled."""

    rotation: Float[Array, "3 3"]
    members: Bool[Array, " k"] | UInt32[Array, "n w"]
    converged: Bool[Array, ""]


def listed_tims(
    src_tims: Float[Array, "k 3"],
    dst_tims: Float[Array, "k 3"],
    bounds: Float[Array, " k"],
    mask: Bool[Array, " k"],
) -> Tims:
    """TIMs given one by one. Source TIMs carry the scale already."""
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
    """All TIMs among the points of the mask, in O(n^2) work but never O(n^2) numbers."""
    n, dtype = src.shape[0], src.dtype

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
            kept = weighed(rotation, weigh, visited)[1] > 0.5
            return rows | (kept.astype(jnp.uint32) << lane.astype(jnp.uint32))

        return fold_pairs(mark, jnp.zeros((n, words(n)), jnp.uint32), src, dst, noise_bound, mask)

    return Tims(measure, largest, members)


def estimate_rotation(
    tims: Tims,
    *,
    cbar2: Float[Array, ""],
    gnc_factor: Float[Array, ""] | float = 1.4,
    tolerance: Float[Array, ""] | float = 1e-6,
    iterations: int = 100,
    dtype: jnp.dtype,
) -> Rotation:
    """GNC-TLS: a rotation and the TIMs that agree with it.

    The first fit uses all TIMs; if all agree with it, it is final. Otherwise they are weighed by
    ``gnc_weights``, under a control that grows round by round.

    Gradients: none, the members are a choice; inputs must be stopped by the caller.

    References: Yang, Antonante, Tzoumas, Carlone, RA-L 2020 (GNC-TLS); eq. (12).
    """
    cbar2 = jnp.asarray(cbar2, dtype)

    def weigh(gnc_mu: Array) -> Weigh:
        return lambda r2: gnc_weights(r2, gnc_mu, cbar2)

    class Round(NamedTuple):
        correlation: Array
        gnc_mu: Array  # of the weights behind `correlation`; infinite: all weights 1
        cost: Array
        settled: Array
        rounds: Array

    def one_round(state: Round) -> Round:
        # One fit a round, and only one in the program: it is what takes longest to compile.
        rotation = so3.nearest_rotation(state.correlation)
        excess = 2 * tims.largest(rotation) - cbar2
        opening = cbar2 / jnp.where(excess > 0, excess, 1)
        is_first = state.rounds == 0
        gnc_mu = jnp.where(is_first, opening, state.gnc_mu * gnc_factor)
        found = tims.measure(rotation, weigh(gnc_mu))
        still = jnp.abs(found.cost - state.cost) <= tolerance * jnp.maximum(found.cost, cbar2)
        all_agree = is_first & (excess <= 0)
        kept = jnp.where(all_agree, state.correlation, found.correlation)
        return Round(kept, gnc_mu, found.cost, all_agree | still | (found.soft < 0.5), state.rounds + 1)

    start = tims.measure(jnp.eye(3, dtype=dtype), jnp.ones_like)
    initial = Round(
        start.correlation,
        jnp.ones((), dtype),
        jnp.asarray(jnp.inf, dtype),
        jnp.zeros((), bool),
        jnp.zeros((), jnp.int32),
    )
    final = lax.while_loop(lambda s: ~s.settled & (s.rounds < iterations), one_round, initial)
    rotation = so3.nearest_rotation(final.correlation)
    kept = tims.members(rotation, lambda r2: (r2 <= cbar2).astype(dtype))
    return Rotation(rotation, kept, final.settled)


def settle(
    tims: Tims, rotation: Float[Array, "3 3"], *, cbar2: Float[Array, ""], iterations: int = 50
) -> tuple[Rotation, Float[Array, ""]]:
    """Fit the TIMs within their bounds until the cost (12) stops falling; with that cost."""
    dtype = rotation.dtype
    within = lambda r2: (r2 <= cbar2).astype(dtype)
    # Weights that make w r^2 the truncated residual.
    truncated = lambda r2: jnp.minimum(1, cbar2 / jnp.maximum(r2, jnp.finfo(dtype).tiny))

    class Step(NamedTuple):
        rotation: Array
        cost: Array
        falling: Array
        rounds: Array

    def once(state: Step) -> Step:
        fitted = so3.nearest_rotation(tims.measure(state.rotation, within).correlation)
        cost = tims.measure(fitted, truncated).cost
        better = cost < state.cost * (1 - 8 * jnp.finfo(dtype).eps)
        kept = jnp.where(better, fitted, state.rotation), jnp.where(better, cost, state.cost)
        return Step(*kept, better, state.rounds + 1)

    start = Step(rotation, tims.measure(rotation, truncated).cost, jnp.ones((), bool), jnp.int32(0))
    final = lax.while_loop(lambda s: s.falling & (s.rounds < iterations), once, start)
    return Rotation(final.rotation, tims.members(final.rotation, within), ~final.falling), final.cost


def ring_tims(clique: Bool[Array, " n"]) -> Int[Array, "n 2"]:
    """Pairs (i, next member after i) of the clique in the user's order, the last with the first.

    Rows of points outside the clique hold (i, i).
    """
    index = jnp.arange(clique.shape[0], dtype=jnp.int32)
    place = bits.rank(clique)  # of the next member, counted from 0
    place = jnp.where(place < jnp.sum(clique, dtype=jnp.int32), place, 0)
    return jnp.stack([index, jnp.where(clique, bits.listed(clique)[place], index)], axis=1)


def correlation(
    weights: Float[Array, " k"], src_tims: Float[Array, "k 3"], dst_tims: Float[Array, "k 3"]
) -> Float[Array, "3 3"]:
    """H = sum_k w_k b_k a_k^T. Gradients: exact."""
    return jnp.einsum("k,ki,kj->ij", weights, dst_tims, src_tims, precision=lax.Precision.HIGHEST)


def correlation_of_pairs(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    confidence: Float[Array, " n"],
    chosen: UInt32[Array, "n w"],
) -> Float[Array, "3 3"]:
    """The correlation over packed bit rows of pairs. Gradients: exact."""

    def add(total: Array, lane: Array, visited: PairSlice) -> Array:
        hit = ((chosen >> lane.astype(jnp.uint32)) & 1).astype(bool) & visited.valid
        w = words(src.shape[0])
        column = jnp.pad(confidence, (0, 32 * w - src.shape[0])).reshape(w, 32)[:, lane]
        weight = jnp.where(hit, confidence[:, None] * column[None] / visited.bounds**2, 0)
        return total + _pair_correlation(weight, visited)

    everything = jnp.ones(src.shape[0], bool)
    return fold_pairs(add, jnp.zeros((3, 3), src.dtype), src, dst, noise_bound, everything)


def _pair_correlation(weight: Array, visited: PairSlice) -> Array:
    return jnp.stack(
        [jnp.stack([jnp.sum(weight * b * a) for a in visited.src_tims]) for b in visited.dst_tims]
    )
