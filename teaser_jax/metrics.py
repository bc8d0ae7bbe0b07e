"""How good an answer is when the truth is known."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from teaser_jax import so3
from teaser_jax.ground.arrays import namespace
from teaser_jax.pose import Pose


class PoseErrors(NamedTuple):
    """The three errors of a pose, each of the kind and batch shape of the poses compared."""

    rotation: Any  # angle [rad]
    translation: Any  # distance [length]
    scale: Any  # absolute difference [-]

    @property
    def rotation_deg(self) -> Any:
        """The angle in degrees."""
        return np.degrees(self.rotation)


def errors(estimate: Pose, truth: Pose) -> PoseErrors:
    """All three errors of a pose at once."""
    return PoseErrors(
        rotation_error(estimate, truth), translation_error(estimate, truth), scale_error(estimate, truth)
    )


def rotation_error(estimate: Pose, truth: Pose) -> Any:
    """Angle between the two rotations [rad]."""
    between = so3.rotate(estimate.rotation.swapaxes(-1, -2), truth.rotation.swapaxes(-1, -2))
    return so3.rotation_angle(between)


def translation_error(estimate: Pose, truth: Pose) -> Any:
    """Distance between the two translations [length]."""
    xp = namespace(estimate.translation, truth.translation)
    return xp.sqrt(xp.sum((estimate.translation - truth.translation) ** 2, axis=-1))


def scale_error(estimate: Pose, truth: Pose) -> Any:
    """Absolute difference of the scales [-]."""
    return abs(estimate.scale - truth.scale)


def precision_recall(found: Any, right: Any) -> tuple[float, float]:
    """Share of found inliers that are right, and of right ones that are found; NaN of nothing."""
    found, right = np.asarray(found, bool), np.asarray(right, bool)
    both = float(np.sum(found & right))
    share = lambda total: both / total if total else float("nan")
    return share(found.sum()), share(right.sum())
