"""A certificate for the answer to a registration problem: which measurements it speaks about."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate, CertificateStatus
from teaser_jax.certify.host import certify_rows, compacted
from teaser_jax.certify.proof import CertifyMethod
from teaser_jax.certify.rotation import (
    MAX_MEASUREMENTS,
    TOLERANCE,
    certify_rotation,
    check_tolerance,
    default_iterations,
)  # fmt: skip
from teaser_jax.certify.stack import certify_stack
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import is_traced
from teaser_jax.so3 import AnyArray
from teaser_jax.solve import cascade_pose, usable_rows
from teaser_jax.stages import bits
from teaser_jax.stages.invariants import tim_bounds, tims
from teaser_jax.stages.rotation import ring_tims
from teaser_jax.types import Problem, Solution

MAX_TRACED = 128  # measurements under jit, where sizes are static

About = Literal["pose", "chain", "complete"]


class Vectors(NamedTuple):
    """What a rotation is certified against, and the rotation."""

    src: Float[AnyArray, "k 3"]
    dst: Float[AnyArray, "k 3"]
    noise_bound: Float[AnyArray, " k"]
    mask: Bool[AnyArray, " k"]
    rotation: Float[AnyArray, "3 3"]


def certify(
    problem: Problem,
    solution: Solution,
    *,
    about: About = "pose",
    tolerance: Any = TOLERANCE,
    iterations: int | None = None,
    max_measurements: int | None = None,
    method: CertifyMethod = "splitting",
) -> Certificate:
    """Prove how good the answer to a registration problem is, *given these measurements*.

    A certificate says that no rotation fits the chosen measurements better than it claims. It never
    says that the matches are right: where all are wrong, the best rotation is certified, too.

    Args:
        problem, solution: The pair that ``solve`` or ``register`` made; outside jit also stacks of them,
            where the closed form is tried on all at once and only what it leaves is iterated on.
        about: ``"pose"``: clique and inliers about the inliers' centroids, bounds c beta_i, whose residuals
            are those of the registration; ``"chain"`` and ``"complete"``: the TIMs of the clique with bounds
            beta_i + beta_j, about the rotation of the plain cascade.
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting. None: 200, and fewer for many measurements.
        max_measurements: More give ``TOO_LARGE`` and leave the gaps only. None: 1000, or 128 under jit,
            where it is also the size of the program.
        method: See ``certify_rotation``. Under vmap ``"direct"`` is the one to use: the splitting goes on
            until the slowest problem ends.

    Returns:
        A ``Certificate``, whose ``inlier_gap`` and ``explained_gap`` come from the bound on the clique.

    Raises:
        ValueError: If ``about`` is unknown, or under jit a stack is given.

    Gradients: none, inputs are stopped.

    References: section VIII-C; for the gaps Theorem 6.
    """
    if about not in ("pose", "chain", "complete"):
        raise ValueError(f"about is {about!r}: expected 'pose', 'chain' or 'complete'.")
    if method not in ("splitting", "direct", "reference"):
        raise ValueError(f"method is {method!r}: expected 'splitting', 'direct' or 'reference'.")
    if iterations is not None:
        whole_number("iterations", iterations, 0)
    if max_measurements is not None:
        whole_number("max_measurements", max_measurements, 0)
    if is_traced(problem, solution):
        if np.ndim(solution.status) != 0:
            raise ValueError("the solution is a stack: inside jit use jax.vmap(certify).")
        most = MAX_TRACED if max_measurements is None else max_measurements
        rounds = default_iterations(most) if iterations is None else iterations
        known = dict(tolerance=tolerance, iterations=rounds, method=method, max_measurements=most)
        return _traced(*lax.stop_gradient((problem, solution)), about, known)
    most = MAX_MEASUREMENTS if max_measurements is None else max_measurements
    problem, solution = jax.tree.map(_on_host, (problem, solution))
    if np.ndim(solution.status) == 0:
        items = [(problem, solution)]
    else:
        count = len(solution.status)
        if np.ndim(problem.cbar2) != 1 or len(problem.cbar2) != count or count == 0:
            raise ValueError("problem and solution are not stacks of the same length.")
        items = [jax.tree.map(lambda x, i=i: x[i], (problem, solution)) for i in range(count)]
    vectors = [_host_measurements(p, s, about) for p, s in items]
    rows = [compacted(*v[:3], p.cbar2, v.mask) for v, (p, _) in zip(vectors, items, strict=True)]
    if iterations is None:
        iterations = default_iterations(max(int(r.mask.sum()) for r in rows))
    known = dict(iterations=iterations, method=method, most=most)
    if np.ndim(solution.status) == 0:
        found = certify_rows(rows[0], vectors[0].rotation, check_tolerance(tolerance), **known)
        return with_gaps(found, problem, solution)
    rotations = np.stack([v.rotation for v in vectors])
    found = certify_stack(rows, rotations, check_tolerance(tolerance), **known)
    gaps = [with_gaps(found, p, s) for p, s in items]
    return replace(
        found,
        inlier_gap=np.array([g.inlier_gap for g in gaps]),
        explained_gap=np.array([g.explained_gap for g in gaps]),
    )


def _on_host(x: Any) -> np.ndarray:
    x = np.asarray(x)
    return x.astype(np.float64) if x.dtype.kind == "f" else x


def _traced(problem: Problem, solution: Solution, about: About, known: dict[str, Any]) -> Certificate:
    most = known["max_measurements"]
    vectors = measurements(problem, solution, about, _most_members(about, most))
    size = min(most, vectors.mask.shape[0])
    kept, count = _first(vectors, size), jnp.sum(vectors.mask)
    found = certify_rotation(
        kept.src, kept.dst, kept.rotation,
        noise_bound=kept.noise_bound, cbar2=problem.cbar2, mask=kept.mask, **known,
    )  # fmt: skip
    found = _unless(_too_many(solution, about, count, size, most), found)
    return with_gaps(found, usable_rows(problem)[0], solution)


def _host_measurements(problem: Problem, solution: Solution, about: About) -> Vectors:
    if about == "pose":  # plain numpy: it is what is called most
        return _about_pose(np, problem, solution)
    with jax.enable_x64(True):
        members = int(np.sum(solution.selection.clique))
        return jax.device_get(measurements(problem, solution, about, members))


def measurements(problem: Problem, solution: Solution, about: About, members: int) -> Vectors:
    """The vectors that a certificate is about, source scaled; of the clique the first ``members``."""
    p, _ = usable_rows(problem)
    chosen = solution.selection
    if about == "pose":
        return _about_pose(jnp, p, solution)
    cascade = cascade_pose(problem, chosen)
    clique = chosen.clique & p.mask
    if p.pairs is not None:
        pairs = jnp.asarray(p.pairs)
        exist = clique[pairs[:, 0]] & clique[pairs[:, 1]]
    elif about == "chain":
        pairs, exist = ring_tims(clique), clique
    else:
        rows = bits.listed(clique)[:members]
        i, j = (np.asarray(x, np.int32) for x in np.triu_indices(members, 1))
        pairs = jnp.stack([rows[i], rows[j]], axis=1)
        exist = jnp.arange(members, dtype=jnp.int32) < jnp.sum(clique, dtype=jnp.int32)
        exist = exist[i] & exist[j]
    a, b = cascade.scale * tims(p.src, pairs), tims(p.dst, pairs)
    return Vectors(a, b, tim_bounds(p.noise_bound, pairs), exist, cascade.rotation)


def _about_pose(xp: ModuleType, p: Problem, solution: Solution) -> Vectors:
    """Clique and inliers, about the centroids of the inliers: the joint fit is stationary there."""
    chosen = solution.selection
    keep = p.mask & (chosen.clique | chosen.inliers)
    # Rows outside may hold anything, and must not reach the sums.
    src, dst = (xp.where(keep[:, None], x, 0) for x in (p.src, p.dst))
    weights = xp.where(keep & chosen.inliers, 1 / xp.where(keep, p.noise_bound, 1) ** 2, 0)
    total = xp.sum(weights)
    weights = weights / xp.where(total > 0, total, 1)
    a, b = (x - xp.sum(weights[:, None] * x, axis=0) for x in (src, dst))
    return Vectors(solution.pose.scale * a, b, p.noise_bound, keep, solution.pose.rotation)


def _most_members(about: About, most: int) -> int:
    """How many points have at most so many pairs."""
    return int((1 + np.sqrt(1 + 8 * most)) // 2) if about == "complete" else most


def _too_many(solution: Solution, about: About, count: Array, size: int, most: int) -> Bool[Array, ""]:
    if about == "complete":
        return jnp.sum(solution.selection.clique) > _most_members(about, most)
    return count > size


def _first(vectors: Vectors, size: int) -> Vectors:
    """Those of the mask, moved to the front, as many as there is room for."""
    where = bits.listed(vectors.mask)[:size]
    exist = jnp.arange(size, dtype=jnp.int32) < jnp.sum(vectors.mask, dtype=jnp.int32)
    return Vectors(
        vectors.src[where], vectors.dst[where], vectors.noise_bound[where], exist, vectors.rotation
    )


def _unless(too_large: Bool[Array, ""], found: Certificate) -> Certificate:
    """Nothing is proved of measurements that were left out."""
    nothing = replace(
        found,
        lower_bound=jnp.zeros_like(found.lower_bound),
        suboptimality=jnp.ones_like(found.suboptimality),
        is_optimal=jnp.zeros_like(found.is_optimal),
        is_unique=jnp.zeros_like(found.is_unique),
        angle_bound=jnp.full_like(found.angle_bound, jnp.inf),
        status=jnp.full_like(found.status, CertificateStatus.TOO_LARGE),
    )
    return jax.tree.map(lambda a, b: jnp.where(too_large, a, b), nothing, found)


def with_gaps(found: Certificate, problem: Problem, solution: Solution) -> Certificate:
    """What the bound on the clique says of every pose whatever: its inliers are a clique, too."""
    p = problem
    xp = so3.namespace(p.src, solution.clique_upper_bound)
    usable = p.mask & (p.noise_bound > 0) & (p.confidence > 0) & _finite(xp, p)
    most = xp.asarray(solution.clique_upper_bound)
    gap = most - xp.sum(solution.inliers)
    explained = (solution.cost - (xp.sum(usable) - most) * p.cbar2) / (xp.maximum(most, 1) * p.cbar2)
    return replace(found, inlier_gap=gap.astype(np.int32), explained_gap=explained)


def _finite(xp: ModuleType, p: Problem) -> Bool[AnyArray, " n"]:
    rows = xp.concatenate([p.src, p.dst, p.noise_bound[:, None], p.confidence[:, None]], axis=1)
    return xp.all(xp.isfinite(rows), axis=1)
