"""Several answers to one set of matches, that differ, best first.

One maximum clique is one answer, and where structure repeats or little overlaps, a wrong one may be as large.
Here many answers start, each from a match and those that agree with it most; all of them are fitted to all
matches; what speaks for each is counted; and the best of those that differ are kept.

Of 186 hard problems (matches of real scans, crops of clouds, repeated structure) ``register`` is right in
125; the first answer from here in 129, one among the first five in 135.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, Placeholder
from teaser_jax.ground.masked import about_mean
from teaser_jax.ground.numbers import count, named, settle
from teaser_jax.pose import Pose
from teaser_jax.stages.rivals.evidence import evidence
from teaser_jax.stages.rivals.seeds import best_seeds, tight_graph, triangles

FEWEST = 3  # inliers that make an answer
# In bounds: matches that lie so near under another answer are its matches, too. 'Sharing less than half of
# the inliers' alone would call two copies of one pose rivals.
NEAR = 3.0
WIDE, NARROWER = 2.0, 0.5  # the first fit takes inliers within two bounds, each further one half a bound less


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class RivalSearch:
    """Look for several answers; all counts are static.

    Attributes:
        answers: How many to return at most.
        rows: How many matches to start from at most: the first that can be used, in the order given, so the
            clearest come first. All matches count as evidence. Memory and time grow with the square and the
            cube of it.
        seeds: How many answers to start. Fewer miss right ones.
        companions: How many of the matches that agree with a seed to begin with.
        rounds: How often each is fitted anew to the matches that it explains.
    """

    name: str = named("rivals")
    answers: int = count(12)
    rows: int = count(2048)
    seeds: int = count(256)
    companions: int = count(20)
    rounds: int = count(5)

    def __post_init__(self) -> None:
        settle(self)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Rivals:
    """Answers that differ, best first; those that are not valid come last.

    Attributes:
        pose: From the source to the target frame; the identity where it is not valid.
        inliers: Matches within their bounds, in the order given.
        score: What speaks for each [-]; 0 where it is not valid.
        valid: Which of them are answers.
    """

    pose: Pose
    inliers: Bool[AnyArray, "*batch k n"] | Placeholder
    score: Float[AnyArray, "*batch k"] | Placeholder
    valid: Bool[AnyArray, "*batch k"] | Placeholder


@jax.jit
def find_rivals(
    src: Float[Array, "n 3"],
    dst: Float[Array, "n 3"],
    noise_bound: Float[Array, " n"],
    mask: Bool[Array, " n"],
    *,
    scale: Float[Array, ""],
    search: RivalSearch,
    first: Bool[Array, "f n"] | None = None,
) -> Rivals:
    """Find several answers to one set of matches.

    Two are distinct if under each of them fewer than half of the other's inliers lie within three bounds.
    Deterministic; memory is that of a few tables of ``rows`` by ``rows`` and of ``seeds`` by n.

    Args:
        src, dst: Matches, row i with row i [length].
        noise_bound: beta_i, above 0 where the mask is set [length of the target].
        mask: Rows to use; the others may hold anything.
        scale: Known or voted [-].
        search: How much to look for.
        first: Sets of matches to start from, too, such as the maximum clique of the paper's graph.

    Gradients: none; inputs are stopped.

    References: fit by Horn, JOSA A 1987; triangles as in Chen et al., SC2-PCR, CVPR 2022.
    """
    src, dst, noise_bound, scale = lax.stop_gradient((src, dst, noise_bound, scale))
    n = mask.shape[0]
    if n == 0:
        one = [jnp.pad(x, ((0, 1), *((0, 0),) * (x.ndim - 1))) for x in (src, dst, noise_bound, mask)]
        found = find_rivals(*one, scale=scale, search=search)
        return replace(found, inliers=found.inliers[:, :0])
    scaled = jnp.where(mask[:, None], scale * src, 0)
    a, b = about_mean(scaled, mask), about_mean(dst, mask)
    bound = jnp.where(mask, noise_bound, 1)
    start = _start(a, b, bound, mask, search)
    if first is not None:
        start = jnp.concatenate([(first & mask[None]).astype(a.dtype), start])
    found = _fitted(start, a, b, bound, mask, search.rounds)
    inliers, near = (mask[None] & (found.r2 <= radius**2) for radius in (1.0, NEAR))
    size = jnp.sum(inliers, axis=1).astype(jnp.float32)
    shared = jnp.matmul(inliers.astype(jnp.float32), near.astype(jnp.float32).T)
    few = 2 * shared < size[:, None]
    begun = jnp.sum(start > 0, axis=1, dtype=jnp.int32) >= FEWEST
    score = jnp.where(begun & (size >= FEWEST), evidence(found.r2, a, b, bound, mask), 0)
    translation = (
        found.translation + _mean(dst, mask)[None] - _turned(found.rotation, _mean(scaled, mask)[None])
    )
    pose = Pose(found.rotation, translation, jnp.broadcast_to(scale, score.shape))
    return _best(Rivals(pose, inliers, score, score > 0), few & few.T, search.answers)


def _start(a: Array, b: Array, bound: Array, mask: Array, search: RivalSearch) -> Float[Array, "k n"]:
    """Weigh the matches that each answer starts from: a seed and its companions."""
    m = min(mask.shape[0], search.rows)
    rows = bits.listed(mask)[:m]
    used = jnp.arange(m, dtype=jnp.int32) < jnp.sum(mask, dtype=jnp.int32)
    edges = tight_graph(a[rows], b[rows], bound[rows], used)
    seeds = best_seeds(triangles(edges), seeds=search.seeds, companions=search.companions)
    each = jnp.arange(len(seeds.members), dtype=jnp.int32)[:, None]
    nothing = jnp.zeros((len(seeds.members), mask.shape[0]), a.dtype)
    return nothing.at[each, rows[seeds.members]].add(seeds.weights.astype(a.dtype))


class _Fitted(NamedTuple):
    """Poses of centred points, and the squared residuals of all matches under each, in squared bounds."""

    rotation: Float[Array, "k 3 3"]
    translation: Float[Array, "k 3"]
    r2: Float[Array, "k n"]


def _fitted(
    start: Float[Array, "k n"], a: Array, b: Array, bound: Array, mask: Array, rounds: int
) -> _Fitted:
    """Fit answers to what they start from, and again to what they explain, within bounds that grow narrow.

    Inliers count alike: weights that fall with the residual ended at the right pose less often.
    """

    def step(i: Array, state: tuple[Array, _Fitted]) -> tuple[Array, _Fitted]:
        weights, _ = state
        rotation, translation = _fits(weights, a, b)
        r2 = _apart(rotation, translation, a, b) / bound[None] ** 2
        radius = jnp.maximum(1, WIDE - NARROWER * i.astype(a.dtype))
        explained = mask[None] & (r2 <= radius**2)
        enough = jnp.sum(explained, axis=1, dtype=jnp.int32) >= FEWEST
        weights = jnp.where(enough[:, None], explained.astype(a.dtype), weights)
        return weights, _Fitted(rotation, translation, r2)

    k = len(start)
    nothing = _Fitted(*(jnp.zeros((k, *shape), a.dtype) for shape in ((3, 3), (3,), mask.shape)))
    return lax.fori_loop(0, rounds + 1, step, (start, nothing))[1]


def _fits(
    weights: Float[Array, "k n"], a: Float[Array, "n 3"], b: Float[Array, "n 3"]
) -> tuple[Float[Array, "k 3 3"], Float[Array, "k 3"]]:
    """Fit many poses to the same matches, weighted otherwise for each: all their sums are one product."""
    pairs = (b[:, :, None] * a[:, None]).reshape(-1, 9)
    columns = jnp.concatenate([jnp.ones_like(a[:, :1]), a, b, pairs], axis=1)
    sums = jnp.matmul(weights, columns, precision=lax.Precision.HIGHEST)
    sums = sums / jnp.where(sums[:, :1] > 0, sums[:, :1], 1)
    a_mean, b_mean = sums[:, 1:4], sums[:, 4:7]
    correlation = sums[:, 7:].reshape(-1, 3, 3) - b_mean[:, :, None] * a_mean[:, None]
    rotation = jax.vmap(so3.nearest_rotation)(correlation)
    return rotation, b_mean - _turned(rotation, a_mean)


def _apart(
    rotation: Float[Array, "k 3 3"], translation: Float[Array, "k 3"], a: Array, b: Array
) -> Float[Array, "k n"]:
    """Square the distances of matches under each pose, by components: that fuses into one pass."""
    axes = range(3)
    turned = [sum(rotation[:, i, j, None] * a[None, :, j] for j in axes) for i in axes]
    return jnp.asarray(sum((turned[i] + translation[:, i, None] - b[None, :, i]) ** 2 for i in axes))


def _turned(rotation: Float[Array, "... 3 3"], points: Float[Array, "... 3"]) -> Float[Array, "... 3"]:
    """Turn points, each by its own rotation or all by one."""
    return jnp.sum(rotation * points[..., None, :], axis=-1)


def _mean(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "3"]:
    """Find the mean of the points that the mask chooses."""
    total = jnp.sum(jnp.where(mask[:, None], points, 0), axis=0)
    return total / jnp.maximum(jnp.sum(mask, dtype=points.dtype), 1)


def _best(found: Rivals, distinct: Bool[Array, "k k"], answers: int) -> Rivals:
    """Take the best answer, then the best of those that are distinct from all taken, and so on."""
    own = jnp.arange(len(distinct), dtype=jnp.int32)

    def take(left: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        best = bits.first_smallest(jnp.where(left, -found.score, 1))
        return left & distinct[best] & (own != best), (best, left[best])

    _, (chosen, valid) = lax.scan(take, found.valid, None, length=answers)
    eye = jnp.eye(3, dtype=found.score.dtype)[None]
    pose = Pose(
        jnp.where(valid[:, None, None], found.pose.rotation[chosen], eye),
        jnp.where(valid[:, None], found.pose.translation[chosen], 0),
        found.pose.scale[chosen],
    )
    inliers = found.inliers[chosen] & valid[:, None]
    return Rivals(pose, inliers, jnp.where(valid, found.score[chosen], 0), valid)
