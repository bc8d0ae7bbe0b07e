"""Whether a pose between two clouds deserves trust: does it fit, does it hold, and does nothing else fit?

Matches can be wrong together; the clouds themselves tell. Five questions: are there cells enough, do they
fit at two widths, do their normals hold all six motions, does the overlap fit as well in another pose, and
how much of the fit is explained by no other pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.fine import align
from teaser_jax.clouds.surface import FEW_NEIGHBOURS, Surface
from teaser_jax.clouds.trust.observability import Observability, observability
from teaser_jax.clouds.trust.pairing import both_ways, moved
from teaser_jax.clouds.trust.rivals import Rivals, find_rivals
from teaser_jax.clouds.voxel import downsample, voxel_size_for_both
from teaser_jax.solution import Status

CELLS, MOST_CELLS = 6000, 10**9  # of the smaller cloud; a map may have as many as it needs
FINE_CELLS, MOST_FINE_CELLS = 20_000, 400_000
FINER = 0.8  # of the width: another look is worth it only where cells become so much smaller
# What a pose must reach.
FEWEST_CELLS = 300
LEAST_FIT, LEAST_FINE_FIT = 0.20, 0.14
LEAST_OWN = 0.14
LEAST_VISIBLE = 0.008
# What another pose may reach: of the cells that fit, and of the fit.
MOST_EQUAL, MOST_OF_FIT = 0.80, 0.82
# Where the pose is so far ahead of all others, it counts whatever they reach: with a cupboard in a box room
# it is 0.13 ahead, in a corridor one door further on, or on stairs a step, 0.08 at most.
ENOUGH_LEAD, MOST_AGAINST, GOOD_FIT = 0.10, 0.20, 0.60


@dataclass(frozen=True, eq=False)
class Evidence:
    """What speaks for a pose between two clouds and against it.

    Attributes:
        voxel_size, fine_voxel_size: Widths of the cells that were laid onto one another [length].
        cells: How many of them fit, the smaller number of both ways.
        fit, fine_fit: Which part of the overlap fits, every direction of normals counting the same, the
            smaller of both ways [-]; at the finer width, too.
        overlap: Which part of either cloud lies in the overlap, the smaller one [-].
        residual: How far the surfaces lie apart along their normals [length].
        seen: Which motions the normals see.
        rivals: What other poses explain.
    """

    voxel_size: float
    fine_voxel_size: float
    cells: int
    fit: float
    fine_fit: float
    overlap: float
    residual: float
    seen: Observability
    rivals: Rivals

    @property
    def own(self) -> float:
        """The part of the fit that no other pose explains [-]."""
        return self.fit * (1 - self.rivals.equal)

    @property
    def displacement(self) -> float:
        """How far points of the overlap may be off [length]."""
        return self.seen.displacement(self.residual)


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose, aligned once more, and what is known of it."""

    pose: Float[np.ndarray, "4 4"]
    evidence: Evidence
    status: Status


def judge(
    pose: Float[np.ndarray, "4 4"],
    src: Float[np.ndarray, "n 3"],
    dst: Float[np.ndarray, "m 3"],
    others: Sequence[Float[np.ndarray, "4 4"]] = (),
    threads: int = 1,
) -> Judged:
    """Judge a pose by the two clouds alone.

    Args:
        pose: From the source to the target frame, as the points stand here.
        src, dst: About their middles, nothing repeated and no strays [length].
        others: Further candidates: if one is another pose and fits as well, the answer is ambiguous.
        threads: How many threads to ask neighbours with.
    """
    size = voxel_size_for_both(src, dst, CELLS, MOST_CELLS)
    near_dst = _around(dst, moved(pose, src), size)
    near_src = _around(src, moved(np.linalg.inv(pose), near_dst), size)
    a, b = (
        Surface(downsample(x, size), size, threads=threads, count=FEW_NEIGHBOURS)
        for x in (near_src, near_dst)
    )
    pose = align(pose, a, b)
    here, back = both_ways(pose, a, b)
    seen = observability(here)
    chosen = here.fits & (here.weight > 0)
    residual = 1.4826 * float(np.median(np.abs(here.residual[chosen]))) if chosen.any() else np.inf
    fine_size, fine_fit = _at_finer_cells(pose, near_src, near_dst, size, threads)
    fit = min(here.fit, back.fit)
    evidence = Evidence(
        voxel_size=size,
        fine_voxel_size=fine_size,
        cells=min(here.count, back.count),
        fit=fit,
        fine_fit=fit if fine_fit is None else fine_fit,
        overlap=min(here.overlap, back.overlap),
        residual=residual,
        seen=seen,
        rivals=find_rivals(pose, a, b, here, seen, others),
    )
    return Judged(pose, evidence, status_of(evidence))


def status_of(evidence: Evidence) -> Status:
    """Give the verdict: the first question that the evidence fails, or OK."""
    e = evidence
    if e.cells < FEWEST_CELLS or e.fit < LEAST_FIT or e.fine_fit < LEAST_FINE_FIT:
        return Status.NO_CONSENSUS
    if e.seen.visible[0] < LEAST_VISIBLE:
        return Status.DEGENERATE
    ahead = e.rivals.lead.share >= ENOUGH_LEAD and e.rivals.lead.against <= MOST_AGAINST
    if ahead and e.fit >= GOOD_FIT:
        return Status.OK
    if e.rivals.equal > MOST_EQUAL or e.rivals.fit > MOST_OF_FIT * e.fit:
        return Status.AMBIGUOUS
    return Status.OK if e.own >= LEAST_OWN else Status.NO_CONSENSUS


def _around(
    points: Float[np.ndarray, "n 3"], part: Float[np.ndarray, "m 3"], cell: float
) -> Float[np.ndarray, "k 3"]:
    """Cut out of a map what lies around a part of it; where that is more than half of it, leave it whole."""
    low, high = part.min(axis=0), part.max(axis=0)
    margin = 10 * cell + 0.1 * (high - low).max()
    inside = ((points > low - margin) & (points < high + margin)).all(axis=1)
    return points[inside] if 20 < np.count_nonzero(inside) < len(points) / 2 else points


def _at_finer_cells(
    pose: Float[np.ndarray, "4 4"], src: Float[np.ndarray, "n 3"], dst: Float[np.ndarray, "m 3"],
    size: float, threads: int,
) -> tuple[float, float | None]:  # fmt: skip
    """Look once more at the finest cells that both samplings carry: their width, and the fit there."""
    fine = voxel_size_for_both(src, dst, FINE_CELLS, MOST_FINE_CELLS)
    if fine >= FINER * size:
        return size, None
    a, b = (Surface(downsample(x, fine), fine, threads=threads, count=FEW_NEIGHBOURS) for x in (src, dst))
    here, back = both_ways(align(pose, a, b), a, b)
    return fine, min(here.fit, back.fit)
