"""How good an answer is when the truth is known: errors of a pose, and of a set of inliers."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray, as_numpy, namespace
from teaser_jax.pose import Pose, as_pose


class PoseErrors(NamedTuple):
    """``PoseErrors`` hold the three errors of a pose, each of the kind and batch shape of what was compared.

    Attributes:
        rotation: Angle between the rotations [rad].
        translation: Distance between the translations [length].
        scale: Absolute difference of the scales [-].
    """

    rotation: Float[AnyArray, "*batch"]
    translation: Float[AnyArray, "*batch"]
    scale: Float[AnyArray, "*batch"]

    @property
    def rotation_deg(self) -> Float[AnyArray, "*batch"]:
        """The angle between the rotations in degrees, on the host."""
        return np.degrees(self.rotation)


def errors(estimate: Pose | Any, truth: Pose | Any) -> PoseErrors:
    """Measure the three errors of a pose at once.

    Args:
        estimate, truth: ``T_dst_src`` as a ``Pose``, an answer or a matrix; numpy or JAX, with any leading
            batch axes.

    Gradients: as those of ``rotation_error``, ``translation_error`` and ``scale_error``.
    """
    estimate, truth = as_pose(estimate), as_pose(truth)
    return PoseErrors(
        rotation_error(estimate, truth), translation_error(estimate, truth), scale_error(estimate, truth)
    )


def rotation_error(estimate: Pose | Any, truth: Pose | Any) -> Float[AnyArray, "..."]:
    """Measure the angle between two rotations [rad], accurate near 0 and near pi.

    Gradients: NaN at 0 and pi, where the angle has kinks; ``learn.rotation_loss`` is zero there.
    """
    estimate, truth = as_pose(estimate), as_pose(truth)
    between = so3.rotate(estimate.rotation.swapaxes(-1, -2), truth.rotation.swapaxes(-1, -2))
    return so3.rotation_angle(between)


def translation_error(estimate: Pose | Any, truth: Pose | Any) -> Float[AnyArray, "..."]:
    """Measure the distance between two translations [length].

    Gradients: NaN where the two are equal; ``learn.translation_loss`` is zero there.
    """
    estimate, truth = as_pose(estimate), as_pose(truth)
    xp = namespace(estimate.translation, truth.translation)
    return xp.sqrt(xp.sum((estimate.translation - truth.translation) ** 2, axis=-1))


def scale_error(estimate: Pose | Any, truth: Pose | Any) -> Float[AnyArray, "..."]:
    """Measure the absolute difference of two scales [-].

    Gradients: the sign of the difference.
    """
    return abs(as_pose(estimate).scale - as_pose(truth).scale)


def precision_recall(found: Any, right: Any) -> tuple[float, float]:
    """Compare a set of inliers with the right matches.

    Args:
        found, right: (n,) masks, or anything that reads as one.

    Returns:
        The share of those found that are right, and the share of the right ones that are found [-]; NaN where
        there are none to take a share of.

    Raises:
        ValueError: If one is no mask, or they differ in shape.
    """
    found, right = as_numpy(found, "found"), as_numpy(right, "right")
    if found.shape != right.shape or not {found.dtype.kind, right.dtype.kind} <= set("biuf"):
        raise ValueError(
            f"found has shape {found.shape} and dtype {found.dtype}, right {right.shape} and {right.dtype}: "
            "expected masks of the same matches."
        )
    found, right = found.astype(bool), right.astype(bool)
    both = float(np.sum(found & right))
    share = lambda total: both / total if total else float("nan")
    return float(share(found.sum())), float(share(right.sum()))
