"""What lies behind an answer that is not ok: causes that can be told from the numbers that were given."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from teaser_jax.engine.single import solve_one
from teaser_jax.problem import Problem
from teaser_jax.reading import finite_rows
from teaser_jax.settings import Settings
from teaser_jax.solution import Solution, Status
from teaser_jax.stages.clique.exact import ExactClique

# A right match lies within its bound, wherever a cloud of this many bounds across is turned.
FEWEST_BOUNDS = 3.0
UNUSUAL = 100.0  # times the usual bound
PAIRS = 100_000  # drawn for their ratios of lengths, or as many as there are
CANDIDATES = 3
# A dense graph must not make an answer that failed slow.
BRIEFLY = Settings(clique=ExactClique(seconds=0.2))


def advice(problem: Problem, solution: Solution) -> str:
    """Tell what happened and what to try, in sentences: the causes that the numbers show, then the status.

    Args:
        problem: In numpy, as ``register`` read it.
        solution: Its solution.

    Of answers that failed at a known scale a likely other scale is tried by solving once more.
    """
    status = Status(int(solution.status))
    if status == Status.OK:
        return status.advice
    usable = np.arange(len(problem.src))[finite_rows(problem.src, problem.dst, problem.mask)]
    causes = [*_bounds(problem, usable), *_pairs(problem)] if len(usable) else []
    other = None if causes or len(usable) < 3 else _other_scale(problem, usable)
    if other is not None:
        return (
            f"The matches agree at scale {other:.3g}, not at the one given: pass scale=None to estimate it, "
            "with noise_bound in the unit of dst."
        )
    return " ".join([*causes, status.advice])


def _bounds(problem: Problem, usable: np.ndarray) -> list[str]:
    """Tell of bounds that do not suit the clouds, or one another."""
    bounds, usual = problem.noise_bound[usable], float(np.median(problem.noise_bound[usable]))
    across = _across(problem.dst[usable])
    if 0 < across < FEWEST_BOUNDS * usual:
        size = "larger than the scene" if across < usual else "nearly as large as the scene"
        return [
            f"noise_bound is {usual:.3g} and {size}, which is {across:.3g} across in dst: give the largest "
            "error of a right match, in the unit of dst."
        ]
    odd = usable[(bounds > UNUSUAL * usual) | (bounds < usual / UNUSUAL)]
    if not len(odd):
        return []
    rows = ", ".join(str(row) for row in odd[:5]) + (", ..." if len(odd) > 5 else "")
    return [
        f"noise_bound is {usual:.3g} for most matches and {problem.noise_bound[odd[0]]:.3g} in row {odd[0]}: "
        f"check the unit of {len(odd)} of {len(usable)} bounds (rows {rows})."
    ]


def _pairs(problem: Problem) -> list[str]:
    """Tell what pairs are, to those who gave some."""
    if problem.pairs is None:
        return []
    return [
        "pairs are rows to compare with one another, not correspondences: if they are correspondences, "
        "pass src[pairs[:, 0]] and dst[pairs[:, 1]], without pairs."
    ]


def _across(points: Float[np.ndarray, "n 3"]) -> float:
    """Measure twice how far points reach from their middle, without the farthest in a hundred."""
    distance = np.linalg.norm(points - np.median(points, axis=0), axis=1)
    return 2 * float(np.quantile(distance, 0.99))


def _other_scale(problem: Problem, usable: np.ndarray) -> float | None:
    """Find another scale at which the matches do register, or None."""
    if problem.scale is None:
        return None
    for scale in likely_scales(problem, usable):
        solution = solve_one(replace(problem, scale=np.asarray(scale, problem.src.dtype)), BRIEFLY)
        if solution.status == Status.OK:
            return scale
    return None


def likely_scales(problem: Problem, usable: np.ndarray) -> list[float]:
    """Find where ratios of lengths in the two clouds crowd, most crowded first [-].

    Pairs of right matches give the scale, those of wrong ones anything; ``CANDIDATES`` peaks are looked at.
    """
    drawn = np.random.default_rng(0).choice(usable, (min(PAIRS, len(usable) ** 2), 2))
    a, b = (np.linalg.norm(x[drawn[:, 0]] - x[drawn[:, 1]], axis=1) for x in (problem.src, problem.dst))
    reach = np.sqrt(float(problem.cbar2)) * problem.noise_bound[drawn].sum(axis=1)
    tell = (a > 0) & (b > 2 * reach)  # shorter ones agree with too many scales
    if not tell.any():
        return []
    logs = np.sort(np.log(b[tell] / a[tell]))
    width = float(np.median(reach[tell] / b[tell]))

    def within(distance: float) -> np.ndarray:  # itself at least, however small the distance
        return np.searchsorted(logs, logs + distance, side="right") - np.searchsorted(logs, logs - distance)

    usual = within(5 * width) / 5
    excess = (within(width) - usual) / np.sqrt(usual)
    found: list[float] = []
    for peak in logs[np.argsort(-excess)]:
        if all(abs(peak - other) > 2 * width for other in found):
            found.append(peak)
            if len(found) == CANDIDATES:
                break
    return [float(np.exp(peak)) for peak in found]
