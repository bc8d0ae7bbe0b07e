"""Whether a pose between two clouds deserves trust: does it fit, does it hold, and does nothing else fit?

Matches can be wrong together; the clouds themselves tell. Six questions: are there cells enough, do they
fit at two widths, do they leave free what the sensors looked through, do their normals hold all six motions,
does the overlap fit as well in another pose, and how much of the fit is explained by no other pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.fine import align
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.observability import Observability, observability
from teaser_jax.clouds.trust.pairing import lay
from teaser_jax.clouds.trust.planes import beyond_planes
from teaser_jax.clouds.trust.rivals import Guess, Rivals, find_rivals
from teaser_jax.clouds.trust.space import in_front
from teaser_jax.solution import Status

CELLS, MOST_CELLS = 6000, 10**9  # of the smaller cloud; a map may have as many as it needs
FINE_CELLS, MOST_FINE_CELLS = 20_000, 400_000
FINE_ASKED = 5000  # of the finer cells
FINER = 0.8  # of the width: another look is worth it only where cells become so much smaller
# A pose is off by less than so many expected displacements: bent fragments by two and a half.
SURELY = 3.0
FIT_OF_GUESS = 0.60  # from which on an initial pose rules out rivals: a wrong one on hills fits 0.28


@dataclass(frozen=True, eq=False)
class Evidence:
    """What speaks for a pose between two clouds and against it.

    Attributes:
        voxel_size, fine_voxel_size: Widths of the cells that were laid onto one another [length].
        cells: How many of them fit, the smaller number of both ways.
        fit, fine_fit: Which part of the overlap fits, every direction of normals counting the same, the
            smaller of both ways [-]; at the finer width, too.
        overlap: Which part of either cloud lies in the overlap, the smaller one [-].
        support: Which part of either cloud fits, the smaller one [-].
        in_front: Which part of either cloud lies in front of what the other sensor saw, the larger one [-];
            NaN: no viewpoint is known.
        residual: How far the surfaces lie apart along their normals [length].
        beyond_planes: Which share of what fits lies off the five largest planes [-].
        seen: Which motions the normals see.
        rivals: What other poses explain.
    """

    voxel_size: float
    fine_voxel_size: float
    cells: int
    fit: float
    fine_fit: float
    overlap: float
    support: float
    in_front: float
    residual: float
    beyond_planes: float
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


Doubt: TypeAlias = Literal[
    "matches",
    "cells",
    "fit",
    "space",
    "free",
    "rival",
    "own",
    "plain",
    "tolerance",
    "part",
    "viewpoint",
    "guess",
]


class Limits(NamedTuple):
    """What a pose must reach, and what another one may: fitted over made-up places (``benchmarks.verdict``).

    Attributes:
        cells: The least number that fits.
        fit, fine_fit: The least part of the overlap that fits [-].
        own: The least part that no other pose explains [-].
        visible: The least share of any motion that the normals see [-].
        in_front: What may lie in front of what a sensor saw [-].
        beyond_planes: What must lie off five planes [-].
        equal, of_fit: What another pose may reach, of the cells that fit, and of the fit [-].
        lead: Where the pose is so far ahead of all others, it counts whatever they reach [-],
        against: if these explain so little alone for what it explains alone [-],
        good_fit: and if it fits so well [-],
        whole: and if so much of both clouds lies in the overlap: what sees a room in part may be far ahead
            in a pose that lays all on the wrong half of it [-].
    """

    cells: int = 300
    fit: float = 0.20
    fine_fit: float = 0.14
    own: float = 0.18
    visible: float = 0.008
    in_front: float = 0.10
    beyond_planes: float = 0.01
    equal: float = 0.80
    of_fit: float = 0.82
    lead: float = 0.10
    against: float = 0.20
    good_fit: float = 0.85
    whole: float = 0.9


LIMITS = Limits()


class Verdict(NamedTuple):
    """Whether to trust a pose, and which question it failed; None: none.

    "matches": there is no pose, as no points look alike; "cells": too few of them fit; "fit": too small a
    part of the overlap; "space": too much lies where a sensor looked through; "free": a motion that the
    normals do not see; "rival": another pose explains as much; "own": too little is explained by this pose
    alone; "plain": all that fits is a few planes, as in any corner of any room; "tolerance": it holds, and
    less precisely than asked for; "part": a part is not what was scanned, or not found; "viewpoint": it is,
    if the camera stood where the scan suggests; "guess": the pose lies further from the initial one than
    that was said to be off.
    """

    status: Status
    doubt: Doubt | None


@dataclass(frozen=True, eq=False)
class Judged:
    """A pose between the middles of two clouds, aligned once more, and what is known of it."""

    pose: Float[np.ndarray, "4 4"]
    evidence: Evidence
    verdict: Verdict


def judge(
    pose: Float[np.ndarray, "4 4"],
    pair: Pair,
    others: Sequence[Float[np.ndarray, "4 4"]] = (),
    *,
    guess: Guess | None = None,
    refine: str | None = "gicp",
    tolerance: float | None = None,
) -> Judged:
    """Judge a pose by the two clouds alone.

    Args:
        pose: From the source to the target, each about its middle.
        pair: The clouds.
        others: Further candidates: if one is another pose and fits as well, the answer is ambiguous.
        guess: What was known before; where the fit is good, other poses that contradict it are no rivals.
        refine: How to align the pose at the finer cells: "gicp", "plane", or None for not at all.
        tolerance: How far points of the overlap may be off [length]; None: two cells.
    """
    a, b = pair.surfaces_near(pose, CELLS, MOST_CELLS)
    with pair.timed("alignment"):
        pose = pose if refine is None else align(pose, a, b)
    finer = _at_finer_cells(pose, pair, a, b, refine)
    pose = finer.pose
    with pair.timed("verdict"):
        laid = lay(pose, a, b)
        fits = laid.here.fits
        seen = observability(laid.here)
        rivals = find_rivals(laid, seen, others, images=pair.images)
    evidence = Evidence(
        voxel_size=b.voxel_size,
        fine_voxel_size=finer.voxel_size,
        cells=laid.count,
        fit=laid.fit,
        fine_fit=finer.fit,
        overlap=laid.overlap,
        support=laid.support,
        in_front=in_front(pose, a, b, pair.images),
        residual=laid.residual,
        beyond_planes=beyond_planes(laid.here.points[fits], laid.here.normals[fits], b.voxel_size),
        seen=seen,
        rivals=rivals,
    )
    verdict = verdict_of(evidence, tolerance)
    if guess is not None and evidence.fit >= FIT_OF_GUESS and verdict.doubt in ("rival", "own", "plain"):
        with pair.timed("verdict"):
            fewer = find_rivals(laid, seen, others, images=pair.images, guess=guess)
        evidence = replace(evidence, rivals=fewer)
        verdict = verdict_of(evidence, tolerance, LIMITS._replace(beyond_planes=0.0))
    return Judged(pose, evidence, verdict)


def verdict_of(evidence: Evidence, tolerance: float | None = None, limits: Limits = LIMITS) -> Verdict:
    """Give the verdict: OK, or the first question that the evidence fails.

    Args:
        evidence: What is known of the pose.
        tolerance: How far points of the overlap may be off [length]; None: two cells.
        limits: What is asked of it.
    """
    e, least, most = evidence, limits, limits
    if e.cells < least.cells:
        return Verdict(Status.NO_CONSENSUS, "cells")
    if e.fit < least.fit or e.fine_fit < least.fine_fit:
        return Verdict(Status.NO_CONSENSUS, "fit")
    if e.in_front > most.in_front:
        return Verdict(Status.NO_CONSENSUS, "space")
    if e.seen.visible[0] < least.visible:
        return Verdict(Status.DEGENERATE, "free")
    ahead = e.rivals.lead.share >= least.lead and e.rivals.lead.against <= most.against
    if not (ahead and e.fit >= least.good_fit and e.overlap >= least.whole):
        if e.rivals.equal > most.equal or e.rivals.fit > most.of_fit * e.fit:
            return Verdict(Status.AMBIGUOUS, "rival")
        if e.own < least.own:
            return Verdict(Status.NO_CONSENSUS, "own")
        if e.beyond_planes < least.beyond_planes:
            return Verdict(Status.AMBIGUOUS, "plain")
    if tolerance is not None and SURELY * e.displacement > tolerance:
        return Verdict(Status.DEGENERATE, "tolerance")
    return Verdict(Status.OK, None)


class _Finer(NamedTuple):
    """What the finer cells say."""

    pose: Float[np.ndarray, "4 4"]
    voxel_size: float
    fit: float


def _at_finer_cells(
    pose: Float[np.ndarray, "4 4"], pair: Pair, src: Surface, dst: Surface, refine: str | None
) -> _Finer:
    """Look once more at the finest cells that both samplings carry, and keep the better of two poses there.

    Alignment can end further off than it began, as where a fragment is bent.
    """
    a, b = src, dst
    if pair.width(FINE_CELLS, MOST_FINE_CELLS) < FINER * dst.voxel_size:
        a, b = pair.surfaces_near(pose, FINE_CELLS, MOST_FINE_CELLS, quick=True)
    with pair.timed("alignment"):
        before = lay(pose, a, b, FINE_ASKED).fit
        if refine is None:
            return _Finer(pose, b.voxel_size, before)
        other = align(pose, a, b, method=refine)
        after = lay(other, a, b, FINE_ASKED).fit
    return _Finer(other, b.voxel_size, after) if after >= before else _Finer(pose, b.voxel_size, before)
