"""The smooth half of the method: from chosen sets to a pose, in closed form, so that gradients are exact."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray, is_traced
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.ground.forks import check_fork
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, clean
from teaser_jax.rows import in_rows
from teaser_jax.solution import Selection
from teaser_jax.stages.pairs import ring_pairs, tim_bounds, tims
from teaser_jax.stages.refinement import Fit, fit_similarity
from teaser_jax.stages.rotation.tims import Chosen, correlation, correlation_of_pairs
from teaser_jax.stages.scale import scale_of_pairs
from teaser_jax.stages.translation import translation_of_points


def refit(problem: Problem, selection: Selection) -> Pose:
    """Compute the pose from the chosen sets, in closed form: the smooth half of ``solve``.

    Refined selections give the weighted similarity fit over ``inliers``; others give (11) - (13)
    on the frozen sets with binary weights. Weights are confidence_i / beta_i^2.

    Args:
        problem: One problem; ``jax.vmap`` takes stacks.
        selection: Of that problem, as in ``solution.selection``: sets in the order of its rows.

    Returns:
        The pose from the source to the target frame; in numpy where the problem is.

    Raises:
        ValueError: If they do not belong together.

    Gradients: exact in points, bounds, known scale and confidences; memory O(n) (complete TIM
    graphs and voted scales: one slice of the pairs at a time). Zero where the rotation is ambiguous.
    """
    check_problem(problem)
    if not isinstance(selection, Selection):
        raise ValueError(
            f"refit takes a Selection, received {type(selection).__name__}: give solution.selection."
        )
    if jnp.shape(selection.inliers) != problem.src.shape[:1]:
        raise ValueError(
            f"src has shape {problem.src.shape} and the selection {jnp.shape(selection.inliers)} rows: "
            "expected the selection of the same problem."
        )
    if problem.scale is None and selection.scale_pairs is None:
        raise ValueError(
            "the selection was made with a known scale, and the problem has none: give its scale."
        )
    if isinstance(problem.src, np.ndarray) and not is_traced(problem, selection):
        with as_on_the_host():  # a problem in float64 is not rounded, whatever JAX is set to
            return jax.device_get(_compiled(problem, selection))
    return _refit(problem, selection)


def _refit(problem: Problem, selection: Selection) -> Pose:
    """Compute the pose; problem and selection belong together."""
    p, chosen = as_solved(clean(problem)[0], jax.tree.map(jnp.asarray, selection))
    return lax.cond(chosen.refined, lambda: joint_fit(p, chosen).pose, lambda: cascade_pose(p, chosen))


_compiled = jax.jit(_refit)


def as_solved(p: Problem, selection: Selection) -> tuple[Problem, Selection]:
    """Put a clean problem and its sets into the rows in which they were found, with the widened bounds."""
    p = widened(p, selection.widening)
    rows = selection.rows
    if rows is None:
        return p, selection
    of_rows = selection.rotation.dtype == bool and p.pairs is None
    p = in_rows(p, rows)
    found = replace(
        selection,
        clique=selection.clique[rows.order] & p.mask,
        rotation=selection.rotation[rows.order] if of_rows else selection.rotation,
        translation=selection.translation[rows.order] & p.mask[:, None],
        inliers=selection.inliers[rows.order] & p.mask,
        rows=None,
    )
    return p, found


def as_judged(problem: Problem, selection: Selection) -> Problem:
    """Mask the copies of a problem and widen its bounds, in the user's rows; traced or in numpy."""
    return widened(without_copies(problem, selection), selection.widening)


def without_copies(problem: Problem, selection: Selection) -> Problem:
    """Mask the rows that another one stands for: a copy says nothing new."""
    if selection.rows is None:
        return problem
    return replace(problem, mask=problem.mask & selection.rows.alone)


def widened(problem: Problem, widening: Float[AnyArray, ""]) -> Problem:
    """Widen the bounds of a problem by what the fit itself is uncertain of."""
    return replace(problem, noise_bound=problem.noise_bound * widening)


def check_problem(problem: Any) -> None:
    """Check that ``problem`` is one problem. Raises ValueError, and RuntimeError where nothing can be run."""
    check_fork()
    if not isinstance(problem, Problem):
        raise ValueError(
            f"received {type(problem).__name__} for a problem: make one with make_problem(src, dst, "
            "noise_bound=...)."
        )
    if problem.src.ndim != 2:
        raise ValueError(
            f"src has shape {problem.src.shape}: expected one problem; use jax.vmap(solve) for a stack."
        )


def joint_fit(p: Problem, selection: Selection) -> Fit:
    """Compute the weighted similarity fit to the inliers: the pose of a refined selection.

    The problem is clean.
    """
    weights = jnp.where(selection.inliers, p.confidence / p.noise_bound**2, 0)
    fit = fit_similarity(p.src, p.dst, weights, p.scale)
    return fit._replace(pose=_constant_if_ambiguous(fit.pose, fit.correlation))


def cascade_pose(p: Problem, selection: Selection) -> Pose:
    """Compute the paper's plain cascade on chosen sets of a clean problem: scale, rotation, translation."""
    if p.scale is not None:
        scale = p.scale
    else:
        assert selection.scale_pairs is not None
        scale = positive_scale(
            scale_of_pairs(p.src, p.dst, p.noise_bound, p.confidence, selection.scale_pairs, pairs=p.pairs)
        )
    h = _correlation_of(p, selection.clique, selection.rotation)
    rotation = so3.nearest_rotation(h)
    offsets = p.dst - scale * so3.rotate(rotation, p.src)
    translation = translation_of_points(offsets, p.noise_bound, p.confidence, selection.translation)
    return _constant_if_ambiguous(Pose(rotation, translation, scale), h)


def positive_scale(scale: Float[Array, ""]) -> Float[Array, ""]:
    """Return the scale, or 1 where nothing could vote: what follows must stay finite."""
    return jnp.where(scale > 0, scale, 1)


def chosen_pairs(p: Problem, members: Bool[Array, " n"]) -> Int[Array, "k 2"]:
    """List the pairs whose TIMs the rotation rests on: those given, or the ring of the members."""
    return ring_pairs(members) if p.pairs is None else p.pairs


def _constant_if_ambiguous(pose: Pose, correlation: Float[Array, "3 3"]) -> Pose:
    """Stop the derivative of a pose whose rotation could as well be another: there it means nothing."""
    ambiguous = so3.is_ambiguous(correlation, pose.rotation)
    return jax.tree.map(lambda x: jnp.where(ambiguous, lax.stop_gradient(x), x), pose)


def _correlation_of(p: Problem, members: Bool[Array, " n"], chosen: Chosen) -> Float[Array, "3 3"]:
    """Compute the correlation that decides the rotation (12) of the chosen TIMs, whatever the scale."""
    if chosen.dtype == jnp.uint32:
        return correlation_of_pairs(p.src, p.dst, p.noise_bound, p.confidence, chosen)
    pairs = chosen_pairs(p, members)
    weight = p.confidence[pairs[:, 0]] * p.confidence[pairs[:, 1]]
    weight = jnp.where(chosen, weight / tim_bounds(p.noise_bound, pairs) ** 2, 0)
    return correlation(weight, tims(p.src, pairs), tims(p.dst, pairs))
