"""How noise in the matches spreads to the pose: covariance and information, by the derivative of ``refit``.

The noise model of a loop closure. Small errors xi of the pose are written about the answer; which ones,
in which order and in which frame, differs between libraries and is what ``convention`` chooses.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray, Placeholder, is_traced, safe_norm, safe_sqrt
from teaser_jax.ground.checks import one_of, shown
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.pose import Pose, as_pose
from teaser_jax.problem import Problem, clean
from teaser_jax.reading import real_numbers
from teaser_jax.refit import refit, without_copies
from teaser_jax.solution import Solution, problem_and_solution
from teaser_jax.stages.refinement import squared_residuals

Convention = Literal["right", "ros", "gtsam", "g2o"]


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Uncertainty:
    """What ``covariance`` returns. Six coordinates, or seven where the scale is estimated.

    Attributes:
        covariance: Of the error of the pose; infinite on the diagonal, and zero beside it, where the
            solution is not ``ok``.
        information: Its inverse; infinite on the diagonal where some errors are exactly zero. Zero where the
            solution is not ``ok``, so that in a graph of poses it weighs nothing.
        convention: Which coordinates, as asked for.
    """

    covariance: Float[AnyArray, "... d d"] | Float[AnyArray, "d d ..."] | Placeholder
    information: Float[AnyArray, "... d d"] | Float[AnyArray, "d d ..."] | Placeholder
    convention: Convention = field(metadata={"static": True})


def covariance(
    problem: Problem | Any,
    solution: Solution | Any = None,
    sigma: Any = None,
    *,
    convention: Convention = "right",
) -> Uncertainty:
    """Compute the covariance of the pose, to first order in the noise, the chosen matches being right.

    Errors of the targets are taken as independent, with the same deviation in all directions; noise of
    the source counts as noise of the target, s times as large. The derivative of ``refit`` carries them to
    the pose, so this is about the estimator as it is: refined or not, weighted or not.

    With R, t, s the answer and R', t', s' the truth, the coordinates are:

    ===========  =========================================================================================
    convention   coordinates
    ===========  =========================================================================================
    ``"right"``  (w, v): R' = R Exp(w), t' = t + R v; rotation first, in the axes of the source frame
    ``"gtsam"``  the same: the tangent of ``gtsam.Pose3``
    ``"g2o"``    (v, w / 2): translation first, then the vector part of the quaternion (``EDGE_SE3:QUAT``)
    ``"ros"``    (R v, R w): translation, then rotation about the fixed axes of the target frame
                 (``geometry_msgs/PoseWithCovariance``)
    ===========  =========================================================================================

    Lengths are in the unit of the target and angles in radians. Where the scale is estimated a seventh
    coordinate follows, log(s' / s); the first six rows and columns are the pose's own covariance.

    Args:
        problem, solution: The answer of ``register`` alone, or a problem and what ``solve`` made of it.
        sigma: Standard deviation of the error of each coordinate of a match [length], one number or (n,).
            None: proportional to ``noise_bound``, the factor being estimated from the inliers' residuals.
        convention: Coordinates, see above.

    Returns:
        Covariance and information. Pure under jit and vmap; outside, numpy problems give numpy in float64.

    Raises:
        ValueError: For another convention, a stack, anything but a ``Solution``, or a ``sigma`` of the wrong
            shape or below 0.

    Gradients: exact, through the second derivative of the fit.
    """
    _check_convention(convention)
    problem, solution = problem_and_solution(problem, solution, "covariance")
    if problem.src.ndim != 2:
        raise ValueError(
            f"covariance takes one problem and its solution, received src of shape {problem.src.shape}: use "
            "jax.vmap for a stack."
        )
    if sigma is not None:
        sigma = _checked(sigma, problem)
    if isinstance(problem.src, np.ndarray) and not is_traced(problem, solution, sigma):
        with as_on_the_host():
            return jax.device_get(_covariance(problem, solution, sigma, convention))
    return _covariance(problem, solution, sigma, convention)


def pose_difference(
    pose: Pose | Any, truth: Pose | Any, *, convention: Convention = "right", with_scale: bool = False
) -> Float[Array, " d"]:
    """Compute the error of a pose in the coordinates of ``covariance``, the rotation's logarithm in full.

    ``error @ information @ error`` is the normalised error squared, which should follow chi^2.

    Args:
        pose, truth: The answer, and what it should be, as a ``Pose``, an answer or a matrix: one each;
            ``jax.vmap`` for more.
        convention: As for ``covariance``.
        with_scale: Append log(s' / s).

    Returns:
        In radians and the unit of the target, in the order of the convention.

    Raises:
        ValueError: For another convention, or stacks of poses.

    Gradients: exact, but where the rotations are opposite and the axis of the turn jumps.
    """
    _check_convention(convention)
    pose, truth = (jax.tree.map(jnp.asarray, as_pose(x)) for x in (pose, truth))
    if pose.rotation.shape != (3, 3) or truth.rotation.shape != (3, 3):
        raise ValueError(
            f"the rotations have shapes {pose.rotation.shape} and {truth.rotation.shape}: expected one pose "
            "each, (3, 3); use jax.vmap for stacks."
        )
    between = jnp.einsum("ji,jk->ik", pose.rotation, truth.rotation, precision=jax.lax.Precision.HIGHEST)
    quat = so3.quat_from_rotation(between)
    sine = safe_norm(quat[:3])
    half = jnp.arctan2(sine, quat[3])
    turn = 2 * quat[:3] * jnp.where(sine > 0, half / jnp.where(sine > 0, sine, 1), 1)
    shift = (truth.translation - pose.translation) @ pose.rotation
    scale = [jnp.log(truth.scale / pose.scale)[None]] if with_scale else []
    right = jnp.concatenate([turn, shift, *scale])
    return _change(pose, len(right), convention) @ right


def _check_convention(convention: Any) -> None:
    one_of("convention", convention, get_args(Convention))


def _checked(sigma: Any, problem: Problem) -> Any:
    n = problem.src.shape[:-1]
    if isinstance(sigma, str):
        raise ValueError(
            f"sigma is {shown(sigma)}: expected a standard deviation; convention=... has its name."
        )
    sigma = real_numbers(sigma, "sigma")
    if np.shape(sigma) not in ((), n):
        raise ValueError(f"sigma has shape {np.shape(sigma)}: expected one number, or one a match, {n}.")
    if not is_traced(sigma) and not np.all(np.asarray(sigma, float) >= 0):
        raise ValueError("sigma holds a number below 0, or none at all: expected standard deviations.")
    return sigma


def _covariance(problem: Problem, solution: Solution, sigma: Any, convention: Convention) -> Uncertainty:
    # The fit and its slope are one program for all conventions.
    pose = jax.tree.map(jnp.asarray, solution.pose)
    return _at_the_origin(_about_the_middle(problem, solution, sigma), pose, convention)


class _Central(NamedTuple):
    """Covariance and information in source axes, about the inliers' middle, and what they are worth."""

    covariance: Float[Array, "d d"]
    information: Float[Array, "d d"]
    known: Bool[Array, ""]
    exact: Bool[Array, ""]
    middle: Float[Array, "3"]


@jax.jit
def _about_the_middle(problem: Problem, solution: Solution, sigma: Any) -> _Central:
    p = without_copies(clean(problem)[0], solution.selection)
    solution = replace(solution, inliers=solution.inliers & p.mask)
    pose = jax.tree.map(jnp.asarray, solution.pose)
    deviation = _estimated(p, solution) if sigma is None else jnp.asarray(sigma, p.dst.dtype)
    # About the inliers' middle, where turns and shifts hardly depend on each other: about a far origin the
    # one all but determines the other, and their information could not be told from an infinite one.
    middle = lax.stop_gradient(_middle(p, solution.inliers))
    here = lax.stop_gradient(pose.apply(middle[None])[0])
    about = replace(pose, translation=jnp.zeros_like(pose.translation))
    near = replace(p, src=p.src - middle[None], dst=p.dst - here[None])
    to_first_order = lambda dst: _coordinates(refit(replace(near, dst=dst), solution.selection), about, p)
    slope = jax.jacrev(to_first_order)(near.dst)  # (d, n, 3)
    deviation = jnp.broadcast_to(deviation, p.mask.shape)
    weighted = slope * jnp.where(p.mask & jnp.isfinite(deviation), deviation, 0)[None, :, None]
    found = jnp.einsum("ani,bni->ab", weighted, weighted, precision=lax.Precision.HIGHEST)
    eye = jnp.eye(len(found), dtype=found.dtype)
    sensible = jnp.all(jnp.where(solution.inliers, jnp.isfinite(deviation) & (deviation >= 0), True))
    known = solution.ok & jnp.all(jnp.isfinite(found)) & sensible
    # Angles and lengths may be of very different size: invert in units of the deviations.
    spread = jnp.diagonal(found)
    unit = lax.rsqrt(jnp.where(known & (spread > 0), spread, 1))
    normalised = jnp.where(known, unit[:, None] * found * unit[None], eye)
    least = jnp.linalg.eigvalsh(lax.stop_gradient(normalised))[0]
    exact = least <= 8 * jnp.finfo(found.dtype).eps  # some combination of coordinates has no noise at all
    inverse = unit[:, None] * jnp.linalg.inv(jnp.where(exact, eye, normalised)) * unit[None]
    information = jnp.where(known & ~exact, inverse, 0)
    return _Central(jnp.where(known, found, 0), information, known, exact, middle)


@partial(jax.jit, static_argnames="convention")
def _at_the_origin(central: _Central, pose: Pose, convention: Convention) -> Uncertainty:
    d = len(central.covariance)
    infinite = jnp.where(jnp.eye(d, dtype=bool), jnp.inf, jnp.zeros((), central.covariance.dtype))
    to_origin = _moved_origin(central.middle * pose.scale, d)
    from_origin = _moved_origin(-central.middle * pose.scale, d)
    change = _change(pose, d, convention)
    forth = _product(change, to_origin)
    back = _product(from_origin, jnp.linalg.inv(change))
    covariance = _product(_product(forth, central.covariance), forth.T)
    information = _product(_product(back.T, central.information), back)
    return Uncertainty(
        covariance=jnp.where(central.known, covariance, infinite),
        information=jnp.where(central.known, jnp.where(central.exact, infinite, information), 0),
        convention=convention,
    )


def _middle(p: Problem, inliers: Bool[Array, " n"]) -> Float[Array, "3"]:
    weights = jnp.where(jnp.asarray(inliers), p.confidence, 0)
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(weights.dtype).tiny)
    return jnp.sum((weights / total)[:, None] * p.src, axis=0)


def _moved_origin(shift: Float[Array, "3"], d: int) -> Float[Array, "d d"]:
    """Make the matrix that takes errors of a pose at a point to those at the origin.

    The origin lies ``shift`` before the point, in the axes of the source.
    """
    found = jnp.eye(d, dtype=shift.dtype).at[3:6, :3].set(so3.hat(shift))
    return found if d == 6 else found.at[3:6, 6].set(-shift)


def _product(a: Array, b: Array) -> Array:
    return jnp.matmul(a, b, precision=lax.Precision.HIGHEST)


def _coordinates(pose: Pose, about: Pose, problem: Problem) -> Float[Array, " d"]:
    """Compute small errors of a pose about another, in source axes: turn, shift, log scale if unknown."""
    between = jnp.einsum("ji,jk->ik", about.rotation, pose.rotation, precision=jax.lax.Precision.HIGHEST)
    turn = 0.5 * so3.axial(between)
    shift = (pose.translation - about.translation) @ about.rotation
    scale = [] if problem.scale is not None else [(pose.scale / about.scale - 1)[None]]
    return jnp.concatenate([turn, shift, *scale])


def _change(pose: Pose, d: int, convention: Convention) -> Float[Array, "d d"]:
    """Make the matrix from our coordinates to those of a convention."""
    r, eye, zero = pose.rotation, jnp.eye(3, dtype=pose.rotation.dtype), jnp.zeros_like(pose.rotation)
    blocks = {
        "right": [[eye, zero], [zero, eye]],
        "gtsam": [[eye, zero], [zero, eye]],
        "g2o": [[zero, eye], [0.5 * eye, zero]],
        "ros": [[zero, r], [r, zero]],
    }
    return jnp.eye(d, dtype=r.dtype).at[:6, :6].set(jnp.block(blocks[convention]))


def _estimated(p: Problem, solution: Solution) -> Float[Array, " n"]:
    """Estimate deviations in proportion to the bounds. Of 3 m residuals the pose has taken six or seven."""
    r2 = squared_residuals(jax.tree.map(jnp.asarray, solution.pose), p.src, p.dst, p.noise_bound)
    m = jnp.sum(solution.inliers, dtype=jnp.int32).astype(p.src.dtype)
    left = 3 * m - (6 if p.scale is not None else 7)
    total = jnp.sum(jnp.where(solution.inliers, r2, 0))
    return p.noise_bound * safe_sqrt(total / jnp.maximum(left, 1))
