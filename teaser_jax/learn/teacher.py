"""The solver as a teacher: poses and inlier labels for pairs of scans, and which of them to trust."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.learn.matching import as_float, check_positive
from teaser_jax.pose import Pose
from teaser_jax.problem import make_problem
from teaser_jax.settings import Settings
from teaser_jax.solve import solve

ON_DEVICE = Settings(clique="greedy")  # no host call inside a training step


@partial(
    jax.tree_util.register_dataclass, data_fields=["pose", "inliers", "trusted", "status"], meta_fields=[]
)
@dataclass(frozen=True)
class Labels:
    """What a teacher says of each pair. Constants: no gradient flows into them.

    Attributes:
        pose: ``T_dst_src``.
        inliers: Matches that the pose explains.
        trusted: Whether to learn from this pair.
        status: A ``Status`` as int32, for statistics.
    """

    pose: Pose
    inliers: Bool[Array, "*batch n"]
    trusted: Bool[Array, "*batch"]
    status: Int[Array, "*batch"]


def teacher(
    src: Float[Array, "*batch n 3"],
    dst: Float[Array, "*batch n 3"],
    *,
    noise_bound: float | Float[Array, "..."],
    scale: float | Float[Array, ""] | None = 1.0,
    mask: Bool[Array, "*batch n"] | None = None,
    confidence: Float[Array, "*batch n"] | None = None,
    settings: Settings = ON_DEVICE,
    least_inliers: int | Int[Array, ""] = 0,
) -> Labels:
    """Solve every pair of a batch and say which answers to learn from.

    A pair is trusted where its status is OK and its pose explains ``least_inliers`` matches or more. OK
    alone is a high bar already (see ``benchmarks/RESULTS.md``): what labels by chance teach, a network
    does again.

    Args:
        src, dst: Matched points, with any leading batch axes.
        noise_bound: Largest error of a right match [length], one number or one a match.
        scale: Known scale [-], or None: estimate it.
        mask: Matches to use; None: all.
        confidence: Weights of the matches in the pose; None: 1.
        settings: Of ``solve``. The default stays on the device; ``clique="exact"`` asks the host.
        least_inliers: Further matches to ask for.

    Returns:
        Labels with the batch axes of ``src``.

    Raises:
        ValueError: On shapes that do not fit, and on bounds outside jit that are not above 0. Other numbers
            that make no sense end in a status, pair by pair.

    Gradients: none, on purpose; differentiate ``solve`` or ``soft_solve`` to learn through the solver.

    References: Yang, Dong, Carlone, Koltun, Self-supervised Geometric Perception, CVPR 2021.
    """
    if src.shape != dst.shape or src.ndim < 2 or src.shape[-1] != 3:
        raise ValueError(
            f"src has shape {src.shape} and dst {dst.shape}: expected the same (..., n, 3), row i of src "
            "matched with row i of dst."
        )
    if jnp.ndim(least_inliers) != 0:
        raise ValueError(f"least_inliers has shape {jnp.shape(least_inliers)}: expected one number.")
    src, dst = as_float(src), as_float(dst)  # integers would cut the bound
    batch = src.shape[:-1]
    check_positive(noise_bound=noise_bound)
    if jnp.shape(noise_bound) not in ((), batch[-1:], batch):
        raise ValueError(
            f"noise_bound has shape {jnp.shape(noise_bound)}: expected one number, or one a match, "
            f"{batch[-1:]} or {batch}."
        )
    mask = jnp.ones(batch, bool) if mask is None else jnp.broadcast_to(mask, batch)
    confidence = jnp.ones(batch, src.dtype) if confidence is None else jnp.broadcast_to(confidence, batch)
    bound = jnp.broadcast_to(jnp.asarray(noise_bound, src.dtype), batch)

    def one(src: Any, dst: Any, mask: Any, confidence: Any, bound: Any) -> Labels:
        problem = make_problem(
            src, dst, noise_bound=bound, scale=scale, mask=mask, confidence=confidence
        )  # fmt: skip
        found = solve(problem, settings)
        enough = jnp.sum(found.inliers, dtype=jnp.int32) >= least_inliers
        return Labels(found.pose, found.inliers, found.ok & enough, found.status)

    for _ in batch[:-1]:
        one = jax.vmap(one)
    return one(*lax.stop_gradient((src, dst, mask, confidence, bound)))
