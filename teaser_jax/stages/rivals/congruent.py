"""Other poses of two sets of points, by triples of one that have congruent triples in the other.

A clique knows lengths alone, and of a thing that has mirror planes half of the largest cliques are mirrored.
Three points tell left from right. If another pose explains most of what an answer explains, it explains most
triples of it: some are drawn, and every congruent triple is tried. On the host, in numpy.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from teaser_jax.pose import Pose

# Triples that are drawn, each the widest of a few. Of poses that explain four fifths of the answer half of
# the triples tell, so 24 of them overlook one in 10^7.
TRIPLES, WIDEST_OF = 24, 8
MOST_OF_A_TRIPLE = 1024  # congruent triples that are tried; more there are where lengths tell little
ASKED, LEAST_SCREENED = 24, 0.5  # pairs that a pose is asked for, and the share of them that it must explain
FITTED, ROUNDS = 48, 5  # poses that are fitted to all points, and how often
WIDE = 2.0  # bounds, within which a pose of three points explains others, and with which a fit begins
# Two poses are one if the points of so large a share lie within so many bounds of each other.
NEAR, SAME = 3.0, 0.9


class OtherPose(NamedTuple):
    """Another pose.

    Attributes:
        pose: From the source to the target.
        explained: Points with a partner within the bound, of the cloud that has fewer.
    """

    pose: Pose
    explained: int


def other_poses(
    src: Float[np.ndarray, "n 3"],
    dst: Float[np.ndarray, "m 3"],
    pairs: Int[np.ndarray, "k 2"],
    *,
    noise_bound: float,
) -> list[OtherPose]:
    """Find poses of two sets of points that differ from an answer and from one another, best first.

    Args:
        src, dst: All points, of one scale, about the origin [length].
        pairs: Which points the answer joins; it need not be a pose: pairs may be mirrored.
        noise_bound: Largest error of a right pair [length].

    References: Aiger, Mitra, Cohen-Or, SIGGRAPH 2008, for congruent sets.
    """
    if len(pairs) < 3:
        return []
    rng = np.random.default_rng(0)
    here, there = src[pairs[:, 0]], dst[pairs[:, 1]]
    forth = _congruent(here, dst, 2 * noise_bound, rng)
    back = _congruent(there, src, 2 * noise_bound, rng)
    poses = _fit(*(np.concatenate(x) for x in zip(forth, back[::-1], strict=True)))
    chosen = _screened(*poses, src, dst, rng.permutation(pairs)[:ASKED], noise_bound)
    found = [_fitted(poses[0][k], poses[1][k], src, dst, noise_bound) for k in chosen]
    return _distinct(sorted(found, key=lambda x: -x.explained), here, there, noise_bound)


def is_same(
    one: Float[np.ndarray, "*c k 3"], other: Float[np.ndarray, "k 3"], bound: float
) -> Bool[np.ndarray, "*c"] | np.bool_:
    """Tell whether two poses are one, by where they bring the same points."""
    return (np.linalg.norm(one - other, axis=-1) <= NEAR * bound).mean(axis=-1) >= SAME


def _congruent(
    points: Float[np.ndarray, "k 3"], others: Float[np.ndarray, "m 3"], tolerance: float,
    rng: np.random.Generator,
) -> tuple[Float[np.ndarray, "c 3 3"], Float[np.ndarray, "c 3 3"]]:  # fmt: skip
    """Draw triples of points, and find for each the congruent ones among others."""
    length = np.linalg.norm(others[:, None] - others[None], axis=2)
    here, there = [], []
    for _ in range(TRIPLES):
        drawn = [points[rng.choice(len(points), 3, replace=False)] for _ in range(WIDEST_OF)]
        base = max(drawn, key=_area)
        one, two, three = np.linalg.norm(base - np.roll(base, -1, axis=0), axis=1)
        i, j = np.nonzero(np.abs(length - one) <= tolerance)
        fits = (np.abs(length[j] - two) <= tolerance) & (np.abs(length[i] - three) <= tolerance)
        pair, k = np.nonzero(fits)
        if len(k) > MOST_OF_A_TRIPLE:
            few = np.sort(rng.choice(len(k), MOST_OF_A_TRIPLE, replace=False))
            pair, k = pair[few], k[few]
        there.append(others[np.stack([i[pair], j[pair], k], axis=1)])
        here.append(np.broadcast_to(base, (len(k), 3, 3)))
    return np.concatenate(here), np.concatenate(there)


def _area(triangle: Float[np.ndarray, "3 3"]) -> float:
    """Measure a triangle, twice [length squared]."""
    return float(np.linalg.norm(np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])))


def _fit(
    a: Float[np.ndarray, "*c k 3"], b: Float[np.ndarray, "*c k 3"]
) -> tuple[Float[np.ndarray, "*c 3 3"], Float[np.ndarray, "*c 3"]]:
    """Fit poses to matched points."""
    a_mean, b_mean = a.mean(axis=-2, keepdims=True), b.mean(axis=-2, keepdims=True)
    left, _, right = np.linalg.svd(np.swapaxes(b - b_mean, -1, -2) @ (a - a_mean))
    left[..., 2] *= np.linalg.det(left @ right)[..., None]  # no reflection
    rotation = left @ right
    return rotation, (b_mean - a_mean @ np.swapaxes(rotation, -1, -2))[..., 0, :]


def _screened(
    rotation: Float[np.ndarray, "c 3 3"], translation: Float[np.ndarray, "c 3"],
    src: Float[np.ndarray, "n 3"], dst: Float[np.ndarray, "m 3"], pairs: Int[np.ndarray, "k 2"],
    bound: float,
) -> Int[np.ndarray, " f"]:  # fmt: skip
    """Choose the poses that bring most points of some pairs near others, and few of them to their partners.

    The points of one cloud count: where it holds a thing twice, the other pose is about other points of it.
    """
    here, there = src[pairs[:, 0]], dst[pairs[:, 1]]
    moved = here @ np.swapaxes(rotation, 1, 2) + translation[:, None]
    back = (there - translation[:, None]) @ rotation
    near = [
        cKDTree(cloud).query(points, distance_upper_bound=WIDE * bound)[0] < np.inf
        for cloud, points in ((dst, moved), (src, back))
    ]
    share = np.maximum(*(x.mean(axis=1) for x in near))
    share = np.where(is_same(moved, there, bound), 0, share)
    best = np.argsort(-share, kind="stable")[:FITTED]
    return best[share[best] >= LEAST_SCREENED]


def _fitted(
    rotation: Float[np.ndarray, "3 3"], translation: Float[np.ndarray, "3"],
    src: Float[np.ndarray, "n 3"], dst: Float[np.ndarray, "m 3"], bound: float,
) -> OtherPose:  # fmt: skip
    """Fit a pose to the points that it brings together, within a radius that grows narrow."""
    targets = cKDTree(dst)
    for radius in (*np.linspace(WIDE, 1, ROUNDS), 1):
        distance, partner = targets.query(src @ rotation.T + translation)
        near = np.flatnonzero(distance <= radius * bound)
        explained = len(np.unique(partner[near]))
        if explained < 3:
            break
        rotation, translation = _fit(src[near], dst[partner[near]])
    return OtherPose(Pose(rotation, translation, np.float64(1)), explained)


def _distinct(
    found: list[OtherPose], src: Float[np.ndarray, "k 3"], dst: Float[np.ndarray, "k 3"], bound: float
) -> list[OtherPose]:
    """Leave the first of poses that are one, and none that is the answer, given the pairs of this."""
    kept, places = [], [dst]
    for other in found:
        moved = other.pose.apply(src)
        if not any(is_same(moved, x, bound) for x in places):
            kept.append(other)
            places.append(moved)
    return kept
