"""What became of a problem: its status, the measurements that were trusted, and the pose behind them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int, UInt32

from teaser_jax.ground.arrays import AnyArray, Placeholder
from teaser_jax.ground.numbers import NamedNumber
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem
from teaser_jax.rows import Rows


class Status(NamedNumber):
    """What became of a solve. ``OK`` is the only one to act upon. Held as int32 inside JAX."""

    OK = 0
    TOO_FEW_POINTS = 1
    NO_CONSENSUS = 2
    DEGENERATE = 3
    AMBIGUOUS = 4
    NOT_CONVERGED = 5
    MIRRORED = 6
    BY_POSITION = 7

    @property
    def advice(self) -> str:
        """One sentence: what happened and what to try."""
        return _ADVICE[self]


_ADVICE = {
    Status.OK: "The pose is determined by its inliers, and they agree better than chance allows.",
    Status.TOO_FEW_POINTS: (
        "Fewer than 3 usable matches, exact copies counted once: check for non-finite or repeated rows, the "
        "mask and the confidences, and that noise_bound, cbar2 and scale are numbers above 0; or give more "
        "matches."
    ),
    Status.NO_CONSENSUS: (
        "No set of matches agrees better than wrong matches would by chance: check that the two clouds "
        "overlap, that noise_bound is in the unit of the target, and that scale is right (scale=None "
        "estimates it); or find better matches."
    ),
    Status.DEGENERATE: (
        "The inliers lie on a point or a line compared with noise_bound, so they do not determine the "
        "rotation or the scale: give a smaller noise_bound if it is too large for the unit of the points, or "
        "add matches away from that line."
    ),
    Status.AMBIGUOUS: (
        "Another pose explains the input as well, so no one can tell which of them is right: look at both, "
        "or give what tells them apart, as a larger part of the scene."
    ),
    Status.MIRRORED: (
        "The clouds are mirror images: the matches agree pairwise, and a reflection explains them where no "
        "rotation does. One of them is left-handed: flip any one axis of it, or swap two."
    ),
    Status.BY_POSITION: (
        "The matches join nearest neighbours in the frames as given, also those that the pose leaves out. "
        "Matches made by position cannot tell a small motion from none, so even aligned clouds are refused: "
        "start from matches of descriptors."
    ),
    Status.NOT_CONVERGED: (
        "An iteration cap was reached before the inliers settled: raise the iterations of Gnc or of "
        "Refinement, as in Settings(rotation=Gnc(iterations=200), refine=Refinement(iterations=100))."
    ),
}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Selection:
    """Which measurements to trust: the discrete half of the method. No gradient flows into it.

    Attributes:
        scale_pairs: TRIMs in the consensus of the scale: packed bit rows (bit t of word j in row
            i is the pair of the matches at the places i and 32 j + t), or a mask of the given pairs, or
            None: scale known.
        clique: Members of the clique. Exact copies of a match are in a set with it, or out with it.
        rotation: TIMs kept by the rotation stage: by their first member (chain), packed bit rows
            (complete), or a mask of the given pairs.
        translation: Points in the consensus of each axis of the translation.
        inliers: Joint residual within c w beta_i when refined, otherwise clique and all three axes.
        refined: Whether the pose is the joint fit to ``inliers``.
        widening: w, by which all bounds were wider than asked for, because the fit has errors of its own
            [-]; 1 where nothing was refined.
        rows: Where the rows were solved: the chain of TIMs runs through the clique in their order. None: as
            they are.
    """

    scale_pairs: UInt32[AnyArray, "... n w"] | Bool[AnyArray, "... m"] | Placeholder | None
    clique: Bool[AnyArray, "... n"] | Placeholder
    rotation: Bool[AnyArray, "... k"] | UInt32[AnyArray, "... n w"] | Placeholder
    translation: Bool[AnyArray, "... n 3"] | Placeholder
    inliers: Bool[AnyArray, "... n"] | Placeholder
    refined: Bool[AnyArray, "..."] | Placeholder
    widening: Float[AnyArray, "..."] | Placeholder
    rows: Rows | Placeholder | None = None


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Solution:
    """The answer of ``solve``. Finite even when ``status`` says that it failed.

    Attributes:
        pose: Equal to ``refit(problem, selection)``, if there is an inlier.
        selection: The sets behind the pose.
        inliers: ``selection.inliers``, in the user's order.
        status: A ``Status`` as int32; the first failure sticks.
        clique_size: Members of the clique, copies counted once; where matches crowd at a point, it has each
            point once.
        clique_upper_bound: No pose explains more matches, copies counted once: proved. Equal to the size of
            a maximum clique where no matches crowd.
        clique_is_maximum: Whether it is proved that no clique of that kind is larger; never without pruning.
        excluded: Rows left out because they hold NaN or infinity.
        cost: The joint cost (6) of the pose, with the widened bounds and copies counted once [-].
    """

    pose: Pose
    selection: Selection
    inliers: Bool[AnyArray, "... n"] | Placeholder
    status: Int[AnyArray, "..."] | Placeholder
    clique_size: Int[AnyArray, "..."] | Placeholder
    clique_upper_bound: Int[AnyArray, "..."] | Placeholder
    clique_is_maximum: Bool[AnyArray, "..."] | Placeholder
    excluded: Int[AnyArray, "..."] | Placeholder
    cost: Float[AnyArray, "..."] | Placeholder

    @property
    def ok(self) -> Bool[AnyArray, "..."]:
        """Whether the pose can be trusted. A proof elsewhere never turns this true."""
        return self.status == Status.OK

    def __repr__(self) -> str:
        if isinstance(self.status, jax.core.Tracer) or np.shape(self.status) != ():
            return f"Solution(status={self.status!r}, inliers of shape {np.shape(self.inliers)})"
        return (
            f"Solution(status={Status(int(self.status)).name}, {int(np.sum(self.inliers))} of "
            f"{np.shape(self.inliers)[-1]} matches, pose={self.pose!r})"
        )


def problem_and_solution(problem: Any, solution: Any, caller: str) -> tuple[Problem, Solution]:
    """Read a problem and its solution; the answer of ``register``, which holds both, may stand for either.

    Args:
        problem: A ``Problem``, or what has one.
        solution: Its ``Solution``, or what has one; None: what the first argument has.
        caller: Who asks, for the error.

    Raises:
        ValueError: If one of the two is something else, or they do not belong together.
    """
    solution = getattr(problem if solution is None else solution, "solution", solution)
    problem = getattr(problem, "problem", problem)
    for name, value, kind in (("problem", problem, Problem), ("solution", solution, Solution)):
        if not isinstance(value, kind):
            raise ValueError(
                f"{caller} received {type(value).__name__} for a {name}: give the answer of register alone, "
                "or a problem and its solution."
            )
    if np.shape(solution.inliers) != np.shape(problem.mask):
        raise ValueError(
            f"the problem has rows of shape {np.shape(problem.mask)} and the solution inliers of shape "
            f"{np.shape(solution.inliers)}: expected a problem and its own solution."
        )
    return problem, solution


def as_asked(solution: Solution, rows: Rows, *, has_pairs: bool) -> Solution:
    """Carry the sets of a solution from their places to the user's rows."""
    selection = with_rows(solution.selection, rows, has_pairs=has_pairs)
    return replace(solution, selection=selection, inliers=selection.inliers)


def with_rows(selection: Selection, rows: Rows, *, has_pairs: bool) -> Selection:
    """Carry the sets of a selection to the user's rows; sets of pairs stay at the places of their matches."""
    s = selection
    of_rows = s.rotation.dtype == bool and not has_pairs
    sets = [s.clique[:, None], s.inliers[:, None], s.translation, *([s.rotation[:, None]] if of_rows else [])]
    there = jnp.concatenate(sets, axis=1)[rows.place]  # in one piece: rows are gathered as fast as numbers
    return replace(
        s,
        clique=there[:, 0],
        inliers=there[:, 1],
        translation=there[:, 2:5],
        rotation=there[:, 5] if of_rows else s.rotation,
        rows=rows,
    )
