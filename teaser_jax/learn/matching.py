"""Descriptors become matches with confidences, by a hard choice or by a soft one."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground.arrays import AnyArray, Number, inner_products
from teaser_jax.ground.checks import check_positive
from teaser_jax.ground.masked import harmless_rows, log_sum_exp, lowest_logit


class Matches(NamedTuple):
    """``Matches`` name the counterpart of each source point and say how sure that is.

    Attributes:
        counterpart: Row of the target that resembles the source point most.
        confidence: How sure the match is, from 0 to 1; what ``Problem.confidence`` takes.
        mask: Which matches to use.
    """

    counterpart: Int[Array, " n"]
    confidence: Float[Array, " n"]
    mask: Bool[Array, " n"]


def match(
    src_descriptors: Float[AnyArray, "n d"],
    dst_descriptors: Float[AnyArray, "m d"],
    *,
    temperature: Number | Float[AnyArray, ""] = 0.1,
    mutual: bool = True,
    src_mask: Bool[AnyArray, " n"] | None = None,
    dst_mask: Bool[AnyArray, " m"] | None = None,
) -> Matches:
    """Match each source point with the most similar target point, and say how sure that is.

    With similarities S = a . b / temperature, the confidence of a pair is the dual softmax: softmax(S) along
    its row times softmax(S) along its column. Descriptors are used as they are: normalise them
    first if their lengths mean nothing.

    Args:
        src_descriptors, dst_descriptors: One row a point [-].
        temperature: Difference of similarity that counts, above 0 [-].
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
    src_descriptors, src_mask = harmless_rows(src_descriptors, src_mask)
    dst_descriptors, dst_mask = harmless_rows(dst_descriptors, dst_mask)
    similarity = inner_products(src_descriptors, dst_descriptors) / temperature
    both = src_mask[:, None] & dst_mask[None]
    similarity = jnp.where(both, similarity, lowest_logit(similarity))
    counterpart = jnp.argmax(lax.stop_gradient(similarity), axis=1)
    best = jnp.take_along_axis(similarity, counterpart[:, None], axis=1)[:, 0]
    log_confidence = (
        2 * best - log_sum_exp(similarity, axis=1) - jnp.take(log_sum_exp(similarity, axis=0), counterpart)
    )
    usable = mask = src_mask & jnp.take(dst_mask, counterpart)
    if mutual:
        mask &= jnp.take(jnp.argmax(lax.stop_gradient(similarity), axis=0), counterpart) == jnp.arange(n)
    confidence = jnp.where(usable, jnp.exp(jnp.where(usable, log_confidence, 0)), 0)
    return Matches(counterpart.astype(jnp.int32), confidence, mask)


def soft_counterparts(
    src_descriptors: Float[AnyArray, "n d"],
    dst_descriptors: Float[AnyArray, "m d"],
    dst: Float[AnyArray, "m 3"],
    *,
    temperature: Number | Float[AnyArray, ""] = 0.1,
    dst_mask: Bool[AnyArray, " m"] | None = None,
) -> Float[Array, "n 3"]:
    """Place a virtual counterpart of each source point: the mean of the target, weighted by softmax(S).

    Target points that are masked or not finite have no weight; where none is left the answer is the origin.
    A source point whose descriptor is not finite resembles all of them alike: mask its match.

    Args:
        src_descriptors, dst_descriptors, temperature: As in ``match``.
        dst: The target points [length].
        dst_mask: Target points that take part; None: all.

    Returns:
        A point in the target frame for each source point [length].

    Raises:
        ValueError: As ``match``.

    Gradients: exact, also in ``dst`` and the descriptors, which is what the hard choice of ``match`` lacks.

    References: Wang, Solomon, Deep Closest Point, ICCV 2019.
    """
    _check(src_descriptors, dst_descriptors, temperature)
    src_descriptors, _ = harmless_rows(src_descriptors, None)
    dst_descriptors, dst_mask = harmless_rows(dst_descriptors, dst_mask)
    dst_mask &= jnp.all(jnp.isfinite(dst), axis=1)
    similarity = inner_products(src_descriptors, dst_descriptors) / temperature
    similarity = jnp.where(dst_mask[None], similarity, lowest_logit(similarity))
    dst = jnp.where(dst_mask[:, None], dst, 0)
    return jnp.matmul(jax.nn.softmax(similarity, axis=1), dst, precision=lax.Precision.HIGHEST)


def _check(src_descriptors: AnyArray, dst_descriptors: AnyArray, temperature: AnyArray) -> None:
    shapes = src_descriptors.shape, dst_descriptors.shape
    if not all(len(s) == 2 and s[0] > 0 for s in shapes) or shapes[0][1] != shapes[1][1]:
        raise ValueError(
            f"descriptors have shapes {shapes[0]} and {shapes[1]}: expected (n, d) and (m, d), one or "
            "more each; use jax.vmap for batches."
        )
    check_positive(temperature=temperature)
