"""Losses of poses, inliers, keypoints and descriptors. Each is a mean over what its mask leaves.

Means over nothing are 0, and so are their gradients. Poses may have leading batch axes. Masks are boolean and
have the shape of what they mask; what they leave out may be anything, NaN too. A NaN that is not masked makes
the loss NaN, so that training that diverges shows it; ``matching_loss`` leaves out what is not finite.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.learn.matching import (
    as_float,
    as_mask,
    centred,
    check_positive,
    finite_rows,
    least,
    log_sum,
    similarities,
)
from teaser_jax.pose import Pose


def masked_mean(values: Float[Array, "..."], mask: Bool[Array, "..."] | None) -> Float[Array, ""]:
    """The mean of the values under the mask; 0 if there are none."""
    mask = as_mask(mask, values.shape)
    count = jnp.sum(mask, dtype=values.dtype)
    return jnp.sum(jnp.where(mask, values, 0)) / jnp.maximum(count, 1)


def rotation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """The angle between the rotations [rad].

    Gradients: of length at most one a radian; zero at 0 and pi, where the angle has kinks.
    """
    between = jnp.einsum("...ji,...jk->...ik", truth.rotation, pose.rotation, precision=lax.Precision.HIGHEST)
    skew = between - jnp.swapaxes(between, -1, -2)
    sine = _distance(jnp.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], axis=-1))
    return jnp.arctan2(sine, jnp.trace(between, axis1=-2, axis2=-1) - 1)


def translation_loss(pose: Pose, truth: Pose) -> Float[Array, "*batch"]:
    """The distance between the translations [length]. Gradients: exact; zero at 0."""
    return _distance(pose.translation - truth.translation)


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
    points = as_float(points)
    mask = as_mask(mask, points.shape[:-1])
    points = jnp.where(mask[..., None], points, 0)
    apart = _distance(pose.apply(points) - truth.apply(points))
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
    mask, inliers = as_mask(mask, logits.shape), as_mask(inliers, logits.shape)
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

    Raises:
        ValueError: On shapes that do not fit, or a ``noise_bound`` that is not above 0.

    Gradients: exact, in the keypoints and in the pose.

    References: the Geman-McClure cost, as in Yang et al., RA-L 2020.
    """
    if src.shape != dst.shape:
        raise ValueError(f"keypoints have shapes {src.shape} and {dst.shape}: expected the same.")
    check_positive(noise_bound=noise_bound)
    mask = as_mask(mask, src.shape[:-1])
    src, dst = (jnp.where(mask[..., None], as_float(x), 0) for x in (src, dst))
    difference = (dst - pose.apply(src)) / jnp.asarray(noise_bound, src.dtype)[..., None]
    # So far away the cost is 1 to all digits, and its square must not overflow.
    most = jnp.finfo(difference.dtype).max ** 0.25
    difference = jnp.clip(difference, -most, most)
    r2 = jnp.sum(difference * difference, axis=-1)
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
        src_mask, dst_mask: Points that take part; None: all. Those that are not finite, or whose descriptor
            is not, do not.

    Raises:
        ValueError: On masks that are not boolean, or a radius or temperature that is not above 0.

    Gradients: exact in the descriptors; points and pose decide who is who and have none.

    References: van den Oord et al., 2018 (InfoNCE); Khosla et al., NeurIPS 2020 (many positives).
    """
    check_positive(radius=radius, temperature=temperature)
    src, dst, pose = lax.stop_gradient((src, dst, pose))
    src_descriptors, src_mask = finite_rows(src_descriptors, src_mask)
    dst_descriptors, dst_mask = finite_rows(dst_descriptors, dst_mask)
    src_mask &= jnp.all(jnp.isfinite(src), axis=1)
    dst_mask &= jnp.all(jnp.isfinite(dst), axis=1)
    # About one middle: squares of far coordinates would cancel.
    both = centred(jnp.concatenate([pose.apply(src), dst]), jnp.concatenate([src_mask, dst_mask]))
    moved, dst = both[: len(src)], both[len(src) :]
    either = src_mask[:, None] & dst_mask
    distance2 = (
        jnp.sum(moved * moved, axis=1)[:, None] + jnp.sum(dst * dst, axis=1) - 2 * similarities(moved, dst)
    )
    same = either & (distance2 < radius**2)
    asked = same | (either & (distance2 > 4 * radius**2))
    likeness = similarities(src_descriptors, dst_descriptors) / temperature
    good, every = (jnp.where(some, likeness, least(likeness)) for some in (same, asked))

    def side(axis: int) -> Array:
        return masked_mean(log_sum(every, axis=axis) - log_sum(good, axis=axis), jnp.any(same, axis=axis))

    return 0.5 * (side(0) + side(1))


def _distance(x: Float[Array, "*batch 3"]) -> Float[Array, "*batch"]:
    """The length, with gradient zero at zero; NaN where there is one."""
    length2 = jnp.sum(x * x, axis=-1)
    some = length2 != 0
    return jnp.where(some, jnp.sqrt(jnp.where(some, length2, 1)), 0)
