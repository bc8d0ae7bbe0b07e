"""What a certificate of a pose speaks about: the vectors that its rotation is held against."""

from __future__ import annotations

from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from teaser_jax.certify.host import in_float64
from teaser_jax.ground import bits
from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.problem import Problem, clean
from teaser_jax.refit import as_judged, as_solved, cascade_pose
from teaser_jax.solution import Selection, Solution
from teaser_jax.stages.pairs import ring_pairs, tim_bounds, tims

About = Literal["pose", "chain", "complete"]


class Subject(NamedTuple):
    """A rotation, and the vectors that it is to be certified against.

    Attributes:
        src, dst: Vector pairs, the scale a part of ``src`` [length of the target].
        noise_bound: The bound of each pair [length of the target].
        mask: Pairs that exist.
        rotation: The candidate.
    """

    src: Float[AnyArray, "k 3"]
    dst: Float[AnyArray, "k 3"]
    noise_bound: Float[AnyArray, " k"]
    mask: Bool[AnyArray, " k"]
    rotation: Float[AnyArray, "3 3"]


def subject_on_host(problem: Problem, solution: Solution, about: About) -> Subject:
    """Choose the vectors to certify against, any number, on the host: problem and solution are in numpy."""
    if about == "pose":  # plain numpy: it is what is called most
        return _about_pose(as_judged(problem, solution.selection), solution)
    members = int(solution.clique_size) if about == "complete" else 0
    return in_float64(lambda: jax.device_get(_tims_on_host(problem, solution.selection, about, members)))


def traced_subject(
    problem: Problem, solution: Solution, about: About, most: int
) -> tuple[Subject, Bool[Array, ""]]:
    """Choose the vectors to certify against, under jit, where sizes are static.

    Args:
        problem: The problem, cleaned.
        solution: Its solution.
        about: Which vectors.
        most: As many are kept.

    Returns:
        The vectors that count, moved to the front, and whether there were more.
    """
    if about == "pose":
        subject = _about_pose(as_judged(problem, solution.selection), solution)
    else:
        subject = _about_tims(problem, solution.selection, about, _most_members(about, most))
    size = min(most, subject.mask.shape[0])
    if about == "complete":
        too_many = solution.clique_size > _most_members(about, most)
    else:
        too_many = jnp.sum(subject.mask) > size
    return _compacted(subject, size), too_many


def _about_pose(problem: Problem, solution: Solution) -> Subject:
    """Take clique and inliers, about the centroids of the inliers: the joint fit is stationary there."""
    p, chosen = problem, solution.selection  # bounds are widened, copies masked
    xp = namespace(p.src, chosen.inliers)
    keep = p.mask & (chosen.clique | chosen.inliers)
    # Rows outside may hold anything, and must not reach the sums.
    src, dst = (xp.where(keep[:, None], x, 0) for x in (p.src, p.dst))
    weights = xp.where(keep & chosen.inliers, 1 / xp.where(keep, p.noise_bound, 1) ** 2, 0)
    total = xp.sum(weights)
    weights = weights / xp.where(total > 0, total, 1)
    a, b = (x - xp.sum(weights[:, None] * x, axis=0)[None] for x in (src, dst))
    return Subject(solution.pose.scale * a, b, p.noise_bound, keep, solution.pose.rotation)


@partial(jax.jit, static_argnames=("about", "members"))
def _tims_on_host(problem: Problem, chosen: Selection, about: About, members: int) -> Subject:
    return _about_tims(clean(problem)[0], chosen, about, members)


def _about_tims(p: Problem, chosen: Selection, about: About, members: int) -> Subject:
    """Take the TIMs of the clique, source scaled; of all pairs those among its first ``members``."""
    p, chosen = as_solved(p, chosen)
    cascade = cascade_pose(p, chosen)
    clique = chosen.clique & p.mask
    if p.pairs is not None:
        pairs = jnp.asarray(p.pairs)
        exist = clique[pairs[:, 0]] & clique[pairs[:, 1]]
    elif about == "chain":
        pairs, exist = ring_pairs(clique), clique
    else:
        rows = bits.listed(clique)[:members]
        i, j = (np.asarray(x, np.int32) for x in np.triu_indices(members, 1))
        pairs = jnp.stack([rows[i], rows[j]], axis=1)
        exist = jnp.arange(members, dtype=jnp.int32) < jnp.sum(clique, dtype=jnp.int32)
        exist = exist[i] & exist[j]
    a, b = cascade.scale * tims(p.src, pairs), tims(p.dst, pairs)
    return Subject(a, b, tim_bounds(p.noise_bound, pairs), exist, cascade.rotation)


def _most_members(about: About, most: int) -> int:
    """Count the members of a clique that has at most so many TIMs."""
    return int((1 + np.sqrt(1 + 8 * most)) // 2) if about == "complete" else most


def _compacted(subject: Subject, size: int) -> Subject:
    """Move the pairs that exist to the front, as many as there is room for."""
    where = bits.listed(subject.mask)[:size]
    exist = jnp.arange(size, dtype=jnp.int32) < jnp.sum(subject.mask, dtype=jnp.int32)
    return Subject(
        subject.src[where], subject.dst[where], subject.noise_bound[where], exist, subject.rotation
    )
