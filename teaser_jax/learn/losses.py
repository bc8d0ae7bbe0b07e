"""Losses of poses, inliers, keypoints and descriptors: each is a mean over what its mask leaves.

Means over nothing are 0, and so are their gradients. Poses may have leading batch axes. Masks are boolean and
have the shape of what they mask; what they leave out may be anything, NaN too. A NaN that is not masked makes
the loss NaN, so that training that diverges shows it; ``matching_loss`` leaves out what is not finite.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Real

from teaser_jax.ground.arrays import AnyArray, Number, at_least_float32, inner_products, squared_distances
from teaser_jax.ground.checks import check_positive
from teaser_jax.ground.masked import (
    about_mean,
    harmless_rows,
    log_sum_exp,
    lowest_logit,
    mask_or_all,
    masked_mean,
)
from teaser_jax.pose import Pose


def rotation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """Measure the angle between two rotations [rad].

    Args:
        pose, truth: ``T_dst_src``, with any leading batch axes.

    Gradients: of length at most one a radian; zero at 0 and pi, where the angle has kinks.
    """
    between = jnp.einsum("...ji,...jk->...ik", truth.rotation, pose.rotation, precision=lax.Precision.HIGHEST)
    skew = between - jnp.swapaxes(between, -1, -2)
    sine = _distance(jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1))
    return jnp.arctan2(sine, jnp.trace(between, axis1=-2, axis2=-1) - 1)


def translation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """Measure the distance between two translations [length].

    Args:
        pose, truth: ``T_dst_src``, with any leading batch axes.

    Gradients: exact; zero at 0.
    """
    return _distance(pose.translation - truth.translation)


def point_loss(
    pose: Pose,
    truth: Pose,
    points: Real[AnyArray, "*batch n 3"],
    mask: Bool[AnyArray, "*batch n"] | None = None,
) -> Float[Array, "..."]:
    """Measure how far two poses carry the same source points apart, on average [length].

    That weighs rotation, translation and scale as they matter at the points, without a factor to choose.

    Args:
        pose, truth: ``T_dst_src``, with any leading batch axes.
        points: Source points [length].
        mask: Points that take part; None: all.

    Raises:
        ValueError: On a mask that is not boolean or has another shape than the points.

    Gradients: exact; zero for points that do not move.
    """
    points = at_least_float32(points)
    mask = mask_or_all(mask, points.shape[:-1])
    points = jnp.where(mask[..., None], points, 0)
    apart = _distance(pose.apply(points) - truth.apply(points))
    count = jnp.sum(mask, axis=-1, dtype=apart.dtype)
    return jnp.sum(jnp.where(mask, apart, 0), axis=-1) / jnp.maximum(count, 1)


def inlier_loss(
    logits: Float[AnyArray, "*batch n"],
    inliers: Bool[AnyArray, "*batch n"],
    mask: Bool[AnyArray, "*batch n"] | None = None,
) -> Float[Array, ""]:
    """Score inlier logits by their cross-entropy [nat], right and wrong matches weighed alike in total.

    Right matches are few: without the balance, calling all of them wrong would be nearly free.

    Args:
        logits: Log odds that a match is right [-].
        inliers: The right matches.
        mask: Matches that take part; None: all.

    Raises:
        ValueError: On inliers or a mask that are not boolean or of another shape than the logits.

    Gradients: exact.
    """
    mask, inliers = mask_or_all(mask, logits.shape), mask_or_all(inliers, logits.shape)
    logits = jnp.where(mask, logits, 0)
    right = masked_mean(-jax.nn.log_sigmoid(logits), mask & inliers)
    wrong = masked_mean(-jax.nn.log_sigmoid(-logits), mask & ~inliers)
    return 0.5 * (right + wrong)


def keypoint_loss(
    src: Real[AnyArray, "*batch n 3"],
    dst: Real[AnyArray, "*batch n 3"],
    pose: Pose,
    *,
    noise_bound: Number | Float[AnyArray, "..."],
    mask: Bool[AnyArray, "*batch n"] | None = None,
) -> Float[Array, ""]:
    """Measure how badly keypoints agree with a pose: the mean of r^2 / (beta^2 + r^2) [-], from 0 to 1.

    Wrong matches saturate, so they pull little.

    Args:
        src, dst: Keypoints that a network placed, row i with row i [length].
        pose: ``T_dst_src``.
        noise_bound: beta, one number or one a keypoint [length].
        mask: Keypoints that take part; None: all.

    Raises:
        ValueError: On shapes that do not fit, or a ``noise_bound`` that is not above 0.

    Gradients: exact, in the keypoints and in the pose.

    References: the Geman-McClure cost, as in Yang et al., RA-L 2020.
    """
    if src.shape != dst.shape:
        raise ValueError(f"keypoints have shapes {src.shape} and {dst.shape}: expected the same.")
    check_positive(noise_bound=noise_bound)
    mask = mask_or_all(mask, src.shape[:-1])
    src, dst = (jnp.where(mask[..., None], at_least_float32(x), 0) for x in (src, dst))
    noise_bound = jnp.broadcast_to(jnp.asarray(noise_bound, src.dtype), mask.shape)
    difference = (dst - pose.apply(src)) / noise_bound[..., None]
    # So far away the cost is 1 to all digits, and its square must not overflow.
    most = jnp.finfo(difference.dtype).max ** 0.25
    difference = jnp.clip(difference, -most, most)
    r2 = jnp.sum(difference * difference, axis=-1)
    return masked_mean(r2 / (1 + r2), mask)


def matching_loss(
    src_descriptors: Float[AnyArray, "n d"],
    dst_descriptors: Float[AnyArray, "m d"],
    src: Float[AnyArray, "n 3"],
    dst: Float[AnyArray, "m 3"],
    pose: Pose,
    *,
    radius: Number | Float[AnyArray, ""],
    temperature: Number | Float[AnyArray, ""] = 0.1,
    src_mask: Bool[AnyArray, " n"] | None = None,
    dst_mask: Bool[AnyArray, " m"] | None = None,
) -> Float[Array, ""]:
    """Measure how unlike descriptors of the same place are, given a pose: a contrastive loss [nat].

    Target points within ``radius`` of where the pose takes a source point are the same place, those beyond
    twice the radius are others, and between the two nothing is asked. For each point that has a counterpart:
    minus the log of the share of exp(similarity / temperature) that falls on counterparts; both ways.

    Args:
        src_descriptors, dst_descriptors: Rows of length 1, from ``describe``, for instance.
        src, dst: Their points [length].
        pose: ``T_dst_src``, true or from the ``teacher``.
        radius: See above [length].
        temperature: Difference of similarity that counts [-].
        src_mask, dst_mask: Points that take part; None: all. Those that are not finite, or whose descriptor
            is not, do not.

    Raises:
        ValueError: On masks that are not boolean, or a radius or temperature that is not above 0.

    Gradients: exact in the descriptors; points and pose decide who is who and have none.

    References: van den Oord et al., 2018 (InfoNCE); Khosla et al., NeurIPS 2020 (many positives).
    """
    check_positive(radius=radius, temperature=temperature)
    src_descriptors, src_mask = harmless_rows(src_descriptors, src_mask)
    dst_descriptors, dst_mask = harmless_rows(dst_descriptors, dst_mask)
    same, asked = _same_place(*lax.stop_gradient((pose, src, dst)), src_mask, dst_mask, radius)
    likeness = inner_products(src_descriptors, dst_descriptors) / temperature
    good, every = (jnp.where(some, likeness, lowest_logit(likeness)) for some in (same, asked))

    def one_way(axis: int) -> Array:
        missed = log_sum_exp(every, axis=axis) - log_sum_exp(good, axis=axis)
        return masked_mean(missed, jnp.any(same, axis=axis))

    return 0.5 * (one_way(0) + one_way(1))


def _same_place(
    pose: Pose,
    src: Float[AnyArray, "n 3"],
    dst: Float[AnyArray, "m 3"],
    src_mask: Bool[Array, " n"],
    dst_mask: Bool[Array, " m"],
    radius: Number | Float[AnyArray, ""],
) -> tuple[Bool[Array, "n m"], Bool[Array, "n m"]]:
    """Tell which pairs of points are the same place under a pose, and which of all pairs are asked about."""
    src_mask &= jnp.all(jnp.isfinite(src), axis=1)
    dst_mask &= jnp.all(jnp.isfinite(dst), axis=1)
    # About one middle: squares of far coordinates would cancel.
    together = jnp.concatenate([pose.apply(src), dst]), jnp.concatenate([src_mask, dst_mask])
    near_origin = about_mean(*together)
    distance2 = squared_distances(near_origin[: len(src)], near_origin[len(src) :])
    both = src_mask[:, None] & dst_mask[None]
    same = both & (distance2 < radius**2)
    return same, same | (both & (distance2 > 4 * radius**2))


def _distance(x: Float[AnyArray, "*batch 3"]) -> Float[Array, "*batch"]:
    """Measure lengths with gradient zero at zero; a NaN stays NaN."""
    length2 = jnp.sum(x * x, axis=-1)
    some = length2 != 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, length2, 1)), 0)
