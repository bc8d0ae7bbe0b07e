"""What one pose explains and another cannot: a cupboard tells the two ways round of a room apart.

Two poses may fit equally large parts of an overlap. Walls fit both ways round; what stands in the room fits
one of them, and in the other lies where nothing is. Cells that leave the surroundings of the other cloud say
nothing.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.pairing import ACROSS, ALIGNED, LINES, Laid, Pairing, pair

MARGIN = 3.0  # cells: so far inside the hull of a cloud must a cell lie to say anything


class Lead(NamedTuple):
    """How far a pose is ahead of another.

    Attributes:
        share: The part of all cells that one of them explains by which the first explains more [-].
        against: What the other explains alone, for each that the first explains alone [-].
    """

    share: float
    against: float

    def at_worst(self, other: Lead) -> Lead:
        """Take of two leads the smaller share, and what speaks more against it."""
        return Lead(min(self.share, other.share), max(self.against, other.against))


def lead(laid: Laid, other: Float[np.ndarray, "4 4"]) -> Lead:
    """Compare what two poses explain, every direction of normals counting the same.

    Args:
        laid: The surfaces in the first pose.
        other: The second, from the source to the target frame, as both surfaces stand.
    """
    src, dst = laid.src, laid.dst
    forth = _weights(laid.here, pair(other, src, dst), dst)
    ours, theirs, both = np.add(forth, _weights(laid.back, pair(np.linalg.inv(other), dst, src), src))
    total = ours + theirs + both
    if total == 0:
        return Lead(0.0, np.inf)
    return Lead(float((ours - theirs) / total), float(theirs / ours) if ours > 0 else np.inf)


def _weights(here: Pairing, there: Pairing, dst: Surface) -> tuple[float, float, float]:
    """Weigh the cells that the first explains alone, the other alone, and both."""
    says_here, says_there = (_would_show(x, dst) for x in (here, there))
    kinds = here.fits & ~there.fits & says_there, there.fits & ~here.fits & says_here, here.fits & there.fits
    ours, theirs, both = (float(here.weight[kind].sum()) for kind in kinds)
    return ours, theirs, both


def _would_show(pairing: Pairing, dst: Surface) -> Bool[np.ndarray, " n"]:
    """Tell which cells would lie on the other surface if the pose were right.

    A cell in the plane of the nearest one and further along lies behind an edge of what was seen there.
    """
    cosine = np.sum(pairing.normals * pairing.partner_normals, axis=1)
    level = (np.abs(pairing.residual) < ACROSS * dst.voxel_size) & (cosine > ALIGNED)
    return np.where(pairing.near, pairing.fits | ~level, _within_hull(pairing.points, dst))


def _within_hull(points: Float[np.ndarray, "n 3"], surface: Surface) -> Bool[np.ndarray, " n"]:
    """Tell which points lie well inside the hull of a surface, as seen along some fifty lines."""
    along, own = points @ LINES.T, surface.points @ LINES.T
    margin = MARGIN * surface.voxel_size
    return ((along > own.min(axis=0) + margin) & (along < own.max(axis=0) - margin)).all(axis=1)
