"""A solution in few arrays, for the way from the device to the host.

To fetch an array costs as much as to solve a small problem, whatever its size.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from teaser_jax.so3 import AnyArray
from teaser_jax.types import Pose, Selection, Solution


class Packed(NamedTuple):
    """A solution in two arrays, or up to four."""

    numbers: AnyArray  # rotation, translation, scale, cost, and the counts and flags, all exact in float64
    masks: AnyArray  # (n, 5) or (n, 6): clique, inliers, axes of the translation, TIMs of the chain
    pair_sets: tuple[AnyArray | None, AnyArray | None]  # of the scale; of the rotation, where not in masks


def packed(solution: Solution) -> Packed:
    """The arrays of a solution, fewer and longer."""
    pose, chosen = solution.pose, solution.selection
    counts = [
        solution.status, solution.clique_size, solution.clique_upper_bound,
        solution.clique_is_maximum, solution.excluded, chosen.refined,
    ]  # fmt: skip
    numbers = [pose.rotation.reshape(-1), pose.translation, pose.scale[None], solution.cost[None]]
    numbers += [jnp.stack([x.astype(pose.scale.dtype) for x in counts])]
    masks = [chosen.clique[:, None], chosen.inliers[:, None], chosen.translation]
    chain = chosen.rotation.shape == chosen.clique.shape and chosen.rotation.dtype == bool
    masks += [chosen.rotation[:, None]] if chain else []
    rotation = None if chain else chosen.rotation
    return Packed(jnp.concatenate(numbers), jnp.concatenate(masks, axis=1), (chosen.scale_pairs, rotation))


def fetched(solution: Packed) -> Packed:
    """The arrays on the host: a tenth of the time of ``jax.device_get`` where that is the device."""
    return jax.tree.map(np.asarray, solution)


def unpacked(host: Packed) -> Solution:
    """The solution again, in numpy."""
    numbers, masks, (scale_pairs, rotation) = host
    pose = Pose(numbers[:9].reshape(3, 3), numbers[9:12], numbers[12])
    counts = numbers[14:].astype(np.int32)
    columns = np.ascontiguousarray(masks.T)
    selection = Selection(
        scale_pairs=scale_pairs,
        clique=columns[0],
        rotation=columns[5] if rotation is None else rotation,
        translation=masks[:, 2:5],
        inliers=columns[1],
        refined=counts[5].astype(bool),
    )
    return Solution(
        pose=pose,
        selection=selection,
        inliers=selection.inliers,
        status=counts[0],
        clique_size=counts[1],
        clique_upper_bound=counts[2],
        clique_is_maximum=counts[3].astype(bool),
        excluded=counts[4],
        cost=numbers[13],
    )
