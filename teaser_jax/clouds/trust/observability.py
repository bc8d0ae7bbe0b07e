"""Which motions the geometry of an overlap can tell, and which slide or turn freely.

A plane holds three of six motions, a corridor five, a sphere three. What a motion costs is measured by the
normals that it crosses, in units of how far it displaces the points.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.trust.pairing import Pairing
from teaser_jax.ground.arrays import AnyArray, namespace

MOSTLY_SHIFT = 0.5  # of the squared displacement: then a motion is called a slide


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion that leaves what is seen as it is.

    Attributes:
        kind: "slide" along the axis, or "turn" about it.
        axis: Unit vector in the target frame.
        point: A point of the axis, in the target frame [length].
    """

    kind: Literal["slide", "turn"]
    axis: Float[np.ndarray, "3"]
    point: Float[np.ndarray, "3"]

    def __str__(self) -> str:
        """Say in words how it moves."""
        axis = ", ".join(f"{x:.2f}" for x in self.axis)
        if self.kind == "slide":
            return f"slides along ({axis})"
        return f"turns about ({axis}) through ({', '.join(f'{x:.4g}' for x in self.point)})"


@dataclass(frozen=True, eq=False)
class Observability:
    """Six motions of an overlap about its centroid, the least visible first.

    Attributes:
        visible: Which share of each motion (as squared displacement of the points) the normals see [-]:
            one third where they point evenly everywhere, 0 where it slides freely.
        motions: A column for each: three numbers of a shift, in shares of a unit displacement, and three
            of a turn about an axis through the centroid [rad a length].
        centroid: Of the overlap, in the target frame [length].
    """

    visible: Float[np.ndarray, "6"]
    motions: Float[np.ndarray, "6 6"]
    centroid: Float[np.ndarray, "3"]

    def displacement(self, residual: float) -> float:
        """Compute how far points of the overlap may be off where surfaces lie ``residual`` apart [length]."""
        return float(residual * np.sqrt(np.mean(1 / np.maximum(self.visible, 1e-9))))

    def covariance(self, residual: float) -> Float[np.ndarray, "6 6"]:
        """Compute the covariance of a small shift of the centroid and a small turn about it [length, rad].

        It is so large that points of the overlap are off by ``displacement(residual)``, root mean square.
        """
        return residual**2 / 6 * (self.motions / np.maximum(self.visible, 1e-9)) @ self.motions.T

    def free(self, least: float) -> tuple[Motion, ...]:
        """List the motions of which the normals see less than a share: slides first, then turns."""
        free = self.motions[:, self.visible < least]
        # On a plane any mixture of two slides and a turn is free: those with the least turn are taken apart.
        mixture = np.linalg.svd(free[3:], full_matrices=True)[2]
        return tuple(_motion(m, self.centroid) for m in (free @ mixture.T).T[::-1])


def observability(pairing: Pairing) -> Observability:
    """Find which motions of the fitting cells their normals see.

    The normals of both surfaces enter, one on each side: their errors are independent, so that noise does
    not make a plane look held. Where nothing fits, nothing is seen.
    """
    chosen = pairing.fits & (pairing.weight > 0)
    weight = pairing.weight[chosen]
    if len(weight) < 6:
        return Observability(np.zeros(6), np.eye(6), np.zeros(3))
    points, ours, theirs = (x[chosen] for x in (pairing.points, pairing.normals, pairing.partner_normals))
    return Observability(*seen_by(points, ours, theirs, weight / weight.sum()))


def seen_by(
    points: Float[AnyArray, "n 3"],
    ours: Float[AnyArray, "n 3"],
    theirs: Float[AnyArray, "n 3"],
    weight: Float[AnyArray, " n"],
) -> tuple[Float[AnyArray, "6"], Float[AnyArray, "6 6"], Float[AnyArray, "3"]]:
    """Find which motions the normals of two surfaces see, as ``Observability`` has them.

    A pure function: works under jit and vmap.

    Args:
        points: Where they meet [length].
        ours, theirs: Unit normals of both surfaces, to one side.
        weight: Of each point; all add up to 1 [-].
    """
    xp = namespace(points)
    centroid = xp.sum(weight[:, None] * points, axis=0)
    arm = points - centroid[None]
    size = xp.sqrt(xp.sum(weight[:, None] * arm**2))  # turns are measured by it, or units would decide
    arm = arm / xp.where(size > 0, size, 1)
    a, b = (xp.concatenate([n, xp.cross(arm, n)], axis=1) for n in (ours, theirs))
    seen = _moments(weight, a, b)
    spread = _moments(weight, arm, arm)
    still = xp.eye(3, dtype=points.dtype)
    none = xp.zeros((3, 3), points.dtype)
    least = 10 * xp.finfo(points.dtype).eps
    turned = (xp.trace(spread) + least) * still - spread
    moved = xp.block([[still, none], [none, turned]])
    # seen x = visible moved x, by the square root of what is moved.
    values, axes = xp.linalg.eigh(moved)
    root = axes / xp.sqrt(xp.maximum(values, least))[None] @ axes.T
    visible, motions = xp.linalg.eigh(root @ ((seen + seen.T) / 2) @ root)
    motions = root @ motions
    motions = xp.concatenate([motions[:3], motions[3:] / xp.where(size > 0, size, 1)])
    return xp.maximum(visible, 0), motions, centroid


def _moments(
    weight: Float[AnyArray, " n"], a: Float[AnyArray, "n k"], b: Float[AnyArray, "n k"]
) -> Float[AnyArray, "k k"]:
    # As sums: a product of matrices has few digits on some devices.
    return namespace(a).sum((weight[:, None] * a)[:, :, None] * b[:, None, :], axis=0)


def _motion(motion: Float[np.ndarray, "6"], centroid: Float[np.ndarray, "3"]) -> Motion:
    """Tell a small motion, a shift of the centroid and a turn about it, as a slide or as a turn.

    Its points are displaced by one on average (root mean square), by the shift and by the turn together.
    """
    shift, turn = motion[:3], motion[3:]
    if np.linalg.norm(shift) ** 2 > MOSTLY_SHIFT:
        return Motion("slide", shift / np.linalg.norm(shift), centroid)
    rate = np.linalg.norm(turn)
    axis = turn / rate
    return Motion("turn", axis, centroid + np.cross(axis, shift) / rate)
