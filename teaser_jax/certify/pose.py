"""A certificate for the answer to a registration problem: which measurements it speaks about."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.certify.certificate import Certificate, CertificateStatus
from teaser_jax.certify.rotation import (
    ITERATIONS,
    MAX_MEASUREMENTS,
    TOLERANCE,
    CertifyMethod,
    certify_rotation,
)  # fmt: skip
from teaser_jax.problem import is_traced
from teaser_jax.solve import cascade_pose, usable_rows
from teaser_jax.stages import bits
from teaser_jax.stages.invariants import tim_bounds, tims
from teaser_jax.stages.rotation import ring_tims
from teaser_jax.types import Problem, Solution

About = Literal["pose", "chain", "complete"]


class Vectors(NamedTuple):
    """What a rotation is certified against, and the rotation."""

    src: Float[Array, "k 3"]
    dst: Float[Array, "k 3"]
    noise_bound: Float[Array, " k"]
    mask: Bool[Array, " k"]
    rotation: Float[Array, "3 3"]


def certify(
    problem: Problem,
    solution: Solution,
    *,
    about: About = "pose",
    tolerance: Any = TOLERANCE,
    iterations: int = ITERATIONS,
    max_measurements: int = MAX_MEASUREMENTS,
    method: CertifyMethod = "splitting",
) -> Certificate:
    """Prove how good the answer to a registration problem is, *given these measurements*.

    A certificate says that no rotation fits the chosen measurements better than it claims. It never
    says that the matches are right: where all are wrong, the best rotation is certified, too.

    Args:
        problem, solution: The pair that ``solve`` or ``register`` made, one problem.
        about: ``"pose"``: clique and inliers about the inliers' centroids, bounds c beta_i, whose residuals
            are those of the registration; ``"chain"`` and ``"complete"``: the TIMs of the clique with bounds
            beta_i + beta_j, about the rotation of the plain cascade.
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting.
        max_measurements: Under jit, where sizes are static: more give ``TOO_LARGE``. Outside jit there is
            no limit.
        method: See ``certify_rotation``. Under vmap ``"direct"`` is the one to use: the splitting goes on
            until the slowest problem ends.

    Returns:
        A ``Certificate``, whose ``inlier_gap`` and ``explained_gap`` come from the bound on the clique.

    Raises:
        ValueError: If ``about`` is unknown or the solution is a batch.

    Gradients: none, inputs are stopped.

    References: section IX; for the gaps Theorem 6.
    """
    if about not in ("pose", "chain", "complete"):
        raise ValueError(f"about is {about!r}: expected 'pose', 'chain' or 'complete'.")
    if np.ndim(solution.status) != 0:
        raise ValueError("the solution is a batch: use jax.vmap(certify), or certify its items one by one.")
    known = dict(tolerance=tolerance, iterations=iterations, method=method)
    if is_traced(problem, solution):
        problem, solution = lax.stop_gradient((problem, solution))
        vectors = measurements(problem, solution, about, _most_members(about, max_measurements))
        size = min(max_measurements, vectors.mask.shape[0])
        kept, count = _first(vectors, size), jnp.sum(vectors.mask)
        found = certify_rotation(
            kept.src, kept.dst, kept.rotation,
            noise_bound=kept.noise_bound, cbar2=problem.cbar2, mask=kept.mask, **known,
        )  # fmt: skip
        found = _unless(_too_many(solution, about, count, size, max_measurements), found)
        return _with_gaps(found, problem, solution)
    with jax.enable_x64(True):
        double = lambda x: np.asarray(x, np.float64) if np.asarray(x).dtype.kind == "f" else np.asarray(x)
        problem, solution = jax.tree.map(double, (problem, solution))
        members = int(np.sum(solution.selection.clique))
        vectors = jax.device_get(measurements(problem, solution, about, members))
        found = certify_rotation(
            vectors.src, vectors.dst, vectors.rotation,
            noise_bound=vectors.noise_bound, cbar2=problem.cbar2, mask=vectors.mask, **known,
        )  # fmt: skip
        return jax.device_get(_with_gaps(found, problem, solution))


def measurements(problem: Problem, solution: Solution, about: About, members: int) -> Vectors:
    """The vectors that a certificate is about, source scaled; of the clique the first ``members``."""
    p, _ = usable_rows(problem)
    chosen = solution.selection
    if about == "pose":
        keep = p.mask & (chosen.clique | chosen.inliers)
        weights = jnp.where(p.mask & chosen.inliers, 1 / p.noise_bound**2, 0)
        total = jnp.sum(weights)
        weights = weights / jnp.where(total > 0, total, 1)
        a, b = (x - jnp.sum(weights[:, None] * x, axis=0) for x in (p.src, p.dst))
        return Vectors(solution.pose.scale * a, b, p.noise_bound, keep, solution.pose.rotation)
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


def _with_gaps(found: Certificate, problem: Problem, solution: Solution) -> Certificate:
    """What the bound on the clique says of every pose whatever: its inliers are a clique, too."""
    p, _ = usable_rows(problem)
    most = jnp.asarray(solution.clique_upper_bound)
    gap: Int[Array, ""] = most - jnp.sum(solution.inliers, dtype=jnp.int32)
    usable = jnp.sum(p.mask, dtype=jnp.int32)
    all_of_them = jnp.maximum(most, 1) * p.cbar2
    explained = (solution.cost - (usable - most) * p.cbar2) / all_of_them
    return replace(found, inlier_gap=gap, explained_gap=explained)
