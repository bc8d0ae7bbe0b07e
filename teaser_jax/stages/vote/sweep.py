"""Exact truncated least squares for one unknown number: adaptive voting (section VII).

Every measurement s_k allows the interval s_k +- c alpha_k. The set of measurements that agree
with x changes only at the 2K ends of these intervals, so a sweep over the sorted ends, with
running sums of the quadratic costs, meets every consensus set once.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.ground.bits import first_smallest

Criterion = Literal["tls", "consensus"]


class Vote(NamedTuple):
    """The winning consensus set and its estimate [unit of the measurements]."""

    estimate: Float[Array, ""]  # weighted mean of the members (14)
    witness: Float[Array, ""]  # a number with which exactly the members agree
    members: Bool[Array, " k"]


def vote(
    values: Float[Array, " k"],
    bounds: Float[Array, " k"],
    *,
    mask: Bool[Array, " k"] | None = None,
    cbar2: Float[Array, ""] | float = 1.0,
    criterion: Criterion = "tls",
    interval: tuple[Float[Array, ""] | float, Float[Array, ""] | float] = (-jnp.inf, jnp.inf),
) -> Vote:
    """Find the global optimum of sum_k min((x - s_k)^2 / alpha_k^2, c-bar^2).

    The estimate of a consensus set is its weighted mean (14). ``"consensus"`` takes the largest
    set instead of the cheapest (Remark 8), the cheaper of equals. Measurements with an infinite
    bound or outside the mask do not vote. With no voter the estimate is 0 and the set is empty.

    Args:
        values: Measurements s_k.
        bounds: alpha_k > 0, same unit.
        mask: Which measurements exist.
        cbar2: Truncation [-].
        criterion: What to optimise.
        interval: Only sets whose estimate lies in it compete.

    Gradients: none, the result is a choice; inputs are stopped.

    Precision: running sums cancel, so call it in float64 (``jax.enable_x64(True)``), as the
    solver does; float32 is accurate to about 1e-2 of a bound on thousands of measurements.

    References: Theorem 7, eq. (14), Algorithm 2, Remark 8.
    """
    values, bounds, cbar2 = lax.stop_gradient((values, bounds, jnp.asarray(cbar2, values.dtype)))
    dtype, k = values.dtype, values.shape[0]
    if k == 0:
        return Vote(jnp.zeros((), dtype), jnp.zeros((), dtype), jnp.zeros(0, bool))
    voters = jnp.isfinite(bounds) & jnp.isfinite(values)
    voters = voters if mask is None else voters & mask
    reach = jnp.sqrt(cbar2) * jnp.where(voters, bounds, 1)
    weights = jnp.where(voters, 1 / jnp.where(voters, bounds, 1) ** 2, 0)
    # Centred at the weighted mean: the running sums then hold the smallest numbers they can.
    centre = _mean(weights, jnp.where(voters, values, 0))
    offsets = jnp.where(voters, values - centre, 0)

    ends = jnp.concatenate([offsets - reach, offsets + reach])
    ends = jnp.where(jnp.concatenate([voters, voters]), ends, jnp.inf)
    order = argsort(ends)
    entering = order < k
    sign = jnp.where(entering, 1, -1).astype(dtype)
    who = jnp.where(entering, order, order - k)
    moments = jnp.stack([weights, weights * offsets, weights * offsets**2, voters.astype(dtype)])
    found, witness, _ = best_set(
        ends[order], running_sums(moments[:, who] * sign[None]), centre,
        cbar2=cbar2, criterion=criterion, interval=interval,
    )  # fmt: skip
    members = voters & (jnp.abs(witness - offsets) <= reach) & found
    # Afresh from the members: the running sums carry an error of about 1e-12 of the total cost.
    estimate = _mean(jnp.where(members, weights, 0), offsets)
    estimate, witness = (jnp.where(found, x + centre, 0) for x in (estimate, witness))
    return Vote(estimate, witness, members)


def best_set(
    begin: Float[Array, " m"],
    sums: Float[Array, "4 m"],
    centre: Float[Array, ""],
    *,
    cbar2: Float[Array, ""],
    criterion: Criterion,
    interval: tuple[Any, Any],
    candidates: Bool[Array, " m"] | None = None,
) -> tuple[Bool[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Find the best consensus set of a sweep: whether there is one, a number with which it agrees, its cost.

    The cost is relative to calling everything an outlier.

    Args:
        begin: Sorted ends, from ``centre``; a set lasts from one to the next.
        sums: Of its members: weights, weighted offsets from the centre, their squares, count.
        candidates: The sets that compete; None: all.
    """
    mass, first, second, size = sums
    # Between two ends the consensus set is constant. Where ends meet within rounding there is no
    # room to stand in, so such sets count only if no other does.
    until = jnp.concatenate([begin[1:], begin[-1:]])
    means = first / jnp.where(mass > 0, mass, 1)
    allowed = (size > 0.5) & (mass > 0)
    allowed &= (means + centre >= interval[0]) & (means + centre <= interval[1])
    allowed = allowed if candidates is None else allowed & candidates
    wide = allowed & (until - begin > 8 * jnp.finfo(begin.dtype).eps * (jnp.abs(begin) + jnp.abs(centre)))
    allowed = jnp.where(jnp.any(wide), wide, allowed)
    if criterion == "consensus":
        allowed &= size > jnp.max(jnp.where(allowed, size, 0)) - 0.5
    costs = second - first * means - cbar2 * size
    best = first_smallest(jnp.where(allowed, costs, jnp.inf))
    return jnp.any(allowed), 0.5 * (begin[best] + until[best]), costs[best]


def _mean(weights: Float[Array, " k"], values: Float[Array, " k"]) -> Float[Array, ""]:
    """Compute the weighted mean, 0 without weight; both sums in one product."""
    both = jnp.stack([jnp.ones_like(values), values])
    total, above = jnp.matmul(both, weights, precision=lax.Precision.HIGHEST)
    return above / jnp.where(total > 0, total, 1)


def running_sums(x: Float[Array, "c m"]) -> Float[Array, "c m"]:
    """Compute cumulative sums along each row, in products with triangles of ones.

    The rows are cut in pieces, summed inside each, and the totals of the pieces are summed the
    same way. XLA would make log m passes of ``cumsum`` on the CPU, and compile each.
    """
    c, m = x.shape
    piece = 32
    if m <= piece:
        return jnp.matmul(x, np.triu(np.ones((m, m))).astype(x.dtype), precision=lax.Precision.HIGHEST)
    count = -(-m // piece)
    pieces = jnp.pad(x, ((0, 0), (0, count * piece - m))).reshape(c, count, piece)
    triangle = np.triu(np.ones((piece, piece))).astype(x.dtype)
    inside = jnp.matmul(pieces, triangle, precision=lax.Precision.HIGHEST)
    totals = inside[:, :, -1]
    before = running_sums(totals) - totals
    return (inside + before[:, :, None]).reshape(c, count * piece)[:, :m]


def argsort(keys: Float[Array, " m"]) -> Array:
    """Find the indices that sort the keys, index and key packed into one integer where it has room.

    XLA sorts single integers on the CPU four times as fast as keys with a payload. Packing drops
    the lowest bits of a float64 key, so ends closer than 1e-9 of their size may swap; a swapped
    end changes the cost by what its own term is there, which is nothing at the end of an interval.
    """
    if keys.dtype != jnp.float64:
        return jnp.argsort(keys, stable=False)
    index_bits = max(1, (keys.shape[0] - 1).bit_length())
    raw = lax.bitcast_convert_type(keys, jnp.int64)
    ordered = jnp.where(raw < 0, raw ^ jnp.iinfo(jnp.int64).max, raw)
    index = jnp.arange(keys.shape[0], dtype=jnp.int32).astype(jnp.int64)
    packed = ((ordered >> index_bits) << index_bits) | index
    return lax.sort(packed, is_stable=False) & ((1 << index_bits) - 1)
