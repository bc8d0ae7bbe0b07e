"""How far the pose can be from the truth, if what cannot be known is assumed (section IX).

Two kinds. The bounds of the paper, (26) - (28), are for the plain cascade and rest on the worst four inliers;
they come with the contracts of Theorems 15 - 17, each condition with whether it holds, fails, or cannot be
checked. And a bound over the whole inlier set, for the pose itself, with one assumption that is said:

    residuals of the truth n_i, of the pose r_i      |n_i| <= c beta_i,  r_i known
    displacement of inlier i                         e_i = (s R - s0 R0) a_i + t - t0 = n_i - r_i

Centred, D A = N - R with D = s R - s0 R0. So |D A|_F is at most c sqrt(sum beta_i^2) plus the part of R in
the row space of A, which is all but zero for a least squares fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.pose import certify
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import is_traced
from teaser_jax.solve import cascade_pose
from teaser_jax.types import Pose, Problem, Solution

MAX_FOURS = 60  # inliers whose subsets of four are all looked at: half a million
MAX_PAIRS = 5000
MAX_TRIPLES = 300
ZERO = 1e-9  # share of the bound up to which a residual is called zero


class Bound(NamedTuple):
    """A bound, and whether it says more than what is always true; NaN with the reason where there is none."""

    value: float
    informative: bool
    reason: str = ""


class Condition(NamedTuple):
    """What a theorem asks; None where it cannot be checked."""

    text: str
    holds: bool | None


class Contract(NamedTuple):
    """The conditions of a theorem. What it promises is promised only if all of them hold."""

    theorem: str
    conditions: tuple[Condition, ...]

    @property
    def holds(self) -> bool | None:
        """False if a condition fails, None if one cannot be checked, True otherwise."""
        answers = [c.holds for c in self.conditions]
        return False if False in answers else (None if None in answers else True)


@dataclass(frozen=True)
class WholeSet:
    """Distances between the pose and any that fits the inliers, all but ``wrong`` of them, within c beta_i.

    Attributes:
        wrong: How many of the inliers may be wrong matches: an assumption.
        matrix: |s R - s0 R0|_F [-].
        angle: Between the rotations [rad].
        scale: |s - s0| [-]; zero where it is known.
        translation: |t - t0|, of the origin of the source frame [length]; for other points ``at``.
    """

    wrong: int
    matrix: Bound
    angle: Bound
    scale: Bound
    translation: Bound
    _set: _Inliers

    def at(self, points: Float[np.ndarray, "p 3"]) -> Float[np.ndarray, " p"]:
        """How far each source point can be from where the other pose takes it [length of the target]."""
        return self._set.displacement(np.atleast_2d(np.asarray(points, np.float64)), self.wrong)


@dataclass(frozen=True)
class ErrorBounds:
    """What ``error_bounds`` returns.

    Attributes:
        whole_set: For the pose of the solution, on the assumption that its inliers are right.
        scale, matrix, translation: (26), (27), (28): |s - s0|, |s R - s0 R0|_F [-], |t - t0| [length].
        cascade: The pose that these three are about, not the refined one.
        contracts: Theorems 15, 16 and 17.
        certificate: Of the rotation subproblem, to which the contracts refer.
    """

    whole_set: WholeSet
    scale: Bound
    matrix: Bound
    translation: Bound
    cascade: Pose
    contracts: tuple[Contract, Contract, Contract]
    certificate: Certificate

    def __repr__(self) -> str:
        w = self.whole_set
        rows = [
            f"if {f'all but {w.wrong}' if w.wrong else 'all'} inliers are right: rotation within "
            f"{_said(w.angle._replace(value=np.degrees(w.angle.value)))} deg, translation "
            f"{_said(w.translation)}, scale {_said(w.scale)}",
            f"cascade, (26) - (28): scale {_said(self.scale)}, matrix {_said(self.matrix)}, translation "
            f"{_said(self.translation)}",
        ]
        words = {True: "holds", False: "fails", None: "cannot be checked in full"}
        rows += [f"{contract.theorem}: {words[contract.holds]}" for contract in self.contracts]
        return "ErrorBounds(\n  " + "\n  ".join(rows) + "\n)"


def _said(bound: Bound) -> str:
    if bound.informative:
        return f"{bound.value:.3g}"
    return f"{bound.value:.3g} ({bound.reason or 'says nothing'})"


def error_bounds(
    problem: Problem, solution: Solution, *, wrong: int = 0, certificate: Certificate | None = None
) -> ErrorBounds:
    """Bounds on the error of a pose, each with the assumption that it rests on.

    Args:
        problem, solution: The pair that ``solve`` or ``register`` made, one problem, concrete values.
        wrong: How many of the inliers may be wrong, for the bound over the whole set.
        certificate: Of the rotation subproblem, as ``certify(..., about="chain")`` gives it; None: made here.

    Returns:
        An ``ErrorBounds``. A bound is NaN with the reason where it cannot be computed, and marked where it
        exceeds what is always true.

    Raises:
        ValueError: Inside jit, for a stack of solutions, or for a negative ``wrong``.

    Gradients: none; numpy on the host.

    References: Yang, Shi, Carlone, T-RO 2020, Theorems 15 - 17, (26) - (28).
    """
    if is_traced(problem, solution) or np.ndim(solution.status) != 0:
        raise ValueError("error_bounds takes one problem and runs outside jit: give it the items one by one.")
    whole_number("wrong", wrong, 0, what="the number of inliers that may be wrong")
    double = lambda x: np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else np.asarray(x)
    p, s = jax.tree.map(double, (problem, solution))
    certificate = certify(p, s, about="chain") if certificate is None else certificate
    with jax.enable_x64(True):
        cascade = jax.device_get(cascade_pose(p, s.selection))
    agreed = _Inliers.of(p, cascade, s.selection.clique & s.selection.translation.all(axis=1))
    whole = _Inliers.of(p, s.pose, s.inliers)
    return ErrorBounds(
        whole_set(whole, wrong),
        *_of_the_paper(agreed),
        cascade,
        _contracts(p, s, agreed, certificate),
        certificate,
    )


@dataclass(frozen=True)
class _Inliers:
    """The inliers of a pose: points, residuals, c beta_i, and the axes along which they spread."""

    src: np.ndarray
    residuals: np.ndarray
    bounds: np.ndarray
    pose: Pose
    known_scale: bool

    @classmethod
    def of(cls, p: Problem, pose: Pose, chosen: np.ndarray) -> _Inliers:
        src, dst, bounds = (np.asarray(x)[chosen] for x in (p.src, p.dst, p.noise_bound))
        residuals = dst - np.asarray(pose.apply(src))
        return cls(src, residuals, np.sqrt(p.cbar2) * bounds, pose, p.scale is not None)

    @property
    def centre(self) -> np.ndarray:
        return self.src.mean(axis=0)

    @property
    def centred(self) -> np.ndarray:
        return self.src - self.centre

    def spread2(self, wrong: int) -> np.ndarray:
        """Squared singular values of the centred inliers, ascending, if the worst ``wrong`` are taken out.

        Taking points out of a scatter matrix lowers no eigenvalue by more than the squares of their distances
        from the centre, and what the centre moves.
        """
        values = np.linalg.svd(self.centred, compute_uv=False)[::-1] ** 2
        left = len(self.src) - wrong
        if wrong == 0:
            return values
        return np.maximum(values - (1 + wrong / max(left, 1)) * self.furthest2(wrong), 0)

    def furthest2(self, count: int) -> float:
        """The sum of the largest squared distances from the centre."""
        return float(np.sort(np.sum(self.centred**2, axis=1))[::-1][:count].sum())

    def moved(self, wrong: int) -> float:
        """A bound on |D A|_F."""
        noise = np.linalg.norm(self.bounds)
        if wrong > 0:
            return float(noise + np.linalg.norm(self.residuals))
        axes, _, _ = np.linalg.svd(self.centred, full_matrices=False)
        return float(noise + np.linalg.norm(axes.T @ self.residuals))

    def displacement(self, points: np.ndarray, wrong: int) -> np.ndarray:
        """|D x + t - t0|: x is an affine combination of the inliers, and so is its displacement of theirs."""
        m = len(self.src)
        if m - wrong < 3:
            return np.full(len(points), np.nan)
        values = self.spread2(wrong)
        solid = m - wrong >= 4 and values[0] > 1e-18 * values[-1]
        offset = points - self.centre
        if not solid:
            return np.full(len(points), np.inf)
        if wrong > 0:
            each = np.sort(self.bounds + np.linalg.norm(self.residuals, axis=1))[::-1][: m - wrong]
            shift = np.sqrt(wrong * self.furthest2(wrong)) / (m - wrong)
            turned = self.moved(wrong) / np.sqrt(values[0])
            return each.mean() + turned * (np.linalg.norm(offset, axis=1) + shift)
        weights = 1 / m + np.linalg.solve(self.centred.T @ self.centred, offset.T).T @ self.centred.T
        return np.abs(weights) @ self.bounds + np.linalg.norm(weights @ self.residuals, axis=1)


def whole_set(inliers: _Inliers, wrong: int) -> WholeSet:
    """The bounds over all inliers at once."""
    m, scale = len(inliers.src), float(inliers.pose.scale)
    if m - wrong < 3:
        reason = f"{m} inliers, of which {wrong} may be wrong: three right ones are needed"
        nothing = Bound(np.nan, False, reason)
        return WholeSet(wrong, nothing, nothing, nothing, nothing, inliers)
    values, moved = inliers.spread2(wrong), inliers.moved(wrong)
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
    origin = float(inliers.displacement(np.zeros((1, 3)), wrong)[0])
    size, flat = _diameter(inliers), "the right ones may lie in a plane"
    return WholeSet(
        wrong,
        Bound(float(matrix), bool(matrix < 2 * np.sqrt(2) * scale)),
        Bound(float(angle), bool(angle < np.pi)),
        Bound(float(scale_error), bool(scale_error < scale)),
        Bound(origin, bool(origin < size), "" if np.isfinite(origin) else flat),
        inliers,
    )


def _of_the_paper(inliers: _Inliers) -> tuple[Bound, Bound, Bound]:
    """(26), (27) and (28)."""
    m, scale = len(inliers.src), float(inliers.pose.scale)
    if m < 4:
        nothing = Bound(np.nan, False, f"the cascade has {m} inliers: four are needed")
        return nothing, nothing, nothing
    beta = float(inliers.bounds.max())
    translation = (9 + 3 * np.sqrt(3)) * beta
    alpha = _largest_alpha(inliers)
    if np.isnan(alpha):
        nothing = Bound(np.nan, False, f"more than {MAX_PAIRS} inliers: not all pairs are looked at")
        return nothing, nothing, Bound(translation, translation < _diameter(inliers))
    at_26 = 0.0 if inliers.known_scale else 2 * alpha
    if m > MAX_FOURS:
        at_27 = Bound(np.nan, False, f"{m} inliers: all fours are looked at up to {MAX_FOURS}")
    else:
        flattest = flattest_four(inliers.src)
        value = 2 * np.sqrt(3) * alpha / flattest if flattest > 0 else np.inf
        at_27 = Bound(float(value), bool(value < 2 * np.sqrt(2) * scale))
    return Bound(at_26, at_26 < scale), at_27, Bound(translation, translation < _diameter(inliers))


def _largest_alpha(inliers: _Inliers) -> float:
    """The largest (c beta_i + c beta_j) / |a_i - a_j|."""
    a, beta = inliers.src, inliers.bounds
    if len(a) > MAX_PAIRS:
        return np.nan
    largest = 0.0
    for i in range(len(a) - 1):
        lengths = np.linalg.norm(a[i + 1 :] - a[i], axis=1)
        with np.errstate(divide="ignore"):
            largest = max(largest, float(np.max((beta[i] + beta[i + 1 :]) / lengths)))
    return largest


def flattest_four(points: Float[np.ndarray, "m 3"]) -> float:
    """The smallest singular value of U over all (i; j, h, k): unit vectors from point i to three others.

    Exact. With unit columns the two larger singular values multiply to 3/2 at most, so none is below
    2/3 of the determinant, and only those that could be smallest are decomposed.
    """
    smallest = np.inf
    for i in range(len(points)):
        rays = np.delete(points, i, axis=0) - points[i]
        lengths = np.linalg.norm(rays, axis=1)
        if np.any(lengths == 0):
            return 0.0
        rays = rays / lengths[:, None]
        h, k = np.triu_indices(len(rays), 1)
        determinants = np.abs(np.cross(rays[h], rays[k]) @ rays.T)
        # Each triple once: the third after both others.
        determinants[np.arange(len(rays)) <= k[:, None]] = np.inf
        order = np.argsort(determinants, axis=None)
        for start in range(0, order.size, 256):
            chunk = order[start : start + 256]
            pair, third = np.unravel_index(chunk, determinants.shape)
            if determinants[pair[0], third[0]] / 1.5 >= smallest:
                break
            finite = np.isfinite(determinants[pair, third])
            u = np.stack([rays[h[pair]], rays[k[pair]], rays[third]], axis=2)[finite]
            if len(u):
                smallest = min(smallest, float(np.linalg.svd(u, compute_uv=False)[:, 2].min()))
    return smallest


def _diameter(inliers: _Inliers) -> float:
    """Of the inliers in the target frame, by their box."""
    return float(inliers.pose.scale * np.linalg.norm(np.ptp(inliers.src, axis=0)))


def _contracts(
    p: Problem, s: Solution, inliers: _Inliers, certificate: Certificate
) -> tuple[Contract, Contract, Contract]:
    m, n = len(inliers.src), int(np.sum(p.mask)) - int(s.excluded)
    lengths = np.linalg.norm(inliers.residuals, axis=1)
    exact = bool(m > 0 and np.all(lengths <= ZERO * np.linalg.norm(np.ptp(p.dst[p.mask], axis=0))))
    spread = np.zeros(3) if m < 3 else np.linalg.svd(inliers.centred, compute_uv=False)
    distinct = len(np.unique(inliers.src, axis=0)) >= 3
    zero = Condition("the inliers found have no residual in any subproblem", exact)
    proved = Condition("the rotation subproblem is certified", bool(certificate.is_optimal))
    return (
        Contract("Theorem 15, no noise, random outliers", (
            Condition("three of the inliers found are distinct and not on a line",
                      bool(distinct and spread[1] > 1e-9 * spread[0])),
            Condition("the outliers are in generic position", None),
            zero, proved,
        )),
        Contract("Theorem 16, no noise, any outliers", (
            Condition("the inliers found outnumber all others by three", bool(m >= n - m + 3)),
            Condition("no three of the inliers found are on a line", _no_three_on_a_line(inliers.src)),
            zero, proved,
        )),
        Contract("Theorem 17, noise, any outliers", (
            Condition("four of the inliers found are not in a plane",
                      bool(m >= 4 and spread[2] > 1e-9 * spread[0])),
            Condition("the true inliers are in the largest consensus set of each subproblem", None),
            Condition("the second largest consensus set is sufficiently smaller", None),
            proved,
        )),
    )  # fmt: skip


def _no_three_on_a_line(points: np.ndarray) -> bool | None:
    if len(points) > MAX_TRIPLES:
        return None
    for i in range(len(points)):
        rays = points[i + 1 :] - points[i]
        lengths = np.linalg.norm(rays, axis=1, keepdims=True)
        if np.any(lengths == 0):
            return False
        rays = rays / lengths
        across = np.linalg.norm(np.cross(rays[:, None], rays[None]), axis=2)
        if np.any(across[np.triu_indices(len(rays), 1)] < 1e-9):
            return False
    return len(points) >= 3
