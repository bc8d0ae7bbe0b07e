"""Losses of poses, inliers, keypoints and descriptors. Each is a mean over what its mask leaves.

Means over nothing are 0, and so are their gradients. Poses may have leading batch axes.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.learn.matching import centred, similarities
from teaser_jax.stages.invariants import safe_norm
from teaser_jax.types import Pose


def masked_mean(values: Float[Array, "..."], mask: Bool[Array, "..."] | None) -> Float[Array, ""]:
    """The mean of the values under the mask; 0 if there are none."""
    mask = jnp.ones(values.shape, bool) if mask is None else jnp.broadcast_to(mask, values.shape)
    count = jnp.sum(mask, dtype=values.dtype)
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(count, 1)


def rotation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """The angle between the rotations [rad].

    Gradients: of length at most one a radian; zero at 0 and pi, where the angle has kinks.
    """
    between = jnp.einsum("...ji,...jk->...ik", truth.rotation, pose.rotation, precision=lax.Precision.HIGHEST)
    skew = between - jnp.swapaxes(between, -1, -2)
    sine = safe_norm(jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1))
    return jnp.arctan2(sine, jnp.trace(between, axis1=-2, axis2=-1) - 1)


def translation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """The distance between the translations [length]. Gradients: exact; zero at 0."""
    return safe_norm(pose.translation - truth.translation)


def point_loss(
    pose: Pose,
    truth: Pose,
    points: Float[Array, "*batch n 3"],
    mask: Bool[Array, "*batch n"] | None = None,
) -> Float[Array, "*batch"]:
    """How far the two poses carry the same source points apart, on average [length].

    Weighs rotation, translation and scale as they matter at the points, without a factor to choose.

    Gradients: exact; zero for points that do not move.
    """
    mask = jnp.ones(points.shape[:-1], bool) if mask is None else mask
    points = jnp.where(mask[..., None], points, 0)
    apart = safe_norm(pose.apply(points) - truth.apply(points))
    count = jnp.sum(mask, axis=-1, dtype=apart.dtype)
    return jnp.sum(jnp.where(mask, apart, 0), axis=-1) / jnp.maximum(count, 1)


def inlier_loss(
    logits: Float[Array, "*batch n"],
    inliers: Bool[Array, "*batch n"],
    mask: Bool[Array, "*batch n"] | None = None,
) -> Float[Array, ""]:
    """Cross-entropy of inlier scores [nat], right and wrong matches weighed alike in total.

    Right matches are few: without the balance, calling all of them wrong would be nearly free.

    Gradients: exact.
    """
    mask = jnp.ones(logits.shape, bool) if mask is None else mask
    logits = jnp.where(mask, logits, 0)
    right = masked_mean(-jax.nn.log_sigmoid(logits), mask & inliers)
    wrong = masked_mean(-jax.nn.log_sigmoid(-logits), mask & ~inliers)
    return 0.5 * (right + wrong)


def keypoint_loss(
    src: Float[Array, "*batch n 3"],
    dst: Float[Array, "*batch n 3"],
    pose: Pose,
    *,
    noise_bound: float | Float[Array, "..."],
    mask: Bool[Array, "*batch n"] | None = None,
) -> Float[Array, ""]:
    """How badly predicted keypoints agree with a pose: the mean of r^2 / (beta^2 + r^2) [-], from 0 to 1.

    Wrong matches saturate, so they pull little. ``src`` and ``dst`` are keypoints that a network placed.

    Gradients: exact, in the keypoints and in the pose.

    References: the Geman-McClure cost, as in Yang et al., RA-L 2020.
    """
    if mask is not None:
        src, dst = (jnp.where(mask[..., None], x, 0) for x in (src, dst))
    difference = dst - pose.apply(src)
    r2 = jnp.sum(difference * difference, axis=-1) / jnp.asarray(noise_bound, src.dtype) ** 2
    return masked_mean(r2 / (1 + r2), mask)


def matching_loss(
    src_descriptors: Float[Array, "n d"],
    dst_descriptors: Float[Array, "m d"],
    src: Float[Array, "n 3"],
    dst: Float[Array, "m 3"],
    pose: Pose,
    *,
    radius: float,
    temperature: float = 0.1,
    src_mask: Bool[Array, " n"] | None = None,
    dst_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, ""]:
    """Descriptors of the same place should be alike, given a pose: a contrastive loss [nat].

    Target points within ``radius`` of where the pose takes a source point are the same place, those beyond
    twice the radius are others, and between the two nothing is asked. For each point that has a counterpart:
    minus the log of the share of exp(similarity / temperature) that falls on counterparts; both ways.

    Args:
        src_descriptors, dst_descriptors: Rows of length 1, from ``describe``, for instance.
        src, dst: Their points.
        pose: ``T_dst_src``, true or from the ``teacher``.
        radius: See above [length].
        temperature: Difference of similarity that counts.
        src_mask, dst_mask: Points that take part; None: all.

    Gradients: exact in the descriptors; points and pose decide who is who and have none.

    References: van den Oord et al., 2018 (InfoNCE); Khosla et al., NeurIPS 2020 (many positives).
    """
    src, dst, pose = lax.stop_gradient((src, dst, pose))
    src_mask = jnp.ones(len(src), bool) if src_mask is None else src_mask
    dst_mask = jnp.ones(len(dst), bool) if dst_mask is None else dst_mask
    src_descriptors = jnp.where(src_mask[:, None], src_descriptors, 0)
    dst_descriptors = jnp.where(dst_mask[:, None], dst_descriptors, 0)
    # About one middle: squares of far coordinates would cancel.
    both = centred(jnp.concatenate([pose.apply(src), dst]), jnp.concatenate([src_mask, dst_mask]))
    moved, dst = both[: len(src)], both[len(src) :]
    either = src_mask[:, None] & dst_mask
    distance2 = (
        jnp.sum(moved * moved, axis=1)[:, None] + jnp.sum(dst * dst, axis=1) - 2 * similarities(moved, dst)
    )
    same = either & (distance2 < radius**2)
    asked = same | (either & (distance2 > 4 * radius**2))
    # Unit descriptors have similarities up to 1: nothing overflows, and no maximum has to be found.
    weight = jnp.exp((similarities(src_descriptors, dst_descriptors) - 1) / temperature)
    tiny = jnp.finfo(weight.dtype).tiny
    good, all_ = jnp.where(same, weight, 0), jnp.where(asked, weight, 0)

    def side(axis: int) -> Array:
        share = jnp.log(jnp.sum(all_, axis=axis) + tiny) - jnp.log(jnp.sum(good, axis=axis) + tiny)
        return masked_mean(share, jnp.any(same, axis=axis))

    return 0.5 * (side(0) + side(1))
