"""From descriptors to matches with confidences."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground.arrays import is_traced


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
        Matches in the order of the source; those of masked points, and of points whose descriptor is not
        finite, are masked and have confidence 0.

    Raises:
        ValueError: On shapes that do not fit, no target, masks that are not boolean, or a temperature that
            is not above 0.

    Gradients: of the confidences, exact; the counterparts and the mask are choices and have none.

    References: Sun et al., LoFTR, CVPR 2021 (dual softmax).
    """
    _check(src_descriptors, dst_descriptors, temperature)
    n = len(src_descriptors)
    src_descriptors, src_mask = finite_rows(src_descriptors, src_mask)
    dst_descriptors, dst_mask = finite_rows(dst_descriptors, dst_mask)
    similarity = similarities(src_descriptors, dst_descriptors) / temperature
    either = src_mask[:, None] & dst_mask
    similarity = jnp.where(either, similarity, least(similarity))
    counterpart = jnp.argmax(lax.stop_gradient(similarity), axis=1)
    best = jnp.take_along_axis(similarity, counterpart[:, None], axis=1)[:, 0]
    log_confidence = (
        2 * best - log_sum(similarity, axis=1) - jnp.take(log_sum(similarity, axis=0), counterpart)
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

    Target points that are masked or not finite have no weight; where none is left the answer is the origin.
    A source point whose descriptor is not finite resembles all of them alike: mask its match.

    Raises:
        ValueError: As ``match``.

    Gradients: exact, also in ``dst`` and the descriptors, which is what the hard choice of ``match`` lacks.

    References: Wang, Solomon, Deep Closest Point, ICCV 2019.
    """
    _check(src_descriptors, dst_descriptors, temperature)
    src_descriptors, _ = finite_rows(src_descriptors, None)
    dst_descriptors, dst_mask = finite_rows(dst_descriptors, dst_mask)
    dst_mask &= jnp.all(jnp.isfinite(dst), axis=1)
    similarity = similarities(src_descriptors, dst_descriptors) / temperature
    similarity = jnp.where(dst_mask, similarity, least(similarity))
    dst = jnp.where(dst_mask[:, None], dst, 0)
    return jnp.matmul(jax.nn.softmax(similarity, axis=1), dst, precision=lax.Precision.HIGHEST)


def _check(src_descriptors: Array, dst_descriptors: Array, temperature: Any) -> None:
    shapes = src_descriptors.shape, dst_descriptors.shape
    if not all(len(s) == 2 and s[0] > 0 for s in shapes) or shapes[0][1] != shapes[1][1]:
        raise ValueError(
            f"descriptors have shapes {shapes[0]} and {shapes[1]}: expected (n, d) and (m, d), one or "
            "more each; use jax.vmap for batches."
        )
    check_positive(temperature=temperature)


def finite_rows(descriptors: Array, mask: Array | None) -> tuple[Array, Array]:
    """Descriptors made harmless before anything is computed from them, and which of them are to be used."""
    mask = as_mask(mask, descriptors.shape[:1]) & jnp.all(jnp.isfinite(descriptors), axis=1)
    return jnp.where(mask[:, None], descriptors, 0), mask


def as_float(x: Any) -> Array:
    """At least float32: integers would cut bounds, and half precision has no linear algebra."""
    x = jnp.asarray(x)
    if jnp.issubdtype(x.dtype, jnp.complexfloating):
        raise ValueError("complex numbers were received: points are real.")
    return x.astype(jnp.promote_types(x.dtype, jnp.float32))


def as_mask(mask: Any, shape: tuple[int, ...]) -> Bool[Array, "..."]:
    """A mask of that shape; None: everything. ValueError for numbers, which would weigh instead of choose."""
    if mask is None:
        return jnp.ones(shape, bool)
    mask = jnp.asarray(mask)
    if mask.dtype != bool or mask.shape != shape:
        raise ValueError(f"a mask has shape {mask.shape} and type {mask.dtype}: expected {shape} and bool.")
    return mask


def check_positive(**numbers: Any) -> None:
    """ValueError for those outside jit that are not finite and above 0; inside, values are not known."""
    for name, value in numbers.items():
        if is_traced(value):
            continue
        given = np.asarray(value, float)
        if not (np.isfinite(given).all() and (given > 0).all()):
            raise ValueError(f"{name} is {value}: expected a finite number above 0.")


def centred(points: Float[Array, "n 3"], mask: Bool[Array, " n"]) -> Float[Array, "n 3"]:
    """About the mean of the points under the mask; the others at the origin."""
    points = jnp.where(mask[:, None], points, 0)  # what is masked may be anything
    present = mask.astype(points.dtype)[:, None]
    mean = jnp.sum(present * points, axis=0) / jnp.maximum(jnp.sum(present), 1)
    return present * (points - mean)


def similarities(a: Float[Array, "n d"], b: Float[Array, "m d"]) -> Float[Array, "n m"]:
    """Inner products of all pairs. Gradients: exact."""
    return jnp.matmul(a, b.T, precision=lax.Precision.HIGHEST)


def log_sum(x: Array, axis: int) -> Array:
    """As ``jax.nn.logsumexp``, at a fifth of its time with gradient: the shift needs none."""
    top = lax.stop_gradient(jnp.max(x, axis=axis, keepdims=True))
    return jnp.log(jnp.sum(jnp.exp(x - top), axis=axis)) + jnp.squeeze(top, axis)


def least(x: Array) -> Array:
    """So little that its exponential is nothing, yet a number, so that no gradient is NaN."""
    return jnp.asarray(-0.5 * jnp.finfo(x.dtype).max, x.dtype)
