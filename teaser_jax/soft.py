"""A smooth relative of ``solve``: the pose where the softened cost is stationary, with its derivative.

``solve`` chooses matches for good or for bad, so a match near the threshold has no gradient that would
tell which way to move it. Here matches count by degrees, under a control mu that stays where it is put;
as mu grows the answer becomes that of ``solve``.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray, Placeholder, is_traced
from teaser_jax.ground.checks import whole_number
from teaser_jax.ground.loops import until_settled
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, check_precision, clean
from teaser_jax.reading import positive_number
from teaser_jax.refit import as_judged, check_problem
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solution import Solution, Status
from teaser_jax.solve import solve
from teaser_jax.stages.refinement import fit_similarity, squared_residuals
from teaser_jax.stages.rotation.gnc import gnc_cost, gnc_weights


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class SoftSolution:
    """The answer of ``soft_solve``.

    Attributes:
        pose: Where the softened cost is stationary, from the source to the target frame.
        weights: How far each match counts there, from 0 to 1; ``confidence`` apart.
        status: That of ``solution``, if it failed; NOT_CONVERGED if the iteration had not settled, and
            DEGENERATE if the cost does not determine the pose, whose gradient is zero then.
        cost: The softened cost [-].
        solution: What ``solve`` gave: the start.
    """

    pose: Pose
    weights: Float[AnyArray, "... n"] | Placeholder
    status: Int[AnyArray, "..."] | Placeholder
    cost: Float[AnyArray, "..."] | Placeholder
    solution: Solution

    @property
    def ok(self) -> Bool[AnyArray, "..."]:
        """Whether the pose can be trusted."""
        return self.status == Status.OK


LARGEST_CHANGE = 1e-2  # of a weight, however coarse the coordinates, that counts as none


class _Data(NamedTuple):
    """All numbers that the softened cost depends on; unusable rows have no confidence."""

    src: Float[Array, "n 3"]
    dst: Float[Array, "n 3"]
    noise_bound: Float[Array, " n"]
    confidence: Float[Array, " n"]
    cbar2: Float[Array, ""]
    gnc_mu: Float[Array, ""]
    scale: Float[Array, ""] | None


def soft_solve(
    problem: Problem,
    settings: Settings = Settings(),
    *,
    gnc_mu: Float[Array, ""] | float = 1.0,
    iterations: int = 200,
) -> SoftSolution:
    """Find the stationary point of the GNC-TLS cost at a fixed control, next to the answer of ``solve``.

    Minimises sum_i confidence_i rho_mu(|b_i - s R a_i - t|^2 / beta_i^2) over all matches, exact copies
    counted once, and all unknowns, with the widened bounds of that answer; by reweighted similarity fits,
    none of which can raise the cost. Works under jit, vmap and grad; follows the dtype of the problem.

    Args:
        problem: From ``make_problem``.
        settings: Of ``solve``, which gives the start.
        gnc_mu: Control, above 0. A match counts in part from sqrt(mu / (mu+1)) to sqrt((mu+1) / mu) bounds:
            at 1, from 0.7 to 1.4.
        iterations: Cap on the fits.

    Returns:
        The pose, the weights, and whether to trust them. Finite always. NOT_CONVERGED means more
            ``iterations``, or inside jit a ``gnc_mu`` that is not above 0.

    Raises:
        ValueError: Outside jit for a ``gnc_mu`` that is not a finite number above 0; for a stack.

    Gradients: by the implicit function theorem, forward and reverse, in points, bounds, confidences,
    known scale, cbar2 and gnc_mu, of the pose and of the weights; second derivatives, too. Memory does not
    depend on the number of iterations. The derivative jumps where a residual crosses one of the two
    thresholds; it is zero where the cost does not determine the pose. Where the status is NOT_CONVERGED it
    is that of the last fit, and inexact.

    References: Yang, Antonante, Tzoumas, Carlone, RA-L 2020 (GNC-TLS); eq. (6).
    """
    check_problem(problem)
    check_precision(problem)
    check_settings(settings)
    if not is_traced(gnc_mu):
        gnc_mu = positive_number(gnc_mu, "gnc_mu")
    elif np.shape(gnc_mu) != ():
        raise ValueError(f"gnc_mu has shape {np.shape(gnc_mu)}: expected one number.")
    whole_number("iterations", iterations, 1)
    start = solve(lax.stop_gradient(problem), lax.stop_gradient(settings))
    usable, _ = clean(problem)
    p = as_judged(usable, start.selection)
    confidence = jnp.where(p.mask, p.confidence, 0)
    dtype = p.src.dtype
    mu = jnp.asarray(gnc_mu, dtype)
    sensible = jnp.isfinite(mu) & (mu > 0)
    data = _Data(
        p.src, p.dst, p.noise_bound, confidence, p.cbar2, jnp.where(sensible, mu, 1), p.scale
    )  # fmt: skip
    pose, settled, determined = _stationary(data, start.pose, iterations)
    r2 = squared_residuals(pose, p.src, p.dst, p.noise_bound)
    status = jnp.where(settled & sensible, Status.OK, Status.NOT_CONVERGED)
    status = jnp.where(determined, status, Status.DEGENERATE)
    return SoftSolution(
        pose=pose,
        weights=jnp.where(usable.mask, gnc_weights(r2, data.gnc_mu, p.cbar2), 0),
        status=jnp.where(start.status == Status.OK, status, start.status).astype(jnp.int32),
        cost=jnp.sum(confidence * gnc_cost(r2, data.gnc_mu, p.cbar2)),
        solution=start,
    )


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def _stationary(data: _Data, start: Pose, iterations: int) -> tuple[Pose, Bool[Array, ""], Bool[Array, ""]]:
    """Find the pose, and tell whether the fits settled there and the cost curves upwards on all sides."""
    pose, settled = _descend(data, start, iterations)
    curvature = _curvature(data, pose)
    slope = jax.grad(_energy)(jnp.zeros_like(curvature.unit), data, pose)
    step = jnp.where(settled, -_solved(curvature, slope), 0)
    moved, zero = _moved(pose, step, data), jnp.zeros_like(step)
    # So close to the end rounding decides which of two energies is lower.
    slack = 1 + 64 * jnp.finfo(step.dtype).eps
    better = _energy(zero, data, moved) <= slack * _energy(zero, data, pose)
    pose = jax.tree.map(lambda x, y: jnp.where(better, x, y), moved, pose)
    return pose, settled, curvature.determined


def _descend(data: _Data, start: Pose, iterations: int) -> tuple[Pose, Bool[Array, ""]]:
    """Fit the pose with the weights of the fit before until these stand still, and tell whether they did."""

    class Descent(NamedTuple):
        pose: Pose
        weights: Array

    def weigh(pose: Pose) -> Array:
        r2 = squared_residuals(pose, data.src, data.dst, data.noise_bound)
        return gnc_weights(r2, data.gnc_mu, data.cbar2)

    # Fits converge linearly, and one step of Newton's method after them squares what is left. But no
    # further than rounding allows: it changes a weight by (1 + mu) times what it changes a residual.
    eps = jnp.finfo(data.src.dtype).eps
    largest = jnp.maximum(jnp.abs(data.src), jnp.abs(data.dst))
    reach = jnp.max(jnp.where(weigh(start) > 0, jnp.max(largest, axis=1) / data.noise_bound, 1), initial=1)
    rounding = jnp.minimum(16 * eps * (1 + data.gnc_mu) * reach, LARGEST_CHANGE)
    smallest_change = jnp.maximum(2 * eps**0.5, rounding)

    def step(state: Descent) -> tuple[Descent, Array]:
        weights = data.confidence / data.noise_bound**2 * state.weights
        pose = fit_similarity(data.src, data.dst, weights, data.scale).pose
        found = weigh(pose)
        return Descent(pose, found), jnp.max(jnp.abs(found - state.weights), initial=0) <= smallest_change

    final, settled = until_settled(step, Descent(start, weigh(start)), iterations=iterations)
    return final.pose, settled


class _Curvature(NamedTuple):
    """The second derivative of the cost in equilibrated steps, made harmless where it is not positive."""

    matrix: Float[Array, "d d"]
    unit: Float[Array, " d"]  # lengths of the equilibrated steps
    determined: Bool[Array, ""]


def _energy(step: Float[Array, " d"], data: _Data, pose: Pose) -> Float[Array, ""]:
    """Compute half the softened cost after a step from a pose: turn and shift about the middle, log scale."""
    rotation = pose.rotation @ _turn(step[:3])
    scale = pose.scale if data.scale is None else data.scale
    if data.scale is None:
        scale = scale * (1 + step[6] + 0.5 * step[6] ** 2)  # e^x to second order
    middle = _middle(data, pose)
    moved = pose.translation + pose.scale * so3.rotate(pose.rotation, middle[None])[0] + step[3:6]
    translation = moved - scale * so3.rotate(rotation, middle[None])[0]
    r2 = squared_residuals(Pose(rotation, translation, scale), data.src, data.dst, data.noise_bound)
    return 0.5 * jnp.sum(data.confidence * gnc_cost(r2, data.gnc_mu, data.cbar2))


def _turn(w: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Compute the rotation by a small vector, to second order: all that a second derivative at zero sees."""
    skew = so3.hat(w)
    return jnp.eye(3, dtype=w.dtype) + skew + 0.5 * skew @ skew


def _middle(data: _Data, pose: Pose) -> Float[Array, "3"]:
    """Find the point about which poses are varied: about a far one, turns and shifts would all but coincide.

    It is the middle of the matches that count at the pose: a wrong one may be as far away as it likes.
    """
    data, pose = lax.stop_gradient((data, pose))
    r2 = squared_residuals(pose, data.src, data.dst, data.noise_bound)
    weights = data.confidence * gnc_weights(r2, data.gnc_mu, data.cbar2)
    weights = weights / jnp.maximum(jnp.sum(weights), jnp.finfo(data.src.dtype).tiny)
    return jnp.sum(jnp.where(weights > 0, weights, 0)[:, None] * data.src, axis=0)


def _curvature(data: _Data, pose: Pose) -> _Curvature:
    dtype = data.src.dtype
    d = 6 if data.scale is not None else 7
    matrix = jax.hessian(_energy)(jnp.zeros(d, dtype), data, pose)
    diagonal = jnp.diagonal(matrix)
    upward = diagonal > 0
    unit = lax.rsqrt(jnp.where(upward, diagonal, 1))
    matrix = unit[:, None] * 0.5 * (matrix + matrix.T) * unit[None]
    frozen = jnp.where(jnp.isfinite(matrix), lax.stop_gradient(matrix), 0)
    least = jnp.linalg.eigvalsh(frozen)[0]
    determined = jnp.all(upward) & (least > 64 * jnp.finfo(dtype).eps)
    return _Curvature(jnp.where(determined, matrix, jnp.eye(d, dtype=dtype)), unit, determined)


def _solved(curvature: _Curvature, slope: Float[Array, " d"]) -> Float[Array, " d"]:
    """Find the step to which a slope belongs; zero where the cost does not determine it."""
    scaled = jnp.where(curvature.determined, slope, 0) * curvature.unit
    return curvature.unit * jnp.linalg.solve(curvature.matrix, scaled)


def _moved(pose: Pose, step: Float[Array, " d"], data: _Data) -> Pose:
    """Move a pose by a small step about the middle of the matches that count."""
    half_turn = jnp.concatenate([0.5 * step[:3], jnp.ones_like(step[:1])])
    rotation = pose.rotation @ so3.rotation_from_quat(half_turn)
    scale = pose.scale if data.scale is not None else pose.scale * jnp.exp(step[6])
    middle = _middle(data, pose)[None]
    place = pose.scale * so3.rotate(pose.rotation, middle) - scale * so3.rotate(rotation, middle)
    return Pose(rotation, pose.translation + step[3:6] + place[0], scale)


@_stationary.defjvp
def _stationary_jvp(iterations: int, primals: tuple, tangents: tuple) -> tuple[Any, Any]:
    # The slope of the cost is zero at the pose, whatever the data: J dx + dG = 0.
    (data, start), (d_data, _) = primals, tangents
    pose, settled, determined = _stationary(data, start, iterations)
    curvature = _curvature(data, pose)
    curvature = curvature._replace(determined=curvature.determined & determined)
    zero = jnp.zeros_like(curvature.unit)
    slope = lambda data: jax.grad(_energy)(zero, data, pose)
    _, d_slope = jax.jvp(slope, (data,), (d_data,))
    step = -_solved(curvature, d_slope)
    # The step is one about the middle; the pose is about the origin.
    d_rotation = pose.rotation @ so3.hat(step[:3])
    if data.scale is None:
        d_scale = pose.scale * step[6]
    else:
        d_scale = jnp.where(curvature.determined, d_data.scale, 0)
    middle = _middle(data, pose)[None]
    turned = pose.scale * so3.rotate(d_rotation, middle) + d_scale * so3.rotate(pose.rotation, middle)
    d_pose = Pose(d_rotation, step[3:6] - turned[0], d_scale)
    nothing = np.zeros((), jax.dtypes.float0)
    return (pose, settled, determined), (d_pose, nothing, nothing)
