"""The bounds (26) - (28) of the paper for the plain cascade, and the contracts of its theorems (section IX).

The bounds rest on the worst four inliers. They hold where Theorem 17 does; of each condition of Theorems
15 - 17 it is said whether it holds, fails, or cannot be checked.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from teaser_jax.certify.bounds import Bound, InlierSet
from teaser_jax.certify.certificate import Certificate
from teaser_jax.problem import Problem
from teaser_jax.solution import Solution

MAX_FOURS = 60  # inliers whose subsets of four are all looked at: half a million
MAX_PAIRS = 5000
MAX_TRIPLES = 300
ZERO = 1e-9  # share of the bound up to which a residual is called zero


class PaperBounds(NamedTuple):
    """The bounds (26), (27) and (28): |s - s0|, |s R - s0 R0|_F [-], |t - t0| [length]."""

    scale: Bound
    matrix: Bound
    translation: Bound


class Condition(NamedTuple):
    """What a theorem asks, and whether it holds; None where it cannot be checked."""

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

    @property
    def words(self) -> str:
        """The theorem, and whether its conditions hold."""
        words = {True: "holds", False: "fails", None: "cannot be checked in full"}
        return f"{self.theorem}: {words[self.holds]}"


def paper_bounds(inliers: InlierSet) -> PaperBounds:
    """Compute the bounds of Theorem 17 from the inliers of the cascade."""
    m = len(inliers)
    if m < 4:
        nothing = Bound.unknown(f"the cascade has {m} inliers: four are needed")
        return PaperBounds(nothing, nothing, nothing)
    beta = float(inliers.bounds.max())
    translation = Bound.below((9 + 3 * np.sqrt(3)) * beta, inliers.diameter)
    if m > MAX_PAIRS:
        nothing = Bound.unknown(f"more than {MAX_PAIRS} inliers: not all pairs are looked at")
        return PaperBounds(nothing, nothing, translation)
    alpha = _largest_alpha(inliers)
    scale = Bound.below(0.0 if inliers.known_scale else 2 * alpha, inliers.scale)
    if m > MAX_FOURS:
        matrix = Bound.unknown(f"{m} inliers: all fours are looked at up to {MAX_FOURS}")
    else:
        flattest = flattest_four(inliers.src)
        value = 2 * np.sqrt(3) * alpha / flattest if flattest > 0 else np.inf
        matrix = Bound.below(value, inliers.matrix_limit)
    return PaperBounds(scale, matrix, translation)


def _largest_alpha(inliers: InlierSet) -> float:
    """Find the largest alpha_ij = (c beta_i + c beta_j) / |a_i - a_j| of all pairs [-]."""
    a, beta = inliers.src, inliers.bounds
    largest = 0.0
    for i in range(len(a) - 1):
        lengths = np.linalg.norm(a[i + 1 :] - a[i], axis=1)
        with np.errstate(divide="ignore"):
            largest = max(largest, float(np.max((beta[i] + beta[i + 1 :]) / lengths)))
    return largest


def flattest_four(points: Float[np.ndarray, "m 3"]) -> float:
    """Find the smallest singular value of U over all (i; j, h, k): unit vectors from point i to three others.

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


def contracts(
    problem: Problem, solution: Solution, inliers: InlierSet, certificate: Certificate
) -> tuple[Contract, Contract, Contract]:
    """Check the conditions of Theorems 15, 16 and 17.

    Args:
        problem, solution: As numpy arrays.
        inliers: Those of the cascade.
        certificate: Of the rotation subproblem.
    """
    p = problem
    m, n = len(inliers), int(np.sum(p.mask)) - int(solution.excluded)
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


def _no_three_on_a_line(points: Float[np.ndarray, "m 3"]) -> bool | None:
    """Check that no three points are on a line; None where there are too many to look at all."""
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
