"""Problems and solutions in few arrays, for the way to the device and back.

Whatever its size, each array that is sent or fetched takes as long as several stages of a small problem.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.so3 import AnyArray
from teaser_jax.types import Pose, Problem, Selection, Settings, Solution


class PackedProblem(NamedTuple):
    """A problem, and the numbers of its settings, in two arrays, or three."""

    columns: Float[AnyArray, "9 n"]  # src, dst, noise_bound, confidence, mask: each in one piece
    numbers: Float[AnyArray, " c"]  # cbar2, gnc_factor, gnc_tolerance, scale_range, and the scale if known
    pairs: Int[AnyArray, "m 2"] | None

    @property
    def mask(self) -> Bool[AnyArray, "*b n"]:
        """Rows to use."""
        return self.columns[..., 8, :] > 0


def pack_problem(problem: Problem, settings: Settings, n: int, m: int | None) -> PackedProblem:
    """A problem on the host, or a stack of them, padded to n rows and m pairs; padding is masked."""
    *front, count, _ = problem.src.shape
    columns = np.zeros((*front, 9, n))
    columns[..., :3, :count] = np.swapaxes(problem.src, -1, -2)
    columns[..., 3:6, :count] = np.swapaxes(problem.dst, -1, -2)
    columns[..., 6, :count], columns[..., 7, :count] = problem.noise_bound, problem.confidence
    columns[..., 8, :count] = problem.mask
    known = () if problem.scale is None else (problem.scale,)
    each = (problem.cbar2, settings.gnc_factor, settings.gnc_tolerance, *settings.scale_range, *known)
    numbers = np.empty((*front, len(each)))
    for k, number in enumerate(each):
        numbers[..., k] = number
    pairs = None
    if problem.pairs is not None and m is not None:
        pairs = np.zeros((*front, m, 2), np.int32)
        pairs[..., : problem.pairs.shape[-2], :] = problem.pairs
    return PackedProblem(columns, numbers, pairs)


def unpack_problem(packed: PackedProblem, choices: Settings) -> tuple[Problem, Settings]:
    """The problem and its settings again, on the device; ``choices`` are the settings without numbers."""
    columns, numbers = packed.columns, packed.numbers
    problem = Problem(
        src=columns[:3].T,
        dst=columns[3:6].T,
        noise_bound=columns[6],
        cbar2=numbers[0],
        mask=packed.mask,
        confidence=columns[7],
        scale=numbers[5] if len(numbers) == 6 else None,
        pairs=packed.pairs,
    )
    settings = replace(
        choices, gnc_factor=numbers[1], gnc_tolerance=numbers[2], scale_range=(numbers[3], numbers[4])
    )
    return problem, settings


def choices_of(settings: Settings) -> Settings:
    """What a device program is compiled for: no numbers, which it is sent, and no budgets of the host.

    So neither new numbers nor new budgets compile anything.
    """
    numbers: dict[str, Any] = dict(gnc_factor=None, gnc_tolerance=None, scale_range=(None, None))
    return replace(settings, **numbers, clique_nodes=1, clique_seconds=0.0)


class PackedSolution(NamedTuple):
    """A solution in two arrays, or up to four."""

    numbers: AnyArray  # rotation, translation, scale, cost, and the counts and flags, all exact in float64
    masks: AnyArray  # (n, 5) or (n, 6): clique, inliers, axes of the translation, TIMs of the chain
    pair_sets: tuple[AnyArray | None, AnyArray | None]  # of the scale; of the rotation, where not in masks


def pack_solution(solution: Solution) -> PackedSolution:
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
    return PackedSolution(
        jnp.concatenate(numbers), jnp.concatenate(masks, axis=1), (chosen.scale_pairs, rotation)
    )


def fetched(solution: PackedSolution) -> PackedSolution:
    """The arrays on the host: a tenth of the time of ``jax.device_get`` where that is the device."""
    return jax.tree.map(np.asarray, solution)


def unpack_solution(host: PackedSolution) -> Solution:
    """The solution again, or a stack of them, in numpy."""
    numbers, masks, (scale_pairs, rotation) = host
    front = numbers.shape[:-1]
    pose = Pose(numbers[..., :9].reshape(*front, 3, 3), numbers[..., 9:12], numbers[..., 12])
    counts = np.moveaxis(numbers[..., 14:].astype(np.int32), -1, 0)
    columns = np.ascontiguousarray(np.moveaxis(masks, -1, 0))
    selection = Selection(
        scale_pairs=scale_pairs,
        clique=columns[0],
        rotation=columns[5] if rotation is None else rotation,
        translation=masks[..., 2:5],
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
        cost=numbers[..., 13],
    )
