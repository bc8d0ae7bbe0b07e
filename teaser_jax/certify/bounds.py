"""A bound, and the inliers from which bounds on the error of a pose follow."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.pose import Pose
from teaser_jax.problem import Problem


class Bound(NamedTuple):
    """A bound, and whether it says more than what is always true; NaN with the reason where there is none."""

    value: float
    informative: bool
    reason: str = ""

    @classmethod
    def below(cls, value: float, limit: float, reason: str = "") -> Bound:
        """Make a bound; it says something if it lies below ``limit``, which always holds."""
        return cls(float(value), bool(value < limit), reason)

    @classmethod
    def unknown(cls, reason: str) -> Bound:
        """Make what stands for a bound that cannot be computed: NaN, with the reason."""
        return cls(np.nan, False, reason)

    @property
    def words(self) -> str:
        """The number of the bound, and where it says nothing the reason."""
        number = "unknown" if np.isnan(self.value) else f"{self.value:.3g}"
        return number if self.informative else f"{number} ({self.reason or 'says nothing'})"


@dataclass(frozen=True)
class InlierSet:
    """The inliers of a pose, on the host.

    Attributes:
        src: Their source points [length of the source].
        residuals: What the pose leaves of each, as vectors [length of the target].
        bounds: The largest error of each, c beta_i [length of the target].
        pose: The pose.
        known_scale: Whether its scale was given and not estimated.
    """

    src: Float[np.ndarray, "m 3"]
    residuals: Float[np.ndarray, "m 3"]
    bounds: Float[np.ndarray, " m"]
    pose: Pose
    known_scale: bool

    @classmethod
    def of(cls, problem: Problem, pose: Pose, chosen: Bool[np.ndarray, " n"]) -> InlierSet:
        """Collect the chosen matches of a problem, as a pose leaves them."""
        p, chosen = problem, chosen & problem.mask
        src, dst, bounds = (np.asarray(x)[chosen] for x in (p.src, p.dst, p.noise_bound))
        residuals = dst - np.asarray(pose.apply(src))
        return cls(src, residuals, np.sqrt(p.cbar2) * bounds, pose, p.scale is not None)

    def __len__(self) -> int:
        return len(self.src)

    @property
    def scale(self) -> float:
        """The scale of the pose [-]."""
        return float(self.pose.scale)

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """The mean of the source points."""
        return self.src.mean(axis=0)

    @property
    def centred(self) -> Float[np.ndarray, "m 3"]:
        """The source points about their mean."""
        return self.src - self.centre

    @property
    def diameter(self) -> float:
        """The diagonal of the box around the inliers, in the target frame."""
        return float(self.pose.scale * np.linalg.norm(np.ptp(self.src, axis=0)))

    @property
    def matrix_limit(self) -> float:
        """A number that |s R - s R0|_F never exceeds, for any two rotations."""
        return 2 * np.sqrt(2) * self.scale
