"""Pairs of matches: the invariant measurements that they make of scale and rotation (section V).

The difference of two matches forgets the translation (a TIM), its length also forgets the
rotation (a TRIM). Graphs of pairs come in two forms. Given ``pairs`` are an explicit list. The
complete graph is never written down: ``fold_pairs`` walks over it in 32 slices, because n^2 rows
of three numbers are what makes other implementations run out of memory.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import safe_norm
from teaser_jax.ground.bits import LANES

Carry = TypeVar("Carry")


def tims(points: Float[Array, "n 3"], pairs: Int[Array, "m 2"]) -> Float[Array, "m 3"]:
    """Compute translation invariant measurements: the difference x_j - x_i of each pair (i, j).

    Equal to the incidence matrix of the graph times the points (Theorem 4).

    Gradients: exact.

    References: eq. (TIM), Theorem 4.
    """
    return points[pairs[:, 1]] - points[pairs[:, 0]]


def tim_bounds(noise_bound: Float[Array, " n"], pairs: Int[Array, "m 2"]) -> Float[Array, " m"]:
    """Compute the bounds delta_ij = beta_i + beta_j of the TIMs [length]. Gradients: exact."""
    return noise_bound[pairs[:, 0]] + noise_bound[pairs[:, 1]]


def trims(
    src_tims: Float[Array, "m 3"], dst_tims: Float[Array, "m 3"], bounds: Float[Array, " m"]
) -> tuple[Float[Array, " m"], Float[Array, " m"]]:
    """Compute scale measurements s_ij = |b_ij| / |a_ij| and their bounds alpha_ij = delta_ij / |a_ij|.

    Lengths do not change under rotation, so a TRIM depends on the scale alone. A zero-length
    source pair says nothing: it gets the value 0 and an infinite bound, which cannot vote.

    Returns:
        Measurements [-] and bounds [-].

    Gradients: exact; zero at zero-length pairs.

    References: eq. (TRIM).
    """
    src_length, dst_length = safe_norm(src_tims), safe_norm(dst_tims)
    usable = src_length > 0
    inverse = 1 / jnp.where(usable, src_length, 1)
    return jnp.where(usable, dst_length * inverse, 0), jnp.where(usable, bounds * inverse, jnp.inf)


class PairSlice(NamedTuple):
    """One in 32 of the pairs of the complete graph: every row i against the columns j = 32 w + lane."""

    src_tims: tuple[Float[Array, "n w"], ...]  # components of a_i - a_j
    dst_tims: tuple[Float[Array, "n w"], ...]
    bounds: Float[Array, "n w"]  # beta_i + beta_j
    valid: Bool[Array, "n w"]  # two different usable matches


def fold_pairs(
    body: Callable[[Carry, Int[Array, ""], PairSlice], Carry],
    init: Carry,
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
) -> Carry:
    """Reduce over all ordered pairs of matches, a slice at a time.

    Slices stride over the columns, so that every operation in ``body`` is contiguous vector work
    and bit t of a packed word is simply the verdict of slice t. Live memory is a few (n, n/32)
    arrays. Each unordered pair is met twice, as (i, j) and as (j, i).

    Gradients: exact; the backward pass recomputes each slice instead of storing it.
    """
    n = src.shape[0]
    # Each component is an array of its own: slices of a common one are not vectorised on the CPU.
    rows = [x[:, None] for x in (*src.T, *dst.T, noise_bound)]
    index = jnp.arange(n, dtype=jnp.int32)[:, None]
    starts = LANES * jnp.arange(bits.words(n), dtype=jnp.int32)

    @jax.checkpoint
    def step(carry: Carry, lane: tuple) -> tuple[Carry, None]:
        t, use, beta, *columns = lane
        difference = [row - column[None] for row, column in zip(rows[:6], columns, strict=True)]
        visited = PairSlice(
            tuple(difference[:3]),
            tuple(difference[3:]),
            rows[6] + beta[None],
            mask[:, None] & use[None] & (index != starts[None] + t),
        )
        return body(carry, t, visited), None

    columns = [bits.in_lanes(x) for x in (mask, noise_bound, *src.T, *dst.T)]
    return lax.scan(step, init, (jnp.arange(LANES, dtype=jnp.int32), *columns))[0]


def squared_norm(components: tuple[Float[Array, "*k"], ...]) -> Float[Array, "*k"]:
    """Compute the squared lengths of vectors that are given by component."""
    x, y, z = components
    return x * x + y * y + z * z


def usable_pairs(pairs: Int[Array, "m 2"], mask: Bool[Array, " n"]) -> Bool[Array, " m"]:
    """Tell which pairs join two different usable matches."""
    return mask[pairs[:, 0]] & mask[pairs[:, 1]] & (pairs[:, 0] != pairs[:, 1])


def ring_pairs(members: Bool[Array, " n"]) -> Int[Array, "n 2"]:
    """List the pairs (i, next member after i) in the user's order, the last member with the first.

    Rows of points that are no members hold (i, i).
    """
    index = jnp.arange(members.shape[0], dtype=jnp.int32)
    place = bits.rank(members)  # of the next member, counted from 0
    place = jnp.where(place < jnp.sum(members, dtype=jnp.int32), place, 0)
    return jnp.stack([index, jnp.where(members, bits.listed(members)[place], index)], axis=1)
