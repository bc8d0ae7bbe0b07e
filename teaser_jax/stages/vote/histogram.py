"""The vote of millions of measurements: bounds from a histogram, then a sweep of what they leave.

Sorting the ends of a million intervals is what a sweep spends its time and memory on. Here the axis is
cut in bins. The intervals that cover a bin make one parabola there, whose top is a *lower* bound of the
gain, that is of the cost saved against calling everything an outlier. An interval that ends inside the
bin adds at most what it can gain between its end and the edge. Where that upper bound stays below the
best lower one, the bin is settled. A pass or two settle all but a handful, and only the ends inside
those are sorted and swept. Memory does not grow with the number of measurements.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground.bits import first_smallest, rank
from teaser_jax.stages.vote.sweep import argsort, best_set, running_sums

BINS = 16384
SAMPLE = 8192  # measurements that are asked first, where to look
SAMPLE_PASSES = 2  # after which the bins are as narrow as 1e-8 of the axis
MOST_PASSES = 24

Measured = tuple[Float[Array, " k"], Float[Array, " k"], Bool[Array, " k"]]


@runtime_checkable
class MeasurementRows(Protocol):
    """Measurements row by row: values, bounds, and which of them vote."""

    rows: int
    length: int  # of each row

    def row(self, k: Int[Array, ""]) -> Measured:
        """Compute the values and bounds of row k, and tell which of them vote."""

    def recall(self, k: Int[Array, " m"], i: Int[Array, " m"]) -> Measured:
        """Compute the value and bound of the i-th measurement of row k, for many i and k; tell which vote."""


class Axis(NamedTuple):
    """Bins of equal width in z = x / (x + unit), which takes [0, inf) to [0, 1)."""

    low: Float[Array, ""]
    high: Float[Array, ""]
    unit: Float[Array, ""]

    def bin(self, x: Float[Array, " k"]) -> Int[Array, " k"]:
        """Find the bin of each number: 0 is all below, then 1 .. BINS, and BINS + 1 all above."""
        positive = jnp.maximum(x, 0)
        z = positive / (positive + self.unit)
        place = (z - self.low) * (BINS / (self.high - self.low))
        return jnp.floor(jnp.clip(place, -1, BINS)).astype(jnp.int32) + 1

    def part(self, first: Int[Array, ""], last: Int[Array, ""]) -> Axis:
        """Make the axis of the bins from the first to the last."""
        width = (self.high - self.low) / BINS
        return self._replace(
            low=self.low + (first - 1).astype(width.dtype) * width,
            high=self.low + last.astype(width.dtype) * width,
        )

    def middle(self) -> Float[Array, ""]:
        """Find a number near the middle of the axis."""
        z = 0.5 * (self.low + self.high)
        return self.unit * z / (1 - z)

    def edges(self) -> Float[Array, " e"]:
        """Compute the left edges of the bins 1 .. BINS + 1; the last may be infinite."""
        z = self.low + _counting(BINS + 1).astype(self.low.dtype) * ((self.high - self.low) / BINS)
        inside = z < 1
        return jnp.where(inside, self.unit * z / jnp.where(inside, 1 - z, 1), jnp.inf)


class Histogram(NamedTuple):
    """Sums over the intervals that begin or end in each of BINS + 2 bins."""

    entering: tuple[Float[Array, " b"], ...]  # weight, weight d, weight d^2; not if it ends there too
    leaving: tuple[Float[Array, " b"], ...]
    begun: Int[Array, " b"]
    ended: Int[Array, " b"]
    partial: Float[Array, " b"]  # the most that those with an end in the bin can gain there
    central: Float[Array, "4"]  # sums of the set at the centre: its moments and count
    sizes: Float[Array, "3"]  # of the moments, added up: what rounding errors are measured by


class Question(NamedTuple):
    """What a pass over the measurements leaves open: the bins that may hold the best set."""

    axis: Axis
    centre: Float[Array, ""]  # offsets d are taken from here: near the answer, nothing cancels
    upper: Float[Array, " b"]  # no set that lasts in the bin gains more
    touching: Int[Array, " b"]  # ends in the bin
    own: Float[Array, "4 b"]  # their sums: weight, weight d, weight d^2, count
    gain: Float[Array, ""]  # the most that any set was seen to gain
    where: Float[Array, ""]  # and its estimate
    passes: Int[Array, ""]

    @property
    def open(self) -> Bool[Array, " b"]:
        """Bins that may hold the best set."""
        return self.upper >= self.gain

    def hull(self) -> tuple[Int[Array, ""], Int[Array, ""]]:
        """Find the first and the last open bin."""
        index = _counting(BINS + 2)
        return jnp.min(jnp.where(self.open, index, BINS)), jnp.max(jnp.where(self.open, index, 1))

    @property
    def ends(self) -> Int[Array, ""]:
        """How many ends the open bins have."""
        return jnp.sum(jnp.where(self.open, self.touching, 0), dtype=jnp.int32)


def vote_by_histogram(
    measurements: MeasurementRows,
    *,
    cbar2: Float[Array, ""],
    unit: Float[Array, ""],
    interval: tuple[Any, Any] = (0.0, jnp.inf),
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """Find the global optimum of sum_k min((x - s_k)^2 / alpha_k^2, c-bar^2) over x >= 0, s_k >= 0.

    The same as ``vote``, for measurements too many to hold: they are recomputed row by row.

    Args:
        measurements: The measurements.
        cbar2: Truncation [-].
        unit: A typical value: half of the bins lie below it.
        interval: Only sets whose estimate lies in it compete.

    Returns:
        Whether anything voted, and a number with which exactly the winning set agrees.

    Exact up to rounding, if no bin holds an eighth of all ends of which no large set agrees. Two
    passes over the measurements are the rule; where noise bounds are so tight that intervals are lost
    in a bin, and no set stands out, it takes up to 32.

    Gradients: none; the caller stops the inputs. Needs float64.

    References: Theorem 7, eq. (14); bounds by histogram are our own.
    """
    zero, outside = jnp.zeros_like(unit), jnp.full(1, -jnp.inf, unit.dtype)
    start = Question(
        axis=Axis(zero, jnp.ones_like(unit), unit),
        centre=unit,
        upper=jnp.concatenate([outside, jnp.zeros(BINS, unit.dtype), outside]),
        touching=jnp.zeros(BINS + 2, jnp.int32),
        own=jnp.zeros((4, BINS + 2), unit.dtype),
        gain=zero,
        where=zero,
        passes=jnp.zeros((), jnp.int32),
    )
    narrowed = _narrow(measurements, start, cbar2, interval)
    best, witness = _sweep_open_bins(measurements, narrowed, cbar2, interval)
    swept = best >= (1 - 1e-9) * narrowed.gain
    return (best > 0) | (narrowed.gain > 0), jnp.where(swept, witness, narrowed.where)


def _narrow(
    measurements: MeasurementRows, start: Question, cbar2: Array, interval: tuple[Any, Any]
) -> Question:
    """Pass over the measurements until the ends in the open bins are few enough to sweep."""
    unit = start.axis.unit
    zero, room = jnp.zeros_like(unit), most_ends(measurements.rows * measurements.length)

    def unsettled(q: Question) -> Bool[Array, ""]:
        first, last = q.hull()
        closer = (q.ends > room) & (4 * (last - first + 1) <= BINS) & (q.passes < MOST_PASSES)
        return (q.passes <= SAMPLE_PASSES) | closer

    def once(q: Question) -> Question:
        # A sample goes where it sees most. With that place as the centre all are asked about the whole
        # axis, and then about what that leaves open.
        sampled, fresh = q.passes < SAMPLE_PASSES, q.passes == SAMPLE_PASSES
        first, last = q.hull()
        best = first_smallest(-q.upper)
        closer = q.axis.part(jnp.where(sampled, best, first), jnp.where(sampled, best, last))
        whole = Axis(zero, jnp.ones_like(unit), jnp.where(q.where > 0, q.where, unit))
        axis = jax.tree.map(partial(jnp.where, (q.passes == 0) | fresh), whole, closer)
        sample = min(measurements.rows, -(-SAMPLE // measurements.length))
        asked = jnp.where(sampled, sample, measurements.rows)
        q = q._replace(axis=axis, centre=axis.middle(), gain=jnp.where(fresh, 0, q.gain))
        return _bounds(_histogram(measurements, asked, q, cbar2), q, cbar2, interval)

    return lax.while_loop(unsettled, once, start)


def _sweep_open_bins(
    measurements: MeasurementRows, narrowed: Question, cbar2: Array, interval: tuple[Any, Any]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Sweep the open bins, some at a time: the best gain there, and a number with which its set agrees."""
    zero, room = jnp.zeros_like(narrowed.gain), most_ends(measurements.rows * measurements.length)

    def remains(state: tuple[Question, Array, Array]) -> Bool[Array, ""]:
        return jnp.any(state[0].open)

    def once(state: tuple[Question, Array, Array]) -> tuple[Question, Array, Array]:
        q, best, witness = state
        # As many of the open bins as there is room for, at least one.
        ends = running_sums(jnp.where(q.open, q.touching, 0)[None].astype(zero.dtype))[0]
        index = _counting(BINS + 2)
        first = jnp.min(jnp.where(q.open, index, BINS + 1))
        piece = q.open & ((ends <= room) | (index == first))
        found, at, cost = _sweep(measurements, room, q, piece, cbar2, interval)
        better = found & (ends[first] <= room) & (-cost > best)
        best, witness = jnp.where(better, -cost, best), jnp.where(better, at, witness)
        q = q._replace(upper=jnp.where(piece, -jnp.inf, q.upper), gain=jnp.maximum(q.gain, best))
        return q, best, witness

    _, best, witness = lax.while_loop(remains, once, (narrowed, zero, zero))
    return best, witness


def most_ends(count: int) -> int:
    """Count the ends that are swept at once: 32 sweeps would do for all of them, up to 8 million."""
    return min(max(count // 16, BINS), 1 << 19)


class Intervals(NamedTuple):
    """The intervals of some measurements on an axis, measured from a centre."""

    offset: Float[Array, " k"]
    bound: Float[Array, " k"]
    begin: Float[Array, " k"]  # as numbers, not from the centre
    end: Float[Array, " k"]
    first: Int[Array, " k"]  # bin where it begins
    last: Int[Array, " k"]
    voters: Bool[Array, " k"]

    def moments(self, cbar2: Array) -> tuple[Array, ...]:
        """Compute weight, weight d, and what weight d^2 is above the truncation; zero without a vote."""
        weight = jnp.where(self.voters, 1 / self.bound**2, 0)
        first = weight * self.offset
        return weight, first, first * self.offset - jnp.where(self.voters, cbar2, 0)


def _intervals(measured: Measured, q: Question, cbar2: Array) -> Intervals:
    values, bounds, voters = measured
    voters = voters & jnp.isfinite(values) & jnp.isfinite(bounds)
    values, bounds = jnp.where(voters, values, 0), jnp.where(voters, bounds, 1)
    reach = jnp.sqrt(cbar2) * bounds
    begin, end = values - reach, values + reach
    return Intervals(values - q.centre, bounds, begin, end, q.axis.bin(begin), q.axis.bin(end), voters)


def _histogram(measurements: MeasurementRows, rows: Int[Array, ""], q: Question, cbar2: Array) -> Histogram:
    c, edges = jnp.sqrt(cbar2), q.axis.edges()
    zeros, counts = jnp.zeros(BINS + 2, edges.dtype), jnp.zeros(BINS + 2, jnp.int32)
    empty = Histogram((zeros,) * 3, (zeros,) * 3, counts, counts, zeros, zeros[:4], zeros[:3])
    # Bin b lies between around[b] and around[b + 1]; what begins below or ends above gains nothing.
    around = jnp.concatenate([-jnp.inf * jnp.ones_like(edges[:1]), edges, jnp.inf * edges[:1]])

    def gain(inside: Array, bound: Array) -> Array:
        """Compute the most that an interval gains within a distance of its end."""
        return cbar2 - jnp.maximum(c - jnp.maximum(inside, 0) / bound, 0) ** 2

    def add(k: Array, sums: Histogram) -> Histogram:
        at = _intervals(measurements.row(k), q, cbar2)
        put = lambda to, where, what: to.at[where].add(what, mode="promise_in_bounds")
        apart = at.first < at.last
        moments = at.moments(cbar2)
        here = at.voters & (at.begin <= q.centre) & (q.centre <= at.end)
        central = jnp.stack([jnp.sum(jnp.where(here, x, 0)) for x in (*moments, jnp.ones_like(at.bound))])
        moments = tuple(jnp.where(apart, x, 0) for x in moments)
        one = at.voters.astype(jnp.int32)
        rising = jnp.where(at.voters, gain(around[at.first + 1] - at.begin, at.bound), 0)
        falling = jnp.where(at.voters & apart, gain(at.end - around[at.last], at.bound), 0)
        return Histogram(
            entering=tuple(put(x, at.first, m) for x, m in zip(sums.entering, moments, strict=True)),
            leaving=tuple(put(x, at.last, m) for x, m in zip(sums.leaving, moments, strict=True)),
            begun=put(sums.begun, at.first, one),
            ended=put(sums.ended, at.last, one),
            partial=put(put(sums.partial, at.first, rising), at.last, falling),
            central=sums.central + central,
            sizes=sums.sizes + jnp.stack([jnp.sum(jnp.abs(x)) for x in moments]),
        )

    return lax.fori_loop(jnp.int32(0), rows, add, empty)


def _bounds(h: Histogram, q: Question, cbar2: Array, interval: tuple[Any, Any]) -> Question:
    """Bound the gain by a histogram: in each bin the most possible, anywhere the most met."""
    edges, dtype = q.axis.edges(), q.centre.dtype
    counted = [x[None].astype(dtype) for x in (h.begun, h.ended)]
    entering = jnp.concatenate([jnp.stack(h.entering), counted[0]])
    leaving = jnp.concatenate([jnp.stack(h.leaving), counted[1]])
    begun, ended, touching = running_sums(entering), running_sums(leaving), h.begun + h.ended

    def gain_at(sums: Array, low: Array | float, high: Array | float) -> tuple[Array, Array, Array]:
        """Compute the most that one set gains anywhere in a range, where, and how wrong that may be.

        Running sums cancel, the more so the larger the terms are that came and went before.
        """
        mass, first, excess, _ = sums
        top = jnp.clip(jnp.where(mass > 0, first / jnp.where(mass > 0, mass, 1), 0), low, high)
        lost = h.sizes[0] * top * top + 2 * h.sizes[1] * jnp.abs(top) + h.sizes[2]
        return 2 * top * first - top * top * mass - excess, top, 1e3 * jnp.finfo(dtype).eps * lost

    # From below: the sets at the edges are consensus sets, and so is that at the centre, where
    # nothing cancels.
    sets = jnp.concatenate([h.central[:, None], (begun - ended)[:, :-2]], axis=1)
    gains, means, lost = gain_at(sets, -jnp.inf, jnp.inf)
    low, high = interval[0] - q.centre, interval[1] - q.centre
    gains = jnp.where((sets[3] > 0.5) & (means >= low) & (means <= high), gains, -jnp.inf)
    gains = jnp.concatenate([gains[:1], gains[1:] - lost[1:]])
    best = first_smallest(-gains)
    better = gains[best] > q.gain

    # From above: what covers a bin began before it and ends after it. Within an interval a set may
    # have its estimate in another bin than it lasts in, so there every end may gain all it can.
    free = (interval[0] <= 0) & (interval[1] == jnp.inf)
    left, right = edges[:-1] - q.centre, edges[1:] - q.centre
    upper, _, lost = gain_at(
        begun[:, :-2] - ended[:, 1:-1], jnp.where(free, left, low), jnp.where(free, right, high)
    )
    upper += jnp.where(free, h.partial, cbar2 * touching.astype(dtype))[1:-1]
    upper = lost + jnp.where((sets[3, 1:] > 0.5) | (touching[1:-1] > 0), upper, -jnp.inf)
    outside = jnp.full(1, -jnp.inf, dtype)
    own = entering - leaving
    return q._replace(
        upper=jnp.concatenate([outside, upper, outside]),
        touching=touching,
        own=own.at[2].add(cbar2 * own[3]),
        gain=jnp.where(better, gains[best], q.gain),
        where=jnp.where(better, means[best] + q.centre, q.where),
        passes=q.passes + 1,
    )


def _sweep(
    measurements: MeasurementRows,
    room: int,
    q: Question,
    piece: Bool[Array, " b"],
    cbar2: Array,
    interval: tuple[Any, Any],
) -> tuple[Bool[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Find the best set that lasts in some of the bins, from the ends inside them: ``best_set``."""

    def collect(k: Array, found: tuple[Array, Array]) -> tuple[Array, Array]:
        ids, count = found
        at = _intervals(measurements.row(k), q, cbar2)
        inside = jnp.concatenate([piece[at.first] & at.voters, piece[at.last] & at.voters])
        ranks = rank(inside)
        slot = jnp.where(inside, count + ranks - 1, room)
        # A beginning is kept as 1 + its running number, an ending as the negative; 0 is empty.
        number = (
            1 + k.astype(jnp.int64) * measurements.length + _counting(measurements.length).astype(jnp.int64)
        )
        ids = ids.at[slot].set(jnp.concatenate([number, -number]), mode="drop")
        return ids, count + ranks[-1]

    none = jnp.zeros(room, jnp.int64), jnp.zeros((), jnp.int32)
    ids, _ = lax.fori_loop(jnp.int32(0), jnp.int32(measurements.rows), collect, none)
    taken, begins, number = ids != 0, ids > 0, jnp.maximum(jnp.abs(ids) - 1, 0)
    whose, which = (
        (number // measurements.length).astype(jnp.int32),
        (number % measurements.length).astype(jnp.int32),
    )
    at = _intervals(measurements.recall(whose, which), q, cbar2)
    sign = jnp.where(taken, jnp.where(begins, 1, -1), 0).astype(q.centre.dtype)
    weight = 1 / at.bound**2
    own = jnp.stack([weight, weight * at.offset, weight * at.offset**2, jnp.ones_like(weight)]) * sign[None]
    value = jnp.where(taken, jnp.where(begins, at.begin, at.end), jnp.inf)
    # All other bins stand in the sweep as one step each, at the edge where they end.
    steps = jnp.where(piece, 0, q.own)[:, :-1]
    ends = jnp.concatenate([value, q.axis.edges()]) - q.centre
    order = argsort(ends)
    sums = running_sums(jnp.concatenate([own, steps], axis=1)[:, order])
    candidates = jnp.concatenate([taken, piece[1:]])[order]
    found, witness, cost = best_set(
        ends[order], sums, q.centre, cbar2=cbar2, criterion="tls", interval=interval, candidates=candidates
    )
    return found, witness + q.centre, cost


def _counting(n: int) -> Int[Array, " n"]:
    return jnp.arange(n, dtype=jnp.int32)
