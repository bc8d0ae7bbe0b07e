"""Whether an answer deserves trust: is the pose determined, and is its consensus more than chance?

A maximum clique always exists, also when every match is wrong. Three questions separate an answer
from an accident. Would the cost notice if the pose turned? How many poses with as many inliers
would wrong matches produce by themselves? Did the clique's members find a place in one pose at
all, or only in its mirror image, or at another scale? The thresholds were set on synthetic and
real problems, right and wrong; ``benchmarks/trust.py`` measures what they are worth.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax import so3
from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem
from teaser_jax.rows import keys
from teaser_jax.solution import Status
from teaser_jax.stages.chance import log_false_alarms
from teaser_jax.stages.position import matched_by_position
from teaser_jax.stages.refinement import Fit, fit_similarity, squared_residuals

# A turn by this angle must cost at least what one outlier costs.
SMALLEST_TURN = np.deg2rad(20.0)
# A true consensus falls apart in no pose: on real pairs 0.39 - 0.8 of the clique stays, of a
# mirrored cloud 0 - 0.2 (0.3 where the noise bound is a sixth of the object).
LEAST_SHARE_OF_CLIQUE = 0.25
# A reflection may agree with so many times the members of the clique that the pose agrees with: in a
# plane both agree with all. On the real pairs mirrored it agreed with 1.3 times as many and more (with
# equally many on one flat wall), on the same pairs as they are with 0.3 times as many at most.
MOST_SHARE_OF_MIRROR = 1.25
# So many matches of a clique, and half of it, must a reflection explain for the clouds to be mirror images.
LEAST_MIRRORED = 8
# Another scale than the known one, fitted to the inliers, may explain so many times as many: with a scale
# forgotten (1.2 to 2, or their inverses) 1.5 to 40 times, unless nearly all lie within the bound as it is;
# on real pairs at most 1.12 times.
MOST_SHARE_OF_OTHER_SCALE = 1.25
# How far refinement may carry a scale out of the range it was looked for in.
SCALE_SLACK = 0.02
# Poses by chance that are tolerated, as a natural logarithm: one in a hundred.
LARGEST_LOG_FALSE_ALARMS = float(np.log(1e-2))


class Evidence(NamedTuple):
    """What speaks for a pose and against it; answers can be ranked by it.

    Attributes:
        usable: Matches that can be used at all.
        members: Matches in the clique.
        inliers: Matches that the pose explains.
        distinct: Points among them, of the source or of the target, whichever are fewer: many matches of one
            point are one piece of evidence.
        is_determined: Whether they fix the rotation, and with it the scale.
        log_false_alarms: How many poses with as many inliers chance would give, as a logarithm.
        has_collapsed: Whether most members of the clique found no place in the pose.
        is_mirrored: Whether a reflection explains the clique better.
        by_reflection: Members of the clique that it explains.
        by_fit: Matches that the inliers' own fit explains, at the known scale where there is one.
        by_other_scale: Matches that it explains at the scale that suits the inliers best.
        has_left_range: Whether an unknown scale left the range it was looked for in.
        has_settled: Whether every iteration settled.
        is_by_position: Whether the matches that the pose leaves out are nearest neighbours as given.
    """

    usable: Int[Array, ""]
    members: Int[Array, ""]
    inliers: Int[Array, ""]
    distinct: Int[Array, ""]
    is_determined: Bool[Array, ""]
    log_false_alarms: Float[Array, ""]
    has_collapsed: Bool[Array, ""]
    is_mirrored: Bool[Array, ""]
    by_reflection: Int[Array, ""]
    by_fit: Int[Array, ""]
    by_other_scale: Int[Array, ""]
    has_left_range: Bool[Array, ""]
    has_settled: Bool[Array, ""]
    is_by_position: Bool[Array, ""]


def evidence_of(
    problem: Problem,
    pose: Pose,
    fit: Fit,
    inliers: Bool[Array, " n"],
    clique: Bool[Array, " n"],
    edge_bits: UInt32[Array, "n w"],
    *,
    has_settled: Bool[Array, ""],
    pruned: bool = True,
    scale_range: tuple[Any, Any] = (0.0, float("inf")),
    offset: Float[AnyArray, "3"] | None = None,
) -> Evidence:
    """Collect what speaks for a pose and against it.

    Args:
        problem: Clean.
        pose: The candidate, from the source to the target frame.
        fit: The fit to its inliers, at the known scale where there is one.
        inliers: The matches that it explains.
        clique: The clique it came from.
        edge_bits: The consistency graph.
        has_settled: Whether every iteration settled.
        pruned: Whether ``clique`` is one.
        scale_range: Where an unknown scale was looked for [-].
        offset: What to add to the source, as the clouds stand here, to compare it with the target in the
            frames as given [length]; None: nothing.

    Gradients: none; inputs must be stopped by the caller.
    """
    dtype = problem.src.dtype
    members, agreeing = jnp.sum(clique, dtype=jnp.int32), jnp.sum(inliers, dtype=jnp.int32)
    distinct = jnp.minimum(*(count_distinct(x, inliers) for x in (problem.src, problem.dst)))
    fewest = LEAST_SHARE_OF_CLIQUE * members.astype(dtype)
    no = jnp.zeros((), bool)
    by_reflection = explained_by_reflection(problem, clique)
    by_pose = jnp.sum(clique & inliers, dtype=jnp.int32)
    r2 = squared_residuals(pose, problem.src, problem.dst, problem.noise_bound)
    low, high = scale_range
    outside = (pose.scale < (1 - SCALE_SLACK) * low) | (pose.scale > (1 + SCALE_SLACK) * high)
    return Evidence(
        usable=jnp.sum(problem.mask, dtype=jnp.int32),
        members=members,
        inliers=agreeing,
        distinct=distinct,
        is_determined=is_determined(problem, pose, inliers, fit),
        log_false_alarms=log_false_alarms(problem, pose, inliers, r2, bits.count(edge_bits)),
        has_collapsed=agreeing.astype(dtype) < fewest if pruned else no,
        is_mirrored=by_reflection.astype(dtype) > MOST_SHARE_OF_MIRROR * by_pose.astype(dtype),
        by_reflection=by_reflection,
        by_fit=count_explained(problem, fit.pose),
        by_other_scale=count_explained(problem, at_own_scale(fit)),
        has_left_range=outside if problem.scale is None else no,
        has_settled=has_settled,
        is_by_position=matched_by_position(
            problem.src, problem.dst, r2, problem.mask, cbar2=problem.cbar2, offset=offset
        ),
    )


def status_of(evidence: Evidence) -> Int[Array, ""]:
    """Give the verdict: the status of the first question that the evidence fails, or OK."""
    e = evidence
    # Few wrong matches that agree pairwise are mirrored as often as not; many have a cause.
    half = (2 * e.by_reflection >= e.members) & (e.by_reflection >= LEAST_MIRRORED)
    most = MOST_SHARE_OF_OTHER_SCALE * jnp.maximum(e.inliers, e.by_fit).astype(jnp.float32)
    has_other_scale = e.by_other_scale.astype(jnp.float32) > most
    by_chance = (e.distinct <= 3) | (e.log_false_alarms > LARGEST_LOG_FALSE_ALARMS)
    questions = (
        (e.usable < 3, Status.TOO_FEW_POINTS),
        (e.is_mirrored & half, Status.MIRRORED),
        (e.is_by_position, Status.BY_POSITION),
        # Three matches that agree on their distances always make a pose: they are no evidence.
        ((e.members < 3) | (e.inliers <= 3) | e.has_left_range, Status.NO_CONSENSUS),
        (~e.is_determined, Status.DEGENERATE),
        (by_chance | e.has_collapsed | e.is_mirrored | has_other_scale, Status.NO_CONSENSUS),
        (~e.has_settled, Status.NOT_CONVERGED),
    )
    verdict = jnp.int32(Status.OK)
    for failed, status in reversed(questions):
        verdict = jnp.where(failed, jnp.int32(status), verdict)
    return verdict


def explained_by_reflection(problem: Problem, clique: Bool[Array, " n"]) -> Int[Array, ""]:
    """Count the members of the clique that the best reflection explains.

    Lengths do not tell left from right, so a mirrored cloud makes as large a clique as a right one; its
    flat parts then fit a rotation by themselves.
    """
    weights = jnp.where(clique, 1 / problem.noise_bound**2, 0)
    reflection = fit_similarity(-problem.src, problem.dst, weights, problem.scale).pose
    r2 = squared_residuals(reflection, -problem.src, problem.dst, problem.noise_bound)
    return jnp.sum(clique & (r2 <= problem.cbar2), dtype=jnp.int32)


def count_distinct(points: Float[Array, "n 3"], chosen: Bool[Array, " n"]) -> Int[Array, ""]:
    """Count the chosen points, exact copies once.

    Each is sent to a slot by a hash of its coordinates. Two different points in one slot count as one: of few
    hardly ever, of all one in eight.
    """
    width = max(12, (4 * points.shape[0]).bit_length())
    slot = (keys(points.T) >> (31 - width)).astype(jnp.int32)
    taken = jnp.zeros(1 << width, bool).at[jnp.where(chosen, slot, 1 << width)].set(True, mode="drop")
    return jnp.sum(taken, dtype=jnp.int32)


def at_own_scale(fit: Fit) -> Pose:
    """Give the pose of a fit at the scale that suits it: rotation and mean of the points stay.

    Where the known scale is wrong, matches that lie close together agree within their bounds all the same and
    tell the right one.
    """
    rotation, translation, scale = fit.pose.rotation, fit.pose.translation, fit.own_scale
    moved = (fit.pose.scale - scale) * jnp.sum(rotation * fit.src_mean[None], axis=1)
    return Pose(rotation, translation + moved, scale)


def count_explained(problem: Problem, pose: Pose) -> Int[Array, ""]:
    """Count the matches that a pose explains."""
    r2 = squared_residuals(pose, problem.src, problem.dst, problem.noise_bound)
    return jnp.sum((r2 <= problem.cbar2) & problem.mask, dtype=jnp.int32)


def is_determined(problem: Problem, pose: Pose, inliers: Bool[Array, " n"], fit: Fit) -> Bool[Array, ""]:
    """Tell whether the inliers fix the rotation (and with it the scale).

    Turning the pose by an angle about its weakest axis raises the cost (6) by
    2 s (1 - cos angle)(tr M - largest eigenvalue of M), with M = R^T H the symmetric part of the
    turned-back correlation: a line has nothing left, a mirror image subtracts it. Weights are those
    of the fit, the largest confidence counting as one: where two matches have all the weight, the
    rest cannot hold the pose. And a source that shrinks into the noise (s times its radius within
    c beta) agrees with every rotation.
    """
    most = jnp.max(jnp.where(inliers, problem.confidence, 0), initial=0)
    turned = jnp.sum(pose.rotation[:, :, None] * fit.correlation[:, None, :], axis=0)
    left = jnp.trace(turned) - so3.largest_eigenvalue((turned + turned.T) / 2)
    rise = float(2 * (1 - np.cos(SMALLEST_TURN))) * pose.scale * left / jnp.where(most > 0, most, 1)
    radius2 = jnp.where(inliers, jnp.sum((problem.src - fit.src_mean[None]) ** 2, axis=1), 0)
    reach2 = jnp.where(inliers, problem.cbar2 * problem.noise_bound**2, jnp.inf)
    extended = pose.scale**2 * jnp.max(radius2, initial=0) > jnp.min(reach2, initial=jnp.inf)
    return (rise >= problem.cbar2) & extended
