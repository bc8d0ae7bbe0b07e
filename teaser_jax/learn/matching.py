"""From descriptors to matches with confidences."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int


class Matches(NamedTuple):
    """The counterpart of each source point.

    Attributes:
        counterpart: Row of the target that fits best.
        confidence: How sure the match is, from 0 to 1; what ``Problem.confidence`` takes.
        mask: Which matches to use.
    """

    counterpart: Int[Array, " n"]
    confidence: Float[Array, " n"]
    mask: Bool[Array, " n"]


def match(
    src_descriptors: Float[Array, "n d"],
    dst_descriptors: Float[Array, "m d"],
    *,
    temperature: float | Float[Array, ""] = 0.1,
    mutual: bool = True,
    src_mask: Bool[Array, " n"] | None = None,
    dst_mask: Bool[Array, " m"] | None = None,
) -> Matches:
    """The most similar target point of each source point, with the dual-softmax confidence of the two.

    With similarities S = a . b / temperature, the confidence of a pair is softmax(S) along its row times
    softmax(S) along its column. Descriptors are used as they are: normalise them first if their lengths mean
    nothing.

    Args:
        src_descriptors, dst_descriptors: One row a point.
        temperature: Difference of similarity that counts, above 0.
        mutual: Use only pairs that choose each other; otherwise every source point has its match.
        src_mask, dst_mask: Points that take part; None: all.

    Returns:
        Matches in the order of the source; those of masked points are masked and have confidence 0.

    Gradients: of the confidences, exact; the counterparts and the mask are choices and have none.

    References: Sun et al., LoFTR, CVPR 2021 (dual softmax).
    """
    n, m = len(src_descriptors), len(dst_descriptors)
    src_mask = jnp.ones(n, bool) if src_mask is None else src_mask
    dst_mask = jnp.ones(m, bool) if dst_mask is None else dst_mask
    similarity = similarities(src_descriptors, dst_descriptors) / temperature
    either = src_mask[:, None] & dst_mask
    similarity = jnp.where(either, similarity, _least(similarity))
    counterpart = jnp.argmax(lax.stop_gradient(similarity), axis=1)
    best = jnp.take_along_axis(similarity, counterpart[:, None], axis=1)[:, 0]
    log_confidence = (
        2 * best - _log_sum(similarity, axis=1) - jnp.take(_log_sum(similarity, axis=0), counterpart)
    )
    usable = src_mask & jnp.take(dst_mask, counterpart)
    mask = usable
    if mutual:
        mask &= jnp.take(jnp.argmax(lax.stop_gradient(similarity), axis=0), counterpart) == jnp.arange(n)
    confidence = jnp.where(usable, jnp.exp(jnp.where(usable, log_confidence, 0)), 0)
    return Matches(counterpart.astype(jnp.int32), confidence, mask)


def soft_counterparts(
    src_descriptors: Float[Array, "n d"],
    dst_descriptors: Float[Array, "m d"],
    dst: Float[Array, "m 3"],
    *,
    temperature: float | Float[Array, ""] = 0.1,
    dst_mask: Bool[Array, " m"] | None = None,
) -> Float[Array, "n 3"]:
    """A virtual counterpart of each source point: the mean of the target, weighted by softmax(S).

    Gradients: exact, also in ``dst`` and the descriptors, which is what the hard choice of ``match`` lacks.

    References: Wang, Solomon, Deep Closest Point, ICCV 2019.
    """
    similarity = similarities(src_descriptors, dst_descriptors) / temperature
    if dst_mask is not None:
        similarity = jnp.where(dst_mask, similarity, _least(similarity))
        dst = jnp.where(dst_mask[:, None], dst, 0)
    return jnp.matmul(jax.nn.softmax(similarity, axis=1), dst, precision=lax.Precision.HIGHEST)


def similarities(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Inner products of all pairs. Gradients: exact."""
    return jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)


def _log_sum(x: Array, axis: int) -> Array:
    # As jax.nn.logsumexp, at a fifth of its time with gradient: the shift needs none.
    top = lax.stop_gradient(jnp.max(x, axis=axis, keepdims=True))
    return jnp.log(jnp.sum(jnp.exp(x - top), axis=axis)) + jnp.squeeze(top, axis)


def _least(x: Array) -> Array:
    """So little that its exponential is nothing, yet a number, so that no gradient is NaN."""
    return jnp.asarray(-0.5 * jnp.finfo(x.dtype).max, x.dtype)
