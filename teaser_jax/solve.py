"""The whole method on one page: choose discretely, estimate smoothly.

    clean      rows that cannot be used are masked, once; copies are merged; the order is the method's own
    prepare    the scale, how wide the bounds are, and which matches agree
    search     the largest set of matches that agree pairwise
    choose     rotation, translation, refinement: which measurements to trust
    refit      the pose from those sets, in closed form: gradients flow
    judge      whether to trust it

The first four are ``select``, all six ``solve``. ``register`` and ``solve_batch`` run the same pieces around
the host, and ``profile`` times them one by one: a stage is run by ``run``, which it replaces.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax.agreement import Graph, prepare
from teaser_jax.cascade import find_cascade
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.ground.steps import Run, plainly
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, check_precision, clean
from teaser_jax.refit import cascade_pose, check_problem, joint_fit, widened
from teaser_jax.rows import in_rows
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solution import Selection, Solution, as_asked, with_rows
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.maximum import maximum_clique
from teaser_jax.stages.one_to_one import bound_on_rows
from teaser_jax.stages.refinement import Fit, Refinement, refine, squared_residuals, truncated_cost
from teaser_jax.stages.verdict import evidence_of, status_of


def solve(problem: Problem, settings: Settings = Settings()) -> Solution:
    """Register matched points robustly: TEASER++, then a joint refinement.

    A pure function: works under jit, vmap, grad and lax.scan, on one device (the exact clique
    calls the host once a batch). Follows the dtype of the problem; scale and translation vote in
    float64 inside. Never raises on values: see ``Solution.status``.

    Args:
        problem: From ``make_problem``; lengths in the user's unit.
        settings: Choices are static, numbers traced.

    Returns:
        The pose from the source to the target frame and what it rests on. Finite always.

    Raises:
        ValueError: On anything but one ``Problem`` and ``Settings``; on a problem in numpy whose bound is
            lost in float32, unless JAX's x64 is on.

    Gradients: exact through ``refit`` as long as the chosen sets do not change, that is almost
    everywhere; the sets themselves carry none (``soft_solve`` differentiates through them, too). Zero
    where the rotation is ambiguous, and then the status is not OK.

    References: Yang, Shi, Carlone, T-RO 2021, Algorithm 1 with MCIS (section VI-D) and GNC (section X).
    """
    p, excluded = _at_the_door(problem, settings)
    graph = prepare(lax.stop_gradient(p), settings)
    clique = maximum_clique(graph.edge_bits, graph.mask, settings.clique)
    return conclude(p, excluded, graph, clique, settings)


def select(problem: Problem, settings: Settings = Settings()) -> Selection:
    """Choose which measurements to trust: the discrete half of ``solve``, without its verdict.

    ``refit(problem, select(problem))`` is the pose of ``solve(problem)``.

    Args:
        problem, settings: As for ``solve``.

    Raises:
        ValueError: On anything but one ``Problem`` and ``Settings``.

    Gradients: none, the sets are choices. Differentiate ``refit``.
    """
    p = lax.stop_gradient(_at_the_door(problem, settings)[0])
    graph = prepare(p, settings)
    clique = maximum_clique(graph.edge_bits, graph.mask, settings.clique)
    chosen, _ = choose(widened(in_rows(p, graph.rows), graph.widening), graph, clique, settings)
    return with_rows(chosen, graph.rows, has_pairs=p.pairs is not None)


def _at_the_door(problem: Any, settings: Any) -> tuple[Problem, Int[Array, ""]]:
    """Check and clean a problem, and count the rows that are not finite."""
    check_problem(problem)
    check_settings(settings)
    check_precision(problem)
    return clean(problem)


def choose(
    p: Problem, graph: Graph, clique: Clique, settings: Settings,
    *, cascade: Run = find_cascade, refinement: Run | None = None, run: Run = plainly,
) -> tuple[Selection, Bool[Array, ""]]:  # fmt: skip
    """Choose which measurements to trust, given the clique, and tell whether every iteration settled.

    The problem is clean and its bounds are widened; ``cascade`` finds rotation and translation, and
    ``refinement`` the inliers (None: ``find_inliers``). Gradients: none; the caller stops the inputs.
    """
    members = clique.members & p.mask
    found = cascade(p, graph.scale, members, settings, run)
    inliers, settled = members & jnp.all(found.axes, axis=1), found.settled
    if settings.refine:
        inliers, still = run("refinement", refinement or find_inliers, p, found.pose, settings.refine)
        settled &= still
    refined = jnp.asarray(settings.refine is not None)
    sets = (graph.scale_pairs, members, found.tims, found.axes, inliers)
    return Selection(*sets, refined, graph.widening), settled


def find_inliers(
    p: Problem, start: Pose, refinement: Refinement
) -> tuple[Bool[Array, " n"], Bool[Array, ""]]:
    """Find the consensus set where the joint cost (6) stops falling, and tell whether it did stop."""
    return refine(
        start, p.src, p.dst, p.noise_bound, p.mask,
        scale=p.scale, cbar2=p.cbar2, iterations=refinement.iterations,
    )  # fmt: skip


def conclude(
    p: Problem, excluded: Int[Array, ""], graph: Graph, clique: Clique, settings: Settings,
    *, offset: Float[AnyArray, "3"] | None = None, cascade: Run = find_cascade,
    refinement: Run | None = None, run: Run = plainly,
) -> Solution:  # fmt: skip
    """Find what lies behind the clique: the sets, the pose, and whether to trust it; in the user's rows.

    Added to the source, ``offset`` makes it stand to the target as in the frames as given; None: it does.
    """
    p = widened(in_rows(p, graph.rows), graph.widening)
    frozen, graph, clique = lax.stop_gradient((p, graph, clique))
    selection, settled = choose(
        frozen, graph, clique, settings, cascade=cascade, refinement=refinement, run=run
    )
    if settings.refine:
        fit = run("refit", joint_fit, p, selection)
        pose = fit.pose
    else:
        fit, pose = joint_fit(frozen, selection), run("refit", cascade_pose, p, selection)
    found = lax.stop_gradient((pose, fit))
    status = run("verdict", judge, frozen, *found, selection, graph.edge_bits, settled, settings, offset)
    size = jnp.sum(clique.members, dtype=jnp.int32)
    solution = Solution(
        pose=pose,
        selection=selection,
        inliers=selection.inliers,
        status=status,
        clique_size=size,
        clique_upper_bound=bound_on_rows(clique.upper_bound, graph.further, graph.mask),
        clique_is_maximum=(size == clique.upper_bound) & settings.clique.prunes,
        excluded=excluded,
        cost=truncated_cost(squared_residuals(pose, p.src, p.dst, p.noise_bound), p.mask, p.cbar2),
    )
    return as_asked(solution, graph.rows, has_pairs=p.pairs is not None)


def judge(
    p: Problem, pose: Pose, fit: Fit, selection: Selection, edge_bits: UInt32[Array, "n w"],
    settled: Bool[Array, ""], settings: Settings, offset: Float[AnyArray, "3"] | None,
) -> Int[Array, ""]:  # fmt: skip
    """Decide the status of a pose, from what speaks for it and against it."""
    evidence = evidence_of(
        p, pose, fit, selection.inliers, selection.clique, edge_bits,
        has_settled=settled, pruned=settings.clique.prunes, scale_range=settings.scale_search.range,
        offset=offset,
    )  # fmt: skip
    return status_of(evidence)
