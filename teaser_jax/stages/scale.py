"""The scale, from the lengths of pairs of matches alone (section VI-A)."""

from __future__ import annotations

from dataclasses import dataclass, field
from numbers import Real
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.ground import bits
from teaser_jax.ground.arrays import Placeholder, is_traced, safe_norm, safe_sqrt
from teaser_jax.ground.checks import shown
from teaser_jax.ground.numbers import TracedNumber, as_float, named
from teaser_jax.stages.pairs import (
    PairSlice,
    fold_pairs,
    squared_norm,
    tim_bounds,
    tims,
    trims,
    usable_pairs,
)
from teaser_jax.stages.vote.histogram import vote_by_histogram
from teaser_jax.stages.vote.sweep import Criterion, vote

FEW_PAIRS = 32768  # that a sweep over all ends decides sooner than histograms
ScalePairs: TypeAlias = UInt32[Array, "n w"] | Bool[Array, " m"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class ScaleVote:
    """Find an unknown scale by the vote over the TRIMs (11).

    Attributes:
        range: The interval (low, high) to look in, traced [-]. The refined scale may leave it by two parts in
            a hundred; an answer further away has no consensus.
    """

    name: str = named("vote")
    range: tuple[TracedNumber, TracedNumber] | Placeholder = field(default=(0.0, float("inf")))

    def __post_init__(self) -> None:
        if not isinstance(self.range, tuple) or len(self.range) != 2:
            raise ValueError(f"ScaleVote.range is {shown(self.range)}: expected (low, high).")
        # JAX rebuilds records from placeholders, too: only what is a number is looked at.
        limits = tuple(as_float(x) if isinstance(x, Real) else x for x in self.range)
        if any(isinstance(x, str) for x in limits) or all(isinstance(x, float) for x in limits):
            self._check(limits)
        object.__setattr__(self, "range", limits)

    def check_concrete(self) -> None:
        """Check that both limits are known numbers in order; tracers pass. Raises ValueError."""
        if not is_traced(self.range):
            self._check(self.range)

    def _check(self, limits: tuple[Any, ...]) -> None:
        try:
            low, high = (float(x) for x in limits)
        except (TypeError, ValueError):
            raise ValueError(f"ScaleVote.range is {shown(self.range)}: expected two numbers.") from None
        if not 0 <= low < high:
            raise ValueError(
                f"ScaleVote.range is {shown(self.range)}: expected (low, high) with 0 <= low < high."
            )


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
    """Estimate the TLS scale of all TRIMs (11), or of those of the given pairs; find its consensus set.

    Runs in float64 whatever the dtype of the points, because running sums of a million terms
    cancel; JAX's configuration is left as it was.

    A pair whose target length is within its bound agrees with a scale of zero: it cannot tell a scale
    from a collapse and does not vote. Otherwise matches that are many to one, whose lengths are zero
    exactly, would outvote the right ones as soon as there are as many of them.

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
        if pairs is not None:
            values, bounds = trims(tims(src, pairs), tims(dst, pairs), tim_bounds(noise_bound, pairs))
            won = vote(
                values, bounds, mask=usable_pairs(pairs, mask) & (values > jnp.sqrt(cbar2) * bounds),
                cbar2=cbar2, criterion=criterion, interval=(low, high),
            )  # fmt: skip
            return won.estimate.astype(dtype), won.members
        every = CompleteTrims(src, dst, noise_bound, mask, cbar2)
        if criterion == "tls" and every.rows * every.length > FEW_PAIRS:
            found, witness = vote_by_histogram(every, cbar2=cbar2, unit=every.typical(), interval=(low, high))
        else:
            values, bounds, usable = every.all()
            won = vote(values, bounds, mask=usable, cbar2=cbar2, criterion=criterion, interval=(low, high))
            found, witness = jnp.any(won.members), won.witness
        scale, chosen = _agreeing_pairs(src, dst, noise_bound, mask & found, witness, cbar2)
        return scale.astype(dtype), chosen


def scale_of_pairs(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    confidence: Float[Array, " n"],
    chosen: ScalePairs,
    *,
    pairs: Int[Array, "m 2"] | None = None,
) -> Float[Array, ""]:
    """Compute the weighted mean (14) of the chosen TRIMs, with weights confidence / alpha_ij^2.

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
            hit = bits.lane_of(chosen, lane) & visited.valid
            both = confidence[:, None] * by_lane[lane][None]
            weight = jnp.where(hit, both / visited.bounds**2, 0)
            a2, b2 = squared_norm(visited.src_tims), squared_norm(visited.dst_tims)
            return sums[0] + jnp.sum(weight * safe_sqrt(a2 * b2)), sums[1] + jnp.sum(weight * a2)

        by_lane = bits.in_lanes(confidence)
        zero = jnp.zeros((), src.dtype)
        everything = jnp.ones(src.shape[0], bool)
        above, below = fold_pairs(add, (zero, zero), src, dst, noise_bound, everything)
    return jnp.where(below > 0, above / jnp.where(below > 0, below, 1), 0)


class CompleteTrims:
    """The TRIMs of every unordered pair once: row k holds the pairs (i, i + k + 1 mod n)."""

    def __init__(self, src: Array, dst: Array, noise_bound: Array, mask: Array, cbar2: Array) -> None:
        self.cbar2 = cbar2
        self.length = src.shape[0]
        self.rows = self.length // 2
        self.matches = tuple(jnp.asarray(x) for x in (*src.T, *dst.T, noise_bound, mask))
        self.wrapped = [jnp.concatenate([x, x[: self.rows]]) for x in self.matches]
        self.index = jnp.arange(self.length, dtype=jnp.int32)

    def row(self, k: Int[Array, ""]) -> tuple[Array, Array, Array]:
        """Compute the values and bounds of one row, and tell which of them can vote."""
        others = [lax.dynamic_slice_in_dim(x, k + 1, self.length) for x in self.wrapped]
        return self._trims(k, self.index, self.matches, others)

    def recall(self, k: Int[Array, " m"], i: Int[Array, " m"]) -> tuple[Array, Array, Array]:
        """Compute the values and bounds at given rows and places, and tell which of them can vote."""
        j = (i + k + 1) % self.length
        return self._trims(k, i, [x[i] for x in self.matches], [x[j] for x in self.matches])

    def all(self) -> tuple[Array, Array, Array]:
        """Compute the values and bounds of all rows, one after the other, and tell which of them can vote."""
        rows = lax.map(self.row, jnp.arange(self.rows, dtype=jnp.int32))
        return tuple(x.reshape(-1) for x in rows)

    def typical(self) -> Float[Array, ""]:
        """Compute the geometric mean of the first row: no few absurd points move it far."""
        values, _, voters = self.row(jnp.int32(0))
        voters &= values > 0
        total = jnp.sum(jnp.log(jnp.where(voters, values, 1)))
        return jnp.exp(total / jnp.maximum(jnp.sum(voters, dtype=jnp.int32), 1).astype(total.dtype))

    def _trims(self, k: Array, i: Array, these: Any, others: Any) -> tuple[Array, Array, Array]:
        difference = [y - x for x, y in zip(these[:6], others[:6], strict=True)]
        a2, b2 = squared_norm(tuple(difference[:3])), squared_norm(tuple(difference[3:]))
        bound = these[6] + others[6]
        voters = these[7] & others[7] & (a2 > 0) & (b2 > self.cbar2 * bound**2)
        voters &= (2 * (k + 1) != self.length) | (i < self.rows)  # half way round, pairs would come twice
        inverse = 1 / jnp.sqrt(jnp.where(voters, a2, 1))
        return jnp.sqrt(b2) * inverse, bound * inverse, voters


def _agreeing_pairs(
    src: Array, dst: Array, noise_bound: Array, mask: Array, scale: Array, cbar2: Array
) -> tuple[Float[Array, ""], UInt32[Array, "n w"]]:
    """Find the pairs that vote and have | |b_ij| - s |a_ij| | <= c delta_ij, as bit rows.

    Also compute their weighted mean (14), as sum w |a||b| / sum w |a|^2 with w = 1 / delta^2.
    """
    c = jnp.sqrt(cbar2)

    def mark(carry: tuple, lane: Array, visited: PairSlice) -> tuple:
        rows, above, below = carry
        a2, b2 = squared_norm(visited.src_tims), squared_norm(visited.dst_tims)
        a, b = jnp.sqrt(a2), jnp.sqrt(b2)
        agree = (jnp.abs(b - scale * a) <= c * visited.bounds) & visited.valid & (a2 > 0)
        agree &= b > c * visited.bounds
        weight = jnp.where(agree, 1 / visited.bounds**2, 0)
        rows = bits.with_lane(rows, lane, agree)
        return rows, above + jnp.sum(weight * a * b), below + jnp.sum(weight * a2)

    zero = jnp.zeros((), src.dtype)
    start = (bits.no_bits(src.shape[0]), zero, zero)
    rows, above, below = fold_pairs(mark, start, src, dst, noise_bound, mask)
    return above / jnp.where(below > 0, below, 1), rows
