"""Other poses in which an overlap fits as well: what has one is ambiguous, whatever it looks like.

They come from motions of the overlap itself and from other candidates. All are asked about a few cells, the
best about more, and the very best are aligned and compared with the pose.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from teaser_jax.clouds.fine import align
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.alternatives import alternatives
from teaser_jax.clouds.trust.lead import Lead, lead
from teaser_jax.clouds.trust.observability import Observability
from teaser_jax.clouds.trust.pairing import Laid, Pairing, lay, moved, pair, shares
from teaser_jax.clouds.trust.space import Images, in_front

DIFFERENT = 2.5  # cells of displacement on average that make another pose
ASKED, SCREENED, FIRST_LOOK = 400, 200, 50  # cells asked of alternatives: the last, the better, all
LOOKED_AT_TWICE, TRIED = 60, 6  # alternatives; those that are aligned
ALIGNED_CELLS = 1500  # of those that fit, to align them elsewhere
WORTH_A_TRY = 0.3  # of the cells asked
LIKE = 0.80  # a share of the fitting cells that makes a pose as good
# Of the cells in front of what the other sensor saw, and times the share of the pose itself. An end
# wall in the middle of a room makes 0.07; right poses of 97 real pairs have 0.06 at most, nearly all 0.02.
RIVAL_IN_FRONT, TIMES_OWN = 0.065, 3


class Rivals(NamedTuple):
    """What other poses explain.

    Attributes:
        equal: Which part of the fitting cells fits in the other pose that is most like it [-].
        fit: The fit of that pose [-].
        lead: How far the pose is ahead of all of them, at the least.
        poses: Those in which nearly all of its cells fit.
    """

    equal: float
    fit: float
    lead: Lead
    poses: tuple[Float[np.ndarray, "4 4"], ...]


class Guess(NamedTuple):
    """What is known of a pose beforehand.

    Attributes:
        pose: Between the middles of the clouds.
        error: How far points of the overlap may be off [length].
    """

    pose: Float[np.ndarray, "4 4"]
    error: float


NONE = Rivals(0.0, 0.0, Lead(1.0, 0.0), ())


def find_rivals(
    laid: Laid,
    seen: Observability,
    others: Sequence[Float[np.ndarray, "4 4"]] = (),
    *,
    images: Images = (None, None),
    guess: Guess | None = None,
) -> Rivals:
    """Look for other poses in which the fitting cells fit as well.

    Args:
        laid: The surfaces in the pose.
        seen: Which motions the normals see there.
        others: Further candidates.
        images: What the sensors saw: a pose that has much in front of that is no rival.
        guess: What was known beforehand: a pose that contradicts it is no rival.
    """
    pose, src, dst, here = laid.pose, laid.src, laid.dst, laid.here
    chosen = np.flatnonzero(here.fits & (here.weight > 0))
    if len(chosen) < 20:
        return NONE
    points, cell = here.points[chosen], dst.voxel_size
    weight = here.weight[chosen] / here.weight[chosen].sum()
    asked = chosen[np.random.default_rng(0).choice(len(chosen), ASKED, p=weight)]
    motions = alternatives(points, here.normals[chosen], seen, cell)
    poses = np.concatenate([motions @ pose, np.reshape(others, (-1, 4, 4))])
    some = src.points[chosen[:: max(1, len(chosen) // 500)]]
    apart = lambda one, other: np.linalg.norm(moved(one, some) - moved(other, some), axis=1).mean()
    poses = poses[[apart(pose, other) >= DIFFERENT * cell for other in poses]]
    if guess is not None:
        poses = poses[[apart(guess.pose, other) <= guess.error for other in poses]]
    if len(poses) == 0:
        return NONE
    every = chosen[:: max(1, len(chosen) // ALIGNED_CELLS)]
    fitting = Surface(src.points[every], cell, threads=src.threads)  # what another pose has to explain
    quick = _screened(poses, src, dst, asked)
    found = Rivals(min(float(quick.max()), WORTH_A_TRY), 0.0, NONE.lead, ())
    for other in possible(poses, quick, laid, images):
        aligned = align(align(other, fitting, dst, reach=4.0), fitting, dst)
        if apart(pose, aligned) >= DIFFERENT * cell:  # else it fell back: judge it where it stood
            other = aligned
        share = _share(pair(other, src, dst, asked), ASKED // 2)
        found = found._replace(lead=found.lead.at_worst(lead(laid, other)))
        if share > LIKE and all(apart(x, other) >= DIFFERENT * cell for x in found.poses):
            found = found._replace(poses=(*found.poses, other))
        if share > found.equal or found.fit == 0:
            found = found._replace(equal=share, fit=lay(other, src, dst).fit)
    return found


def possible(
    poses: Float[np.ndarray, "k 4 4"], share: Float[np.ndarray, " k"], laid: Laid, images: Images
) -> Iterator[Float[np.ndarray, "4 4"]]:
    """List the poses that are worth a try, the best first, without those that free space rules out."""
    own = np.nan_to_num(in_front(laid.pose, laid.src, laid.dst, images))
    limit = max(RIVAL_IN_FRONT, TIMES_OWN * own)
    tried = 0
    for k in np.argsort(-share, kind="stable"):
        if tried == TRIED or share[k] <= WORTH_A_TRY:
            return
        if not in_front(poses[k], laid.src, laid.dst, images) > limit:  # NaN: nothing is known
            tried += 1
            yield poses[k]


def _screened(
    poses: Float[np.ndarray, "k 4 4"], src: Surface, dst: Surface, asked: Int[np.ndarray, " m"]
) -> Float[np.ndarray, " k"]:
    """Tell which part of some cells fits under each pose: of few cells, and of more where these fit best."""
    quick = shares(poses, src, dst, asked[:FIRST_LOOK])
    best = np.argsort(-quick, kind="stable")[:LOOKED_AT_TWICE]
    again = np.zeros_like(quick)
    again[best] = shares(poses[best], src, dst, asked[:SCREENED])
    return again


def _share(pairing: Pairing, least: int) -> float:
    """Tell which part of the cells that were asked, and lie in the overlap, fits [-]."""
    overlap = max(int(np.count_nonzero(pairing.near)), least)
    return int(np.count_nonzero(pairing.fits)) / overlap
