"""The whole method on one page: choose discretely, estimate smoothly.

    prepare    scale, consistency graph, greedy clique            on the device
    search     exact clique, where the device has no proof        on the host
    choose     rotation, translation, refinement: which measurements to trust
    refit      the pose from those sets, in closed form           gradients flow

The first three are ``select``, all four ``solve``. ``register`` runs the same pieces around the host.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, Int, UInt32

from teaser_jax import so3
from teaser_jax.stages import bits
from teaser_jax.stages.clique import Clique, maximum_clique
from teaser_jax.stages.consistency import consistency_graph
from teaser_jax.stages.invariants import tim_bounds, tims
from teaser_jax.stages.quadratic_form import Measurements, in_frame_of
from teaser_jax.stages.refinement import fit_similarity, refine, squared_residuals, truncated_cost
from teaser_jax.stages.rotation import (
    Rotation,
    Tims,
    complete_tims,
    correlation,
    correlation_of_pairs,
    estimate_rotation,
    listed_tims,
    ring_tims,
    settle,
)  # fmt: skip
from teaser_jax.stages.rotation_global import search
from teaser_jax.stages.rotation_sdp import solve_relaxation
from teaser_jax.stages.scale import ScalePairs, estimate_scale, scale_of_pairs, usable_pairs
from teaser_jax.stages.translation import estimate_translation, translation_of_points
from teaser_jax.stages.trust import judge
from teaser_jax.types import Pose, Problem, Selection, Settings, Solution


class Graph(NamedTuple):
    """What is known before the clique: the scale, who voted for it, and which matches agree."""

    scale: Float[Array, ""]
    scale_pairs: ScalePairs | None
    edge_bits: UInt32[Array, "n w"]


def solve(problem: Problem, settings: Settings = Settings()) -> Solution:
    """Robust registration of matched points: TEASER++, then a joint refinement.

    A pure function: works under jit, vmap, grad and lax.scan, on one device (the exact clique
    calls the host once a batch). Follows the dtype of the problem; scale and translation vote in
    float64 inside. Never raises on values: see ``Solution.status``.

    Args:
        problem: From ``make_problem``; lengths in the user's unit.
        settings: Choices are static, numbers traced.

    Returns:
        The pose from the source to the target frame and what it rests on. Finite always.

    Raises:
        ValueError: On anything but one ``Problem`` and ``Settings``.

    Gradients: exact through ``refit`` as long as the chosen sets do not change, that is almost
    everywhere; the sets themselves carry none (``soft_solve`` differentiates through them, too). Zero
    where the rotation is ambiguous, and then the status is not OK.

    References: Yang, Shi, Carlone, T-RO 2020, Algorithm 1 with MCIS (section VI-D) and GNC.
    """
    check_records(problem, settings)
    frozen = lax.stop_gradient(problem)
    graph = prepare(frozen, settings)
    clique = find_clique(frozen, graph, settings)
    return conclude(problem, graph, clique, settings)


def check_records(problem: Any, settings: Any) -> None:
    """ValueError unless these are one problem and settings."""
    if not isinstance(problem, Problem):
        raise ValueError(
            f"received {type(problem).__name__} for a problem: make one with make_problem(src, dst, "
            "noise_bound=...)."
        )
    if not isinstance(settings, Settings):
        raise ValueError(f"settings is {settings!r}: expected Settings, as in Settings(clique='greedy').")
    if problem.src.ndim != 2:
        raise ValueError(
            f"src has shape {problem.src.shape}: expected one problem; use jax.vmap(solve) for a stack."
        )


def select(problem: Problem, settings: Settings = Settings()) -> Selection:
    """Which measurements to trust: the discrete half of ``solve``, without its verdict.

    ``refit(problem, select(problem))`` is the pose of ``solve(problem)``.

    Gradients: none, the sets are choices. Differentiate ``refit``.
    """
    check_records(problem, settings)
    frozen = lax.stop_gradient(problem)
    graph = prepare(frozen, settings)
    return choose(frozen, graph, find_clique(frozen, graph, settings), settings)[0]


def prepare(problem: Problem, settings: Settings = Settings(), *, edge_dtype: Any = None) -> Graph:
    """The scale and the consistency graph."""
    scale, scale_pairs = find_scale(problem, settings)
    return Graph(scale, scale_pairs, find_edges(problem, scale, dtype=edge_dtype))


def find_scale(
    problem: Problem, settings: Settings = Settings()
) -> tuple[Float[Array, ""], ScalePairs | None]:
    """The known scale, or the vote (11) and the pairs that agree with it."""
    p, _ = usable_rows(problem)
    if p.scale is not None:
        return p.scale, None
    return estimate_scale(
        p.src, p.dst, p.noise_bound, p.mask,
        cbar2=p.cbar2, pairs=p.pairs, criterion=settings.vote, scale_range=settings.scale_range,
    )  # fmt: skip


def find_edges(problem: Problem, scale: Float[Array, ""], *, dtype: Any = None) -> UInt32[Array, "n w"]:
    """The consistency graph at a scale, tested in ``dtype`` (None: that of the problem)."""
    p, _ = usable_rows(problem)
    src, dst, noise_bound, scale, cbar2 = (
        x.astype(dtype or p.src.dtype) for x in (p.src, p.dst, p.noise_bound, scale, p.cbar2)
    )
    return consistency_graph(src, dst, noise_bound, p.mask, scale=scale, cbar2=cbar2, pairs=p.pairs)


def find_clique(problem: Problem, graph: Graph, settings: Settings = Settings()) -> Clique:
    """The largest set of matches that agree pairwise; asks the host where the device has no proof."""
    return maximum_clique(
        graph.edge_bits,
        usable_rows(problem)[0].mask,
        method=settings.clique,
        nodes=settings.clique_nodes,
        seconds=settings.clique_seconds,
    )


def conclude(
    problem: Problem,
    graph: Graph,
    clique: Clique,
    settings: Settings = Settings(),
    *,
    room: int | None = None,
) -> Solution:
    """Everything behind the clique: the sets, the pose, and whether to trust it.

    ``room`` as in ``choose``.
    """
    graph, clique = lax.stop_gradient((graph, clique))
    selection, converged = choose(lax.stop_gradient(problem), graph, clique, settings, room=room)
    pose = _refit(problem, selection, refined=settings.refine)
    p, excluded = usable_rows(problem)
    frozen_pose = lax.stop_gradient(pose)
    clique_size = jnp.sum(clique.members, dtype=jnp.int32)
    status = judge(
        lax.stop_gradient(p), frozen_pose, selection.inliers, selection.clique, graph.edge_bits,
        converged=converged, pruned=settings.clique != "none", scale_range=settings.scale_range,
    )  # fmt: skip
    return Solution(
        pose=pose,
        selection=selection,
        inliers=selection.inliers,
        status=status,
        clique_size=clique_size,
        clique_upper_bound=clique.upper_bound,
        clique_is_maximum=(clique_size == clique.upper_bound) & (settings.clique != "none"),
        excluded=excluded,
        cost=truncated_cost(squared_residuals(pose, p.src, p.dst, p.noise_bound), p.mask, p.cbar2),
    )


def choose(
    problem: Problem,
    graph: Graph,
    clique: Clique,
    settings: Settings = Settings(),
    *,
    room: int | None = None,
) -> tuple[Selection, Bool[Array, ""]]:
    """Which measurements to trust, given the clique, and whether every iteration settled.

    Args:
        problem, graph, clique: What the stages before have found.
        settings: How to go on.
        room: At least the size of the clique, if that is known when the program is compiled: rotation and
            translation are then found in so many rows instead of all. Without given pairs, and with TIMs
            in a chain.

    Gradients: none; the caller stops the inputs.
    """
    members = clique.members & usable_rows(problem)[0].mask
    rows = None if room is None else bits.listed(members)[:room]
    few, present = (problem, members) if rows is None else _rows_of(problem, members, rows)
    turned = find_rotation(few, graph.scale, present, settings)
    cascade, axes = find_translation(few, graph.scale, present, turned.rotation, settings)
    tims_kept = turned.members
    if rows is not None:
        place = jnp.where(present, rows, members.shape[0])
        tims_kept, axes = (
            jnp.zeros((members.shape[0], *x.shape[1:]), bool).at[place].set(x, mode="drop")
            for x in (tims_kept, axes)
        )
    inliers, settled = members & jnp.all(axes, axis=1), jnp.ones((), bool)
    if settings.refine:
        inliers, settled = find_inliers(problem, cascade, settings)
    selection = Selection(
        scale_pairs=graph.scale_pairs,
        clique=members,
        rotation=tims_kept,
        translation=axes,
        inliers=inliers,
        refined=jnp.asarray(settings.refine),
    )
    return selection, turned.converged & settled


def _rows_of(
    problem: Problem, members: Bool[Array, " n"], rows: Int[Array, " k"]
) -> tuple[Problem, Bool[Array, " k"]]:
    """The problem of the clique's members alone, in the user's order, and which of its rows are one."""
    present = jnp.arange(rows.shape[0], dtype=jnp.int32) < jnp.sum(members, dtype=jnp.int32)
    few = replace(
        problem,
        src=problem.src[rows],
        dst=problem.dst[rows],
        noise_bound=problem.noise_bound[rows],
        mask=present,
        confidence=problem.confidence[rows],
    )
    return few, present


def find_rotation(
    problem: Problem, scale: Float[Array, ""], members: Bool[Array, " n"], settings: Settings
) -> Rotation:
    """The rotation of the TIMs among the clique's members (12): GNC, then what ``settings.rotation`` asks."""
    p, _ = usable_rows(problem)
    scale = _positive(scale)
    considered = _rotation_tims(p, members, scale, settings.tim_graph)
    found = estimate_rotation(
        considered,
        cbar2=p.cbar2,
        gnc_factor=settings.gnc_factor,
        tolerance=settings.gnc_tolerance,
        iterations=settings.gnc_iterations,
        dtype=p.src.dtype,
    )
    if settings.rotation == "gnc":
        return found
    a, b, bounds, exist = _listed_tims(p, members, scale)
    m = in_frame_of(
        found.rotation, a, b, noise_bound=bounds, cbar2=p.cbar2, mask=exist, dtype=p.src.dtype
    ).measurements
    turn = search(m)
    if settings.rotation == "sdp":
        turn = turn @ _relaxed(m.turned(turn))
    # The search knows the ring (or the given pairs); which of the two is better is judged on all TIMs.
    mine, cost = settle(considered, found.rotation, cbar2=p.cbar2)
    other, its_cost = settle(considered, found.rotation @ turn, cbar2=p.cbar2)
    return jax.tree.map(lambda x, y: jnp.where(its_cost < cost, y, x), mine, other)


def _relaxed(m: Measurements) -> Float[Array, "3 3"]:
    """The turn to the rotation of the relaxation; raises ValueError under jit."""
    if not isinstance(m.src, jax.core.Tracer):
        m = m._replace(src=m.src[m.mask], dst=m.dst[m.mask], mask=m.mask[m.mask])
    return jnp.asarray(solve_relaxation(m).turn, m.src.dtype)


def find_translation(
    problem: Problem,
    scale: Float[Array, ""],
    members: Bool[Array, " n"],
    rotation: Float[Array, "3 3"],
    settings: Settings,
) -> tuple[Pose, Bool[Array, "n 3"]]:
    """The vote of each axis (13): the cascade's pose, and the members behind its translation."""
    p, _ = usable_rows(problem)
    scale = _positive(scale)
    offsets = p.dst - scale * so3.rotate(rotation, p.src)
    translation, axes = estimate_translation(
        offsets, p.noise_bound, members, cbar2=p.cbar2, criterion=settings.vote
    )
    return Pose(rotation, translation, scale), axes


def find_inliers(
    problem: Problem, cascade: Pose, settings: Settings
) -> tuple[Bool[Array, " n"], Bool[Array, ""]]:
    """The consensus set where the joint cost (6) stops falling, and whether it did stop."""
    p, _ = usable_rows(problem)
    return refine(
        cascade, p.src, p.dst, p.noise_bound, p.mask,
        scale=p.scale, cbar2=p.cbar2, iterations=settings.refine_iterations,
    )  # fmt: skip


def refit(problem: Problem, selection: Selection) -> Pose:
    """The pose from the chosen sets, in closed form: the smooth half of the method.

    Refined selections give the weighted similarity fit over ``inliers``; others give (11) - (13)
    on the frozen sets with binary weights. Weights are confidence_i / beta_i^2.

    Args:
        problem: One problem; ``jax.vmap`` takes stacks.
        selection: Of that problem, as in ``solution.selection``: sets in the order of its rows.

    Raises:
        ValueError: If they do not belong together.

    Gradients: exact in points, bounds, known scale and confidences; memory O(n) (complete TIM
    graphs and voted scales: one slice of the pairs at a time). Zero where the rotation is ambiguous.
    """
    check_records(problem, Settings())
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
    return lax.cond(
        selection.refined,
        lambda: _refit(problem, selection, refined=True),
        lambda: _refit(problem, selection, refined=False),
    )


def cascade_pose(problem: Problem, selection: Selection) -> Pose:
    """What ``refit`` would give without refinement: the paper's plain cascade on the same sets."""
    return _refit(problem, selection, refined=False)


def _refit(problem: Problem, selection: Selection, *, refined: bool) -> Pose:
    p, _ = usable_rows(problem)
    if refined:
        weights = jnp.where(selection.inliers, p.confidence / p.noise_bound**2, 0)
        fit = fit_similarity(p.src, p.dst, weights, p.scale)
        return _constant_if_ambiguous(fit.pose, fit.correlation)
    if p.scale is not None:
        scale = p.scale
    else:
        assert selection.scale_pairs is not None
        scale = _positive(
            scale_of_pairs(p.src, p.dst, p.noise_bound, p.confidence, selection.scale_pairs, pairs=p.pairs)
        )
    h = _correlation_of(p, selection.clique, selection.rotation)
    rotation = so3.nearest_rotation(h)
    offsets = p.dst - scale * so3.rotate(rotation, p.src)
    translation = translation_of_points(offsets, p.noise_bound, p.confidence, selection.translation)
    return _constant_if_ambiguous(Pose(rotation, translation, scale), h)


def _constant_if_ambiguous(pose: Pose, correlation: Float[Array, "3 3"]) -> Pose:
    """A pose whose rotation could as well be another has no derivative that means anything: it gets zero."""
    ambiguous = so3.is_ambiguous(correlation)
    return jax.tree.map(lambda x: jnp.where(ambiguous, lax.stop_gradient(x), x), pose)


def _positive(scale: Float[Array, ""]) -> Float[Array, ""]:
    """The scale, or 1 where nothing could vote: what follows must stay finite."""
    return jnp.where(scale > 0, scale, 1)


def _rotation_tims(p: Problem, members: Array, scale: Array, tim_graph: str) -> Tims:
    """The TIMs of the rotation stage among the clique's members, source scaled."""
    if p.pairs is None and tim_graph == "complete":
        return complete_tims(scale * p.src, p.dst, p.noise_bound, members)
    return listed_tims(*_listed_tims(p, members, scale))


def _listed_tims(p: Problem, members: Array, scale: Array) -> tuple[Array, Array, Array, Array]:
    """The TIMs of the ring, or of the given pairs, with their bounds and whether they exist."""
    pairs = ring_tims(members) if p.pairs is None else p.pairs
    a, b, bounds = tims(scale * p.src, pairs), tims(p.dst, pairs), tim_bounds(p.noise_bound, pairs)
    return a, b, bounds, usable_pairs(pairs, members)


def _correlation_of(p: Problem, members: Array, chosen: Array) -> Float[Array, "3 3"]:
    """What decides the closed-form rotation (12) on the chosen TIMs; the scale does not matter to it."""
    if chosen.dtype == jnp.uint32:
        return correlation_of_pairs(p.src, p.dst, p.noise_bound, p.confidence, chosen)
    pairs = ring_tims(members) if p.pairs is None else p.pairs
    weight = p.confidence[pairs[:, 0]] * p.confidence[pairs[:, 1]]
    weight = jnp.where(chosen, weight / tim_bounds(p.noise_bound, pairs) ** 2, 0)
    return correlation(weight, tims(p.src, pairs), tims(p.dst, pairs))


@jax.jit  # traced once, not by every stage
def usable_rows(problem: Problem) -> tuple[Problem, Int[Array, ""]]:
    """The problem with unusable rows masked and made harmless, and the count of non-finite rows.

    Values are replaced *before* anything is computed from them, so that neither results nor
    gradients of the other rows see a NaN.
    """
    finite = (
        jnp.all(jnp.isfinite(problem.src), axis=1)
        & jnp.all(jnp.isfinite(problem.dst), axis=1)
        & jnp.isfinite(problem.noise_bound)
        & jnp.isfinite(problem.confidence)
    )
    usable = problem.mask & finite & (problem.noise_bound > 0) & (problem.confidence > 0)
    # Without a truncation or a known scale that makes sense, no row can be used.
    cbar2, scale = problem.cbar2, problem.scale
    sensible = jnp.isfinite(cbar2) & (cbar2 > 0)
    if scale is not None:
        sensible &= jnp.isfinite(scale) & (scale > 0)
        scale = jnp.where(sensible, scale, 1)
    usable &= sensible
    cleaned = replace(
        problem,
        cbar2=jnp.where(sensible, cbar2, 1),
        scale=scale,
        src=jnp.where(usable[:, None], problem.src, 0),
        dst=jnp.where(usable[:, None], problem.dst, 0),
        noise_bound=jnp.where(usable, problem.noise_bound, 1),
        confidence=jnp.where(usable, problem.confidence, 0),
        mask=usable,
    )
    return cleaned, jnp.sum(problem.mask & ~finite, dtype=jnp.int32)
