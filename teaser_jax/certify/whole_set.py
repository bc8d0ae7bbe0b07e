"""Bounds on the error of the pose from the whole inlier set, with one assumption: how many of it are wrong.

    residuals of the truth n_i, of the pose r_i      |n_i| <= c beta_i,  r_i known
    displacement of inlier i                         e_i = (s R - s0 R0) a_i + t - t0 = n_i - r_i

Centred, D A = N - R with D = s R - s0 R0. So |D A|_F is at most c sqrt(sum beta_i^2) plus the part of R in
the row space of A, which is all but zero for a least squares fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from teaser_jax.certify.bounds import Bound, InlierSet


@dataclass(frozen=True)
class WholeSet:
    """Distances between the pose and any that fits the inliers, all but ``wrong`` of them, within c beta_i.

    Attributes:
        wrong: How many of the inliers may be wrong matches: an assumption.
        matrix: |s R - s0 R0|_F [-].
        angle: Between the rotations [rad].
        scale: |s - s0| [-]; zero where it is known.
        translation: |t - t0|, of the origin of the source frame [length]; for other points ``at``.
        inliers: The set that the distances follow from.
    """

    wrong: int
    matrix: Bound
    angle: Bound
    scale: Bound
    translation: Bound
    inliers: InlierSet

    def at(self, points: Float[np.ndarray, "p 3"] | Float[np.ndarray, " 3"]) -> Float[np.ndarray, " p"]:
        """Bound how far each source point can be from where another pose takes it [length of the target]."""
        return _displacement(self.inliers, np.atleast_2d(np.asarray(points, np.float64)), self.wrong)

    @property
    def words(self) -> str:
        """The assumption, and the bounds that follow from it."""
        if np.isnan(self.angle.value):
            return f"of the whole set nothing follows: {self.angle.reason}"
        degrees = self.angle._replace(value=np.degrees(self.angle.value))
        assumed = f"all but {self.wrong}" if self.wrong else "all"
        return (
            f"if {assumed} inliers are right: rotation within {degrees.words} deg, translation "
            f"{self.translation.words}, scale {self.scale.words}"
        )


def whole_set(inliers: InlierSet, wrong: int) -> WholeSet:
    """Bound the error of the pose over all inliers at once.

    Args:
        inliers: The inliers of the pose.
        wrong: How many of them may be wrong.
    """
    m, scale = len(inliers), inliers.scale
    if m - wrong < 3:
        reason = f"{m} inliers, of which {wrong} may be wrong: three right ones are needed"
        nothing = Bound.unknown(reason)
        return WholeSet(wrong, nothing, nothing, nothing, nothing, inliers)
    values, moved = _spread2(inliers, wrong), _moved(inliers, wrong)
    with np.errstate(divide="ignore"):
        # Across its axis, a rotation moves points by the same factor; along it, by the scale alone. The two
        # smallest spreads are what lies across the worst axis.
        factor = moved / np.sqrt(values[0] + values[1])
        scale_error = 0.0 if inliers.known_scale else moved / np.sqrt(values.sum())
        matrix = np.sqrt(2 * factor**2 + scale_error**2)
    if inliers.known_scale:
        angle = 2 * np.arcsin(factor / (2 * scale)) if factor < 2 * scale else np.pi
    else:
        angle = np.arcsin(factor / scale) if factor < scale else np.pi
    origin = float(_displacement(inliers, np.zeros((1, 3)), wrong)[0])
    flat = "" if np.isfinite(origin) else "the right ones may lie in a plane"
    return WholeSet(
        wrong,
        Bound.below(matrix, inliers.matrix_limit),
        Bound.below(angle, np.pi),
        Bound.below(scale_error, scale),
        Bound.below(origin, inliers.diameter, flat),
        inliers,
    )


def _spread2(inliers: InlierSet, wrong: int) -> Float[np.ndarray, " 3"]:
    """Bound the squared singular values of the centred inliers, ascending, without the worst ``wrong``.

    Taking points out of a scatter matrix lowers no eigenvalue by more than the squares of their distances
    from the centre, and what the centre moves.
    """
    values = np.linalg.svd(inliers.centred, compute_uv=False)[::-1] ** 2
    left = len(inliers) - wrong
    if wrong == 0:
        return values
    return np.maximum(values - (1 + wrong / max(left, 1)) * _furthest2(inliers, wrong), 0)


def _furthest2(inliers: InlierSet, count: int) -> float:
    """Add the ``count`` largest squared distances from the centre."""
    return float(np.sort(np.sum(inliers.centred**2, axis=1))[::-1][:count].sum())


def _moved(inliers: InlierSet, wrong: int) -> float:
    """Bound |D A|_F, by how much the centred inliers are moved altogether."""
    noise = np.linalg.norm(inliers.bounds)
    if wrong > 0:
        return float(noise + np.linalg.norm(inliers.residuals))
    axes, _, _ = np.linalg.svd(inliers.centred, full_matrices=False)
    return float(noise + np.linalg.norm(axes.T @ inliers.residuals))


def _displacement(
    inliers: InlierSet, points: Float[np.ndarray, "p 3"], wrong: int
) -> Float[np.ndarray, " p"]:
    """Bound |D x + t - t0|: x is an affine combination of inliers, and so is its displacement of theirs."""
    m = len(inliers)
    if m - wrong < 3:
        return np.full(len(points), np.nan)
    values = _spread2(inliers, wrong)
    solid = m - wrong >= 4 and values[0] > 1e-18 * values[-1]
    offset = points - inliers.centre
    if not solid:
        return np.full(len(points), np.inf)
    if wrong > 0:
        each = np.sort(inliers.bounds + np.linalg.norm(inliers.residuals, axis=1))[::-1][: m - wrong]
        shift = np.sqrt(wrong * _furthest2(inliers, wrong)) / (m - wrong)
        turned = _moved(inliers, wrong) / np.sqrt(values[0])
        return each.mean() + turned * (np.linalg.norm(offset, axis=1) + shift)
    centred = inliers.centred
    weights = 1 / m + np.linalg.solve(centred.T @ centred, offset.T).T @ centred.T
    return np.abs(weights) @ inliers.bounds + np.linalg.norm(weights @ inliers.residuals, axis=1)
