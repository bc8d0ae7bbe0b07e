"""The solver as a teacher: poses and inlier labels for pairs of scans, and which of them to trust."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, Real

from teaser_jax.ground.arrays import AnyArray, Number, Placeholder, at_least_float32
from teaser_jax.ground.checks import check_positive
from teaser_jax.pose import Pose
from teaser_jax.problem import make_problem
from teaser_jax.settings import Settings
from teaser_jax.solve import solve

ON_DEVICE = Settings(clique="greedy")  # no host call inside a training step


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Labels:
    """``Labels`` hold what a teacher says of each pair; no gradient flows into them.

    Attributes:
        pose: ``T_dst_src``.
        inliers: Matches that the pose explains.
        trusted: Whether to learn from this pair.
        status: A ``Status`` as int32, for statistics.
    """

    pose: Pose
    inliers: Bool[AnyArray, "... n"] | Placeholder
    trusted: Bool[AnyArray, "..."] | Placeholder
    status: Int[AnyArray, "..."] | Placeholder


def teacher(
    src: Real[AnyArray, "*batch n 3"],
    dst: Real[AnyArray, "*batch n 3"],
    *,
    noise_bound: Number | Float[AnyArray, "..."],
    scale: Number | Float[AnyArray, ""] | None = 1.0,
    mask: Bool[AnyArray, "..."] | None = None,
    confidence: Float[AnyArray, "..."] | None = None,
    settings: Settings = ON_DEVICE,
    least_inliers: int | Int[AnyArray, ""] = 0,
) -> Labels:
    """Solve every pair of a batch and say which answers to learn from.

    A pair is trusted where its status is OK and its pose explains ``least_inliers`` matches or more. OK
    alone is a high bar already: what labels by chance teach, a network does again.

    Args:
        src, dst: Matched points [length], row i with row i, with any leading batch axes.
        noise_bound: Largest error of a right match [length], one number or one a match.
        scale: Known scale [-], or None: estimate it.
        mask: Matches to use, (*batch, n) or what broadcasts to it; None: all.
        confidence: Weights of the matches in the pose [-], as the mask; None: 1.
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
    _check(src, dst, noise_bound, least_inliers)
    src, dst, batch = at_least_float32(src), at_least_float32(dst), src.shape[:-1]
    mask = jnp.ones(batch, bool) if mask is None else jnp.broadcast_to(mask, batch)
    confidence = jnp.ones(batch, src.dtype) if confidence is None else jnp.broadcast_to(confidence, batch)
    bound = jnp.broadcast_to(jnp.asarray(noise_bound, src.dtype), batch)
    teach: Any = partial(_teach_one, scale=scale, settings=settings, least_inliers=least_inliers)
    for _ in batch[:-1]:
        teach = jax.vmap(teach)
    return teach(*lax.stop_gradient((src, dst, mask, confidence, bound)))


def _teach_one(
    src: Array, dst: Array, mask: Array, confidence: Array, noise_bound: Array,
    *, scale: AnyArray, settings: Settings, least_inliers: AnyArray,
) -> Labels:  # fmt: skip
    problem = make_problem(
        src, dst, noise_bound=noise_bound, scale=scale, mask=mask, confidence=confidence
    )  # fmt: skip
    found = solve(problem, settings)
    enough = jnp.sum(found.inliers, dtype=jnp.int32) >= least_inliers
    return Labels(found.pose, found.inliers, found.ok & enough, found.status)


def _check(src: AnyArray, dst: AnyArray, noise_bound: AnyArray, least_inliers: AnyArray) -> None:
    """Raise ValueError for shapes that do not fit, and for bounds that are not above 0."""
    if src.shape != dst.shape or src.ndim < 2 or src.shape[-1] != 3:
        raise ValueError(
            f"src has shape {src.shape} and dst {dst.shape}: expected the same (..., n, 3), row i of src "
            "matched with row i of dst."
        )
    if jnp.ndim(least_inliers) != 0:
        raise ValueError(f"least_inliers has shape {jnp.shape(least_inliers)}: expected one number.")
    check_positive(noise_bound=noise_bound)
    batch = src.shape[:-1]
    if jnp.shape(noise_bound) not in ((), batch[-1:], batch):
        raise ValueError(
            f"noise_bound has shape {jnp.shape(noise_bound)}: expected one number, or one a match, "
            f"{batch[-1:]} or {batch}."
        )
