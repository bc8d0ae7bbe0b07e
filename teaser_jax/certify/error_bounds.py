"""How far the pose can be from the truth, if what cannot be known is assumed (section IX).

Two kinds. The bounds of the paper (``paper_bounds.py``) are for the plain cascade and rest on the worst four
inliers; they come with the contracts that they are part of. And a bound over the whole inlier set
(``whole_set.py``), for the pose itself, with one assumption that is said.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np

from teaser_jax.certify.bounds import Bound, InlierSet
from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import in_float64
from teaser_jax.certify.paper_bounds import Contract, contracts, paper_bounds
from teaser_jax.certify.pose import certify, on_host
from teaser_jax.certify.whole_set import WholeSet, whole_set
from teaser_jax.ground.arrays import is_traced
from teaser_jax.ground.checks import whole_number
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, clean
from teaser_jax.refit import as_judged, as_solved, cascade_pose
from teaser_jax.solution import Selection, Solution, problem_and_solution


@dataclass(frozen=True)
class ErrorBounds:
    """Bounds on the error of a pose, and what they rest on: the answer of ``error_bounds``.

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
        rows = [
            self.whole_set.words,
            f"cascade, (26) - (28): scale {self.scale.words}, matrix {self.matrix.words}, translation "
            f"{self.translation.words}",
            *(contract.words for contract in self.contracts),
        ]
        return "ErrorBounds(\n  " + "\n  ".join(rows) + "\n)"


def error_bounds(
    problem: Problem | Any,
    solution: Solution | Any = None,
    *,
    wrong: int | np.integer = 0,
    certificate: Certificate | None = None,
) -> ErrorBounds:
    """Bound the error of a pose, and say what each bound rests on.

    Args:
        problem, solution: The answer of ``register`` alone, or a problem and what ``solve`` made of it; one
            problem, concrete values.
        wrong: How many of the inliers may be wrong, for the bound over the whole set.
        certificate: Of the rotation subproblem, as ``certify(..., about="chain")`` gives it; None: made here.

    Returns:
        An ``ErrorBounds``. A bound is NaN with the reason where it cannot be computed, and marked where it
        exceeds what is always true.

    Raises:
        ValueError: If the two do not belong together, inside jit, for a stack of solutions, or for a
            negative ``wrong``.

    Gradients: none; numpy on the host.

    References: Yang, Shi, Carlone, T-RO 2021, Theorems 15 - 17, (26) - (28).
    """
    problem, solution = problem_and_solution(problem, solution, "error_bounds")
    if is_traced(problem, solution) or np.ndim(solution.status) != 0:
        raise ValueError("error_bounds takes one problem and runs outside jit: give it the items one by one.")
    wrong = whole_number("wrong", wrong, 0, what="the number of inliers that may be wrong")
    if not isinstance(certificate, Certificate | None):
        raise ValueError(
            f"certificate is of type {type(certificate).__name__}: expected what certify(..., about='chain') "
            "gives."
        )
    p, s = on_host((problem, solution))
    certificate = certify(p, s, about="chain") if certificate is None else certificate
    cascade = in_float64(lambda: jax.device_get(_cascade(p, s.selection)))
    judged = as_judged(p, s.selection)
    agreed = InlierSet.of(judged, cascade, s.selection.clique & s.selection.translation.all(axis=1))
    return ErrorBounds(
        whole_set(InlierSet.of(judged, s.pose, s.inliers), wrong),
        *paper_bounds(agreed),
        cascade=cascade,
        contracts=contracts(judged, s, agreed, certificate),
        certificate=certificate,
    )


@jax.jit
def _cascade(problem: Problem, selection: Selection) -> Pose:
    """Compute the pose of the plain cascade on the chosen sets, as one program."""
    return cascade_pose(*as_solved(clean(problem)[0], selection))
