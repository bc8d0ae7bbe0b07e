"""The rotation by a search over pairs of measurements: for what graduated non-convexity cannot reach.

Two right measurements fix a rotation. So all pairs are tried, each hypothesis is scored by the truncated
cost (12) over all measurements, and the best few are fitted to their own inliers again and again. At 90 %
wrong measurements it finds what GNC misses, and it is never worse: GNC's answer is one of the candidates.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.ground import bits
from teaser_jax.ground.loops import until_settled
from teaser_jax.ground.numbers import as_record, named
from teaser_jax.stages.rotation.gnc import Gnc
from teaser_jax.stages.rotation.quadratic_form import Measurements

POLISH_ROUNDS = 50
# All pairs of up to 512 measurements. Of more, each is paired with as many of its successors as fit.
HYPOTHESES = 131_072
BLOCK = 128
CANDIDATES = 16


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class PairSearch:
    """Find the rotation by GNC, then try all pairs of TIMs: for more wrong TIMs than GNC bears.

    Attributes:
        gnc: How GNC finds the first candidate.
    """

    name: str = named("global")
    gnc: Gnc = Gnc()
    needs_host: ClassVar[bool] = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "gnc", as_record("PairSearch.gnc", self.gnc, {Gnc.name: Gnc}))

    def turn(self, m: Measurements) -> Float[Array, "3 3"]:
        """Find the turn from the frame of the measurements to the best rotation that the pairs lead to."""
        return search_pairs(m)


class Candidates(NamedTuple):
    """The best hypotheses so far, as turns from the frame of the measurements, and their costs."""

    turns: Float[Array, "t 3 3"]
    costs: Float[Array, " t"]


def polish(m: Measurements) -> Float[Array, "3 3"]:
    """Find the turn from the candidate to the best rotation met when fitting inliers again and again.

    A local minimum of (12) is least squares on its own inliers, and only such a one can be certified.
    """

    class State(NamedTuple):
        turn: Array
        best: Array
        cost: Array
        inliers: Array
        is_first: Array

    def fit(state: State) -> tuple[State, Array]:
        inliers = m.turned(state.turn).inliers
        weights = inliers.astype(m.src.dtype)[:, None]
        fitted = so3.nearest_rotation(jnp.matmul((weights * m.dst).T, m.src, precision=lax.Precision.HIGHEST))
        cost = m.turned(fitted).cost
        better = cost < state.cost
        best, least = jnp.where(better, fitted, state.best), jnp.where(better, cost, state.cost)
        settled = jnp.all(inliers == state.inliers) & ~state.is_first
        return State(fitted, best, least, inliers, jnp.zeros((), bool)), settled

    eye = jnp.eye(3, dtype=m.src.dtype)
    start = State(eye, eye, m.cost, m.inliers, jnp.ones((), bool))
    return until_settled(fit, start, iterations=POLISH_ROUNDS)[0].best


def search_pairs(m: Measurements) -> Float[Array, "3 3"]:
    """Find the turn from the candidate to the best rotation that pairs lead to, its own minimum included.

    Args:
        m: Measurements in the frame of a candidate, in units of their bounds. Two right ones are needed.

    Returns:
        A rotation whose cost is not above that of ``polish(m)``. That it is the optimum is not proved here.

    Gradients: none; inputs must be stopped by the caller.
    """
    eye = jnp.eye(3, dtype=m.src.dtype)
    best = pair_hypotheses(m)
    turns = jnp.concatenate([eye[None], best.turns])

    def descend(turn: Array) -> tuple[Array, Array]:
        from_there = m.turned(turn)
        further = polish(from_there)
        return jnp.matmul(turn, further, precision=lax.Precision.HIGHEST), from_there.turned(further).cost

    turns, costs = jax.vmap(descend)(turns)
    return turns[jnp.argmin(costs)]


def pair_hypotheses(m: Measurements) -> Candidates:
    """Find the best rotations that carry two source vectors on the two of the target, by the truncated cost.

    The frame of a pair is its bisector and its normal, so that both measurements share the error.
    """
    count = jnp.sum(m.mask, dtype=jnp.int32)
    order = bits.listed(m.mask)
    successors = jnp.minimum(count // 2, HYPOTHESES // jnp.maximum(count, 1))
    total = count * successors
    products = (m.dst[:, :, None] * m.src[:, None, :]).reshape(-1, 9)
    lengths = jnp.sum(m.src**2, axis=1) + jnp.sum(m.dst**2, axis=1)
    some = jnp.maximum(count, 1)

    def score(turns: Array) -> Array:
        inner = jnp.matmul(turns.reshape(-1, 9), products.T, precision=lax.Precision.HIGHEST)
        return jnp.sum(jnp.where(m.mask[None], jnp.minimum(lengths[None] - 2 * inner, m.cbar2), 0), axis=1)

    def visit(block: Int[Array, ""], best: Candidates) -> Candidates:
        number = block * BLOCK + jnp.arange(BLOCK, dtype=jnp.int32)
        first = number % some
        second = (first + 1 + number // some) % some
        i, j = order[first], order[second]
        source, real = _frames(m.src[i], m.src[j])
        target, also = _frames(m.dst[i], m.dst[j])
        turns = jnp.einsum("mik,mjk->mij", target, source, precision=lax.Precision.HIGHEST)
        costs = jnp.where(real & also & (number < total), score(turns), jnp.inf)
        turns, costs = jnp.concatenate([best.turns, turns]), jnp.concatenate([best.costs, costs])
        low, where = lax.top_k(-costs, CANDIDATES)
        return Candidates(turns[where], -low)

    eye = jnp.broadcast_to(jnp.eye(3, dtype=m.src.dtype), (CANDIDATES, 3, 3))
    nothing = Candidates(eye, jnp.full(CANDIDATES, jnp.inf, m.src.dtype))
    return lax.fori_loop(0, (total + BLOCK - 1) // BLOCK, visit, nothing)


def _frames(
    a: Float[Array, "m 3"], b: Float[Array, "m 3"]
) -> tuple[Float[Array, "m 3 3"], Bool[Array, " m"]]:
    """Make orthonormal columns of bisector and normal of two vectors, and tell whether these are fixed."""

    def unit(x: Array) -> tuple[Array, Array]:
        length = jnp.sqrt(jnp.sum(x * x, axis=1, keepdims=True))
        enough = length > 1e-4
        return x / jnp.where(enough, length, 1), enough[:, 0]

    (a, some_a), (b, some_b) = unit(a), unit(b)
    (x, some_x), (z, some_z) = unit(a + b), unit(jnp.cross(a, b))
    return jnp.stack([x, jnp.cross(z, x), z], axis=2), some_a & some_b & some_x & some_z
