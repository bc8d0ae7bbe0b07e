"""The answer to two raw clouds: a pose, whether to trust it, and what speaks for it and against it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.candidates import Candidate
from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.symmetry import Axis
from teaser_jax.clouds.trust.judge import LIMITS, Doubt, Evidence
from teaser_jax.clouds.trust.observability import Motion
from teaser_jax.clouds.words import advice, summary
from teaser_jax.pose import Pose
from teaser_jax.register import Registration
from teaser_jax.solution import Status


@dataclass(frozen=True, eq=False, repr=False)
class CloudRegistration:
    """The answer of ``register_clouds``: host values in float64, in the frames of the clouds as given.

    Attributes:
        pose: ``T_dst_src``; where ``status`` is not OK it is the best that was found, and of no pose at all
            the identity.
        status: What happened, as a number that programs can ask for.
        doubt: Which question the pose failed, in a word; None: none. ``advice`` says more.
        evidence: What speaks for the pose and against it, in numbers; None: no pose was found.
        candidates: All poses that were found, best first.
        equivalent: Other poses in which the overlap fits nearly as well, and which nothing rules out.
        axis: About which the source may be turned by any angle, in the target frame; None: there is none.
        src, dst: The clouds as read, with what was left out of them.
        tolerance: How far points of the overlap might be off, as asked for; None: two voxels [length].
        ended_early: Whether the time was over before all ways to match were tried.
        seconds: What the work took, by stage [s].
    """

    pose: Pose
    status: Status
    doubt: Doubt | None
    evidence: Evidence | None
    candidates: tuple[Candidate, ...]
    equivalent: tuple[Pose, ...]
    axis: Axis | None
    src: Cloud
    dst: Cloud
    tolerance: float | None
    ended_early: bool
    seconds: dict[str, float]

    @property
    def ok(self) -> bool:
        """Whether to act on the pose: points of the overlap are off by less than two voxels."""
        return self.status == Status.OK

    def __bool__(self) -> bool:
        return self.ok

    @property
    def T_dst_src(self) -> Float[np.ndarray, "4 4"]:
        """The pose as a matrix."""
        return np.asarray(self.pose.matrix, np.float64)

    @property
    def voxel_size(self) -> float:
        """Width of the cells that the verdict rests on [length]; NaN if no pose was found."""
        return np.nan if self.evidence is None else self.evidence.voxel_size

    @property
    def displacement(self) -> float:
        """How far points of the overlap are expected to be off [length]; infinite if no pose was found."""
        return np.inf if self.evidence is None else self.evidence.displacement

    @property
    def free(self) -> tuple[Motion, ...]:
        """Motions that the clouds do not hold, in the target frame."""
        free = () if self.evidence is None else self.evidence.seen.free(LIMITS.visible)
        return tuple(replace(motion, point=motion.point + self.dst.origin) for motion in free)

    @property
    def covariance(self) -> Float[np.ndarray, "6 6"]:
        """Covariance of a small shift of ``centroid`` and a small turn about it, in the target frame.

        Three coordinates of the shift, then three of the rotation vector [length, rad]. It is infinite on the
        diagonal, and zero beside it, where the answer is not ``ok``.
        """
        if not self.ok or self.evidence is None:
            return np.where(np.eye(6, dtype=bool), np.inf, 0.0)
        return self.evidence.seen.covariance(self.evidence.residual)

    @property
    def centroid(self) -> Float[np.ndarray, "3"]:
        """The middle of the overlap, in the target frame [length]; NaN if no pose was found."""
        if self.evidence is None:
            return np.full(3, np.nan)
        return self.evidence.seen.centroid + self.dst.origin

    @property
    def registration(self) -> Registration | None:
        """The answer of ``register`` to the matches that led to the pose; None: no matches led there."""
        return self.candidates[0].registration if self.candidates else None

    @property
    def agreement(self) -> int:
        """How many candidates, from other matches each, lie within two and a half voxels of the pose."""
        return sum(self._apart(x.pose) < 2.5 * self.voxel_size for x in self.candidates)

    @cached_property
    def advice(self) -> str:
        """What happened and what to try, in sentences."""
        return advice(self)

    def _apart(self, pose: Pose) -> float:
        """Tell how far another pose has the points of the source, on average [length]."""
        some = self.src.points[:: max(1, len(self.src) // 500)] + self.src.origin
        return float(np.linalg.norm(pose.apply(some) - self.pose.apply(some), axis=1).mean())

    def __repr__(self) -> str:
        return summary(self)
