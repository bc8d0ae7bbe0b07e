"""Frames and precision: clouds about their middles, edges in float32 where that will do, and the way back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax import so3
from teaser_jax.engine.packing import PackedProblem
from teaser_jax.ground.bits import words
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem
from teaser_jax.rows import Rows
from teaser_jax.solution import Solution
from teaser_jax.stages.consistency import margin_of


def middle(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    """Find the median of each coordinate, the upper one of two, in a third of the time of ``numpy.median``.

    A median, because one absurd coordinate must not move the origin far from the rest.
    """
    half = len(points) // 2
    return np.partition(np.ascontiguousarray(points.T), half, axis=1)[:, half]


def float32_will_do(src_extent: Any, dst_extent: Any, scale: Any, least_bound: Any, cbar2: Any) -> Any:
    """Tell whether float32 widens no edge test by more than a thousandth of the bound: it is twice as fast.

    No edge is lost in either precision; a few more may be added.

    Args:
        src_extent, dst_extent: The largest coordinates [length]; numbers, or arrays with one a problem.
        scale: The known scale [-].
        least_bound: The smallest noise bound [length].
        cbar2: Truncation [-].
    """
    reach, bound = np.sqrt(3) * (scale * src_extent + dst_extent), np.sqrt(cbar2) * least_bound
    in_range = (bound > 1e-6) & (reach < 1e6)  # their fourth powers are compared
    return in_range & (margin_of(np.float32, reach) <= 1e-3 * bound)


class Centred(NamedTuple):
    """Packed problems in the frames in which they will be solved; one has arrays without an axis in front."""

    sent: PackedProblem
    origins: (
        tuple[Float[np.ndarray, "*b 3"], Float[np.ndarray, "*b 3"]] | None
    )  # None: nothing was taken away
    narrow: Bool[np.ndarray, "*b"]  # whose edges float32 can test

    @property
    def edge_dtype(self) -> type:
        """The type in which the edges of one problem are tested."""
        return np.float32 if self.narrow else np.float64


def centred(sent: PackedProblem) -> Centred:
    """Move the points of a stack to their middle where float32 could not tell consistent matches otherwise.

    Most stacks of a study need nothing, and finding the middle takes a quarter of the time of solving
    a small problem.
    """
    narrow = _narrow(sent)
    if narrow.all():
        return Centred(sent, None, narrow)
    sent = replace(sent, columns=sent.columns.copy(), numbers=sent.numbers.copy())
    origins = np.zeros((len(narrow), 3)), np.zeros((len(narrow), 3))
    for k in np.flatnonzero(~narrow):
        usable = sent.usable[k]
        for origin, cloud in zip(origins, sent.clouds, strict=True):
            if usable.any():
                origin[k] = middle(cloud[k][:, usable].T)
                cloud[k] -= origin[k][:, None]
    with np.errstate(over="ignore"):  # of points at the end of all numbers
        sent.offset[...] = origins[0] - origins[1]
    return Centred(sent, origins, _narrow(sent))


def centred_one(sent: PackedProblem) -> Centred:
    """Move the points of one packed problem, by the same rule."""
    stack = centred(replace(sent, columns=sent.columns[None], numbers=sent.numbers[None]))
    origins = None if stack.origins is None else (stack.origins[0][0], stack.origins[1][0])
    one = replace(sent, columns=stack.sent.columns[0], numbers=stack.sent.numbers[0])
    return Centred(one, origins, stack.narrow[0])


def _narrow(sent: PackedProblem) -> Bool[np.ndarray, " b"]:
    """Tell which problems of a stack may have their edges tested in float32 where they lie."""
    if not sent.scale_is_known:  # a voted scale keeps all digits
        return np.zeros(len(sent.numbers), bool)
    with np.errstate(invalid="ignore", over="ignore"):  # numbers that make no sense: a status will say so
        # Rows that the mask hides can but widen the extent: most problems pass with them.
        narrow = _narrow_among(sent, sent.mask)
        rest = np.flatnonzero(~narrow)
        if len(rest):
            wide = replace(sent, columns=sent.columns[rest], numbers=sent.numbers[rest])
            usable = wide.usable
            seen = replace(wide, columns=np.where(usable[:, None], wide.columns, 0))
            narrow[rest] = _narrow_among(seen, usable)
    return narrow


def _narrow_among(sent: PackedProblem, usable: Bool[np.ndarray, "b n"]) -> Bool[np.ndarray, " b"]:
    """Tell which problems float32 can test, by the extents of all rows and the bounds of the usable ones."""
    b, rows, n = sent.columns.shape
    clouds = sent.columns.reshape(b, rows * n)[:, : 6 * n].reshape(
        b, 2, 3 * n
    )  # a view: no copy of the points
    extents = np.maximum(clouds.max(axis=2), -clouds.min(axis=2))
    least = np.where(usable, sent.noise_bound, np.inf).min(axis=1, initial=np.inf)
    return np.asarray(float32_will_do(extents[:, 0], extents[:, 1], sent.scale, least, sent.cbar2))


def with_origins(
    solution: Solution, origins: tuple[Float[np.ndarray, "*b 3"], Float[np.ndarray, "*b 3"]] | None
) -> Solution:
    """Carry the solution of centred clouds (or a stack of them) back to the frames that these came from."""
    if origins is None:
        return solution
    (src_origin, dst_origin), pose = origins, solution.pose
    turned = so3.rotate(pose.rotation, src_origin[..., None, :])[..., 0, :]
    with np.errstate(over="ignore", invalid="ignore"):  # of points at the end of all numbers
        translation = dst_origin + pose.translation - pose.scale[..., None] * turned
    translation = np.where(np.isfinite(translation), translation, 0)
    return replace(solution, pose=Pose(pose.rotation, translation, np.asarray(pose.scale)))


def without_padding(solution: Solution, problem: Problem) -> Solution:
    """Cut the padding, which came last, off a solution, or a stack of them: the rows of its problem stay."""
    n = problem.src.shape[-2]
    m = n if problem.pairs is None else problem.pairs.shape[-2]
    chosen = solution.selection

    def of_pairs(pair_set: Any) -> Any:
        if pair_set is None:
            return None
        if pair_set.dtype == np.uint32:  # the words of the first n stay as they are
            return pair_set[..., :n, : words(n)]
        return pair_set[..., :m]

    selection = replace(
        chosen,
        scale_pairs=of_pairs(chosen.scale_pairs),
        clique=chosen.clique[..., :n],
        rotation=of_pairs(chosen.rotation),
        translation=chosen.translation[..., :n, :],
        inliers=chosen.inliers[..., :n],
        rows=None if chosen.rows is None else Rows(chosen.rows.order[..., :n], chosen.rows.place[..., :n]),
    )
    return replace(solution, selection=selection, inliers=selection.inliers)
