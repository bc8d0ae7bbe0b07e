"""How many poses with as many inliers would wrong matches produce by themselves?"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.scipy.special import xlogy
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.ground import bits
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem

# Chance is asked within the bound and within half of it, as most errors are well below the largest. Of 133
# right real answers 122 are ok within the bound alone and 130 with both, of right ones from four to seven
# matches 39 % and 62 %; of 1 919 problems without a right match none.
SHARES_OF_BOUND = (1.0, 0.5)


def log_false_alarms(
    problem: Problem,
    pose: Pose,
    inliers: Bool[Array, " n"],
    squared_residuals: Float[Array, " n"],
    degrees: Int[Array, " n"],
) -> Float[Array, ""]:
    """Estimate the log of the expected number of poses with as many inliers if all matches were wrong.

    Three matches that agree on their distances make a pose; the rest of its inliers must come by
    chance. So: the number of triangles in a random graph of the same degrees, times the
    probability that such a pose collects as many further inliers, from the counts of poses
    through one match turned at random. These counts vary more than a Poisson law allows where
    matches crowd together, so their mean and variance set a negative binomial, whose tail is
    bounded by Chernoff. Both are counted within the bound and within half of it, and the rarer of the two
    counts, at the price of two questions.

    Args:
        problem: Clean.
        pose: The candidate.
        inliers: The matches that it explains.
        squared_residuals: Of all matches [bounds squared].
        degrees: In the consistency graph, copies left out.

    References: a-contrario reasoning after Moisan and Stival, IJCV 2004; Chung and Lu for the graph.
    """
    dtype = problem.src.dtype
    counts = chance_inliers(problem, pose, inliers).astype(dtype)
    # One hit more than seen: some dozens of poses cannot prove that chance never hits.
    mean = (jnp.sum(counts, axis=1) + 1) / len(TURNS)
    excess = jnp.maximum(jnp.mean((counts - mean[:, None]) ** 2, axis=1) - mean, 1e-3 * mean)
    shape = mean**2 / excess
    within = [inliers & (squared_residuals <= share**2 * problem.cbar2) for share in SHARES_OF_BOUND]
    found = jnp.stack([jnp.sum(x, dtype=jnp.int32) for x in within])
    further = jnp.maximum(found - 3, 0).astype(dtype)
    tail = xlogy(further, further / mean) - (further + shape) * jnp.log((further + shape) / (mean + shape))
    rarest = jnp.max(jnp.where(further > mean, tail, 0))
    degree = degrees.astype(dtype)
    ends = jnp.maximum(jnp.sum(degree), 1)
    # (sum d^2)^3 / (6 (sum d)^3), scaled to stay finite in float32.
    triangles = (jnp.sum(degree * (degree / ends)) ** 3) / 6
    return jnp.log(jnp.maximum(triangles, 1)) - rarest + float(np.log(len(SHARES_OF_BOUND)))


def chance_inliers(problem: Problem, pose: Pose, inliers: Bool[Array, " n"]) -> Int[Array, "s k"]:
    """Count the further matches that agree with poses through one inlier, turned evenly over SO(3).

    Each share of the bound is a row.

    Inliers that huddle within the noise stay together whatever the turn, and many-to-one matches
    too: they count as chance, as they should.
    """
    src, dst, mask = problem.src, problem.dst, problem.mask
    if src.shape[0] == 0:
        return jnp.zeros((len(SHARES_OF_BOUND), len(TURNS)), jnp.int32)
    which = jnp.arange(len(TURNS), dtype=jnp.int32) % jnp.maximum(jnp.sum(inliers, dtype=jnp.int32), 1)
    pivots = bits.listed(inliers)[which]
    # From the first pivot, so that no digits are lost far from the origin.
    x, y = (points.T - points[pivots[0]][:, None] for points in (src, dst))
    a, b, entries = x[:, pivots], y[:, pivots], jnp.asarray(TURNS, src.dtype)
    # Component by component: pairs of turns and matches are met in one pass and never stored. The barrier
    # keeps what belongs to a turn alone out of that pass, where a GPU would find it anew for every match.
    turned = [
        sum(entries[:, i, k] * pose.rotation[k, j] for k in range(3)) for i in range(3) for j in range(3)
    ]
    by_turn = pose.scale * jnp.stack(turned).reshape(3, 3, -1)
    offset = jnp.stack([b[i] - sum(by_turn[i, j] * a[j] for j in range(3)) for i in range(3)])
    by_turn, offset = lax.optimization_barrier((by_turn, offset))
    residual2 = jnp.zeros((), src.dtype)
    for i in range(3):
        moved = sum(by_turn[i, j][:, None] * x[j][None] for j in range(3))
        residual2 += (y[i][None] - offset[i][:, None] - moved) ** 2
    reach2 = jnp.where(mask, problem.cbar2 * problem.noise_bound**2, -1)
    agree = [(residual2 <= (share**2 * reach2)[None]).astype(jnp.int32) for share in SHARES_OF_BOUND]
    # One pass for all: sums apart would find the residuals anew.
    zeros = [jnp.zeros((), jnp.int32)] * len(agree)
    counts = lax.reduce(agree, zeros, lambda x, y: [a + b for a, b in zip(x, y, strict=True)], (1,))
    return jnp.stack(counts) - mask[pivots].astype(jnp.int32)[None]


def _even_rotations(count: int, smallest_angle: float) -> np.ndarray:
    """Spread rotations evenly over SO(3) by the super-Fibonacci spiral (Alexa, CVPR 2022), no small ones."""
    s = np.arange(count) + 0.5
    inner, outer = np.sqrt(s / count), np.sqrt(1 - s / count)
    alpha, beta = 2 * np.pi * s / np.sqrt(2), 2 * np.pi * s / 1.533751168755204288118041
    quats = [inner * np.sin(alpha), inner * np.cos(alpha), outer * np.sin(beta), outer * np.cos(beta)]
    rotations = so3.rotation_from_quat(np.stack(quats, axis=1))
    return rotations[so3.rotation_angle(rotations) > smallest_angle]


# Turns away from a candidate: large enough that its own inliers do not come along.
TURNS = _even_rotations(70, np.deg2rad(45.0))
