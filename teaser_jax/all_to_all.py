"""The door for points without matches: every point of one cloud may be any point of the other.

Of n m matches all but a few are wrong, and the clique finds them all the same (section XI-C). Matches that
share a point exclude each other, so no clique has more matches than the smaller cloud has points: a clique of
all of them is proved at once. Things that are symmetric fit in several poses: these are looked for, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.agreement import Graph, prepare
from teaser_jax.engine.frames import centred_one, with_origins, without_padding
from teaser_jax.engine.packing import pack_problem, unpack_problem
from teaser_jax.engine.sizes import size_of
from teaser_jax.ground.arrays import inside_jit, is_traced
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, clean, host_problem
from teaser_jax.profile import Stopwatch
from teaser_jax.reading import point_rows, positive_number
from teaser_jax.refit import widened
from teaser_jax.register import INSIDE_JIT, Registration
from teaser_jax.rows import in_rows
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solution import Solution, Status
from teaser_jax.solve import conclude, find_inliers
from teaser_jax.stages.assignment import least_cost_pairs
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.exact import ExactClique
from teaser_jax.stages.clique.maximum import finish_on_host, search_on_device
from teaser_jax.stages.consistency import consistency_graph
from teaser_jax.stages.one_to_one import OneToOne
from teaser_jax.stages.refinement import Refinement, fit_similarity, squared_residuals
from teaser_jax.stages.rivals.congruent import is_same, other_poses
from teaser_jax.summary import summary

MOST_MATCHES = 1 << 16  # their graph takes half a gigabyte, and its search twice as much
OTHERS = 2  # other poses that are looked at: the first clique may be mirrored, and then one is the answer
# A rival that explains so large a share of the pairs could be the answer: which one explains a few more is
# a matter of which points both clouds happen to hold.
SHARE_OF_RIVAL = 0.8
SETTINGS = Settings(clique=ExactClique(seconds=20.0))
NO_CONSENSUS = (
    "No pose explains more points than chance does: check that both clouds hold the same points, at least in "
    "part, that noise_bound is in the unit of the target, and that scale is right."
)


class Rival(NamedTuple):
    """Another answer.

    Attributes:
        pose: ``T_dst_src``.
        explained: Pairs that it explains, each point once.
    """

    pose: Pose
    explained: int


@dataclass(frozen=True, eq=False, repr=False)
class AllToAll(Registration):
    """The answer of ``all_to_all``: that of ``register`` to all matches, and which point is which.

    Matches are all pairs of a source point and a target point that can be used, the source first. Inliers
    have each point once.

    Attributes:
        pairs: Rows (i, j): source point i is target point j, in the order of the source.
        rivals: Other poses that were found, and how many pairs each explains.
        seconds: What the work took, by stage; compiling counts [s].
    """

    pairs: Int[np.ndarray, "k 2"]
    rivals: tuple[Rival, ...]
    seconds: dict[str, float]

    @property
    def T_dst_src(self) -> Float[np.ndarray, "4 4"]:
        """The pose as a matrix."""
        return np.asarray(self.pose.matrix, np.float64)

    @cached_property
    def advice(self) -> str:
        """What happened and what to try, in sentences."""
        return NO_CONSENSUS if self.status == Status.NO_CONSENSUS else self.status.advice

    def __repr__(self) -> str:
        first, *rest = summary(self).split("\n")
        rivals = ", ".join(f"{x.explained} pairs" for x in self.rivals) or "none found"
        return "\n".join([first, f"  rivals       {rivals}", *rest])


def all_to_all(
    src: Any, dst: Any, *, noise_bound: Any, scale: Any = 1.0, settings: Settings = SETTINGS
) -> AllToAll:
    """Register two clouds of few points without matches and without descriptors: all pairs are tried.

    Both clouds have to hold the same points, at least in part: corners, holes, centres of things, points that
    were thinned before one of them was moved. Points that two sensors drew from one surface are not the same:
    ``register_clouds`` is for those. Time and memory grow with the square of n m: a hundred points a side
    take half a second, two hundred ten seconds and a gigabyte, and up to thirty where both clouds hold points
    that the other lacks. Points that are not finite are left out, and of equal ones all but one.

    ``ok`` wants what it wants of ``register``, and that no other pose explains four fifths as many points:
    otherwise the status is ``AMBIGUOUS``.

    Args:
        src, dst: (n, 3) and (m, 3) points, in any order; as for ``register``.
        noise_bound: Largest error of a right pair, one number [unit of dst].
        scale: Known scale [-].
        settings: How to solve; the clique is searched for 20 s at most.

    Returns:
        An ``AllToAll``, which is a ``Registration``; act upon it only where ``ok``.

    Raises:
        ValueError: Bad input, more than 65 536 matches, or settings without a clique; also when called under
            jit.

    References: section XI-C, Fig. 7.
    """
    check_settings(settings)
    if is_traced(src, dst, noise_bound, scale, settings) or inside_jit():
        raise ValueError(INSIDE_JIT.format("all_to_all"))
    if not settings.clique.prunes:
        raise ValueError(
            "all_to_all is nothing without a clique: give settings with another one than 'none'."
        )
    if scale is None:
        raise ValueError(
            "all_to_all needs a known scale: nearly all matches are wrong, and they outvote the right one."
        )
    (a, i), (b, j) = (_usable(x, name) for x, name in ((src, "src"), (dst, "dst")))
    n, m = len(i), len(j)
    if n * m > MOST_MATCHES:
        raise ValueError(
            f"{n} and {m} points make {n * m} matches: expected {MOST_MATCHES} at most. Give fewer points, "
            "or use register_clouds."
        )
    source, target = np.divmod(np.arange(n * m), m)
    bound = positive_number(noise_bound, "noise_bound")
    problem = host_problem(a[source], b[target], noise_bound=bound, scale=scale)
    solutions, seconds = _find(problem, (n, m), settings)
    best = max(solutions, key=lambda x: (int(x.inliers.sum()), x.status == Status.OK))
    rows = np.flatnonzero(best.inliers)
    rivals = tuple(_rivals(best, solutions, problem.src[rows], float(bound)))
    if best.status == Status.OK and any(x.explained >= SHARE_OF_RIVAL * len(rows) for x in rivals):
        best = replace(best, status=np.int32(Status.AMBIGUOUS))
    one = Registration.of(problem, best)
    pairs = np.stack([i[source[rows]], j[target[rows]]], axis=1)
    return AllToAll(
        one.pose,
        one.inliers,
        one.status,
        one.solution,
        one.problem,
        pairs=pairs,
        rivals=rivals,
        seconds=seconds,
    )


def _rivals(
    best: Solution, solutions: list[Solution], points: Float[np.ndarray, "k 3"], bound: float
) -> list[Rival]:
    """List the solutions that bring the points of the best one elsewhere."""
    there = best.pose.apply(points)
    return [
        Rival(x.pose, int(x.inliers.sum()))
        for x in solutions
        if x.inliers.any() and not is_same(x.pose.apply(points), there, bound)
    ]


def _usable(points: Any, name: str) -> tuple[Float[np.ndarray, "n 3"], Int[np.ndarray, " n"]]:
    """Read points, and find those that can be used: finite, and of equal ones the first."""
    points = np.asarray(point_rows(points, name))
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(finite):
        raise ValueError(f"{name} has no finite point.")
    rows = finite[np.sort(np.unique(points[finite], axis=0, return_index=True)[1])]
    return points[rows], rows


def _find(
    problem: Problem, shape: tuple[int, int], settings: Settings
) -> tuple[list[Solution], dict[str, float]]:
    """Find the answers to all matches of two clouds of so many points, and what each stage took [s]."""
    on_host = {"centre", "clique, host", "rivals", "refinement"}
    on_host |= {"rotation"} if settings.rotation.needs_host else set()
    timed = Stopwatch(0, frozenset(on_host))
    near = timed("centre", centred_one, pack_problem(problem, settings, size_of(problem)))
    with as_on_the_host():
        p, excluded = timed("clean", clean, unpack_problem(near.sent))
        graph = prepare(p, settings, edge_dtype=near.edge_dtype, edges=_apart, run=timed)
        order = np.asarray(graph.rows.order)
        refinement = partial(_refined, order=order, shape=shape)
        clique = _largest(graph, settings, min(shape), timed)
        answer = partial(
            conclude, p, excluded, graph,
            settings=settings, offset=near.sent.offset, refinement=refinement, run=timed,
        )  # fmt: skip
        found = [jax.device_get(answer(clique))]
        if found[0].status in (Status.OK, Status.MIRRORED):
            near_rows = widened(in_rows(p, graph.rows), graph.widening)
            for pose in timed("rivals", _others, p, graph, clique, order, shape):
                members, _ = refinement(near_rows, pose, Refinement())
                found.append(jax.device_get(answer(Clique(members, clique.upper_bound))))
    return [with_origins(without_padding(x, problem), near.origins) for x in found], timed.cold


def _others(
    p: Problem, graph: Graph, clique: Clique, order: Int[np.ndarray, " n"], shape: tuple[int, int]
) -> list[Pose]:
    """Find poses beside the one of a clique that explain much of what it does, or of which it is a mirror."""
    src, dst = (np.asarray(x) for x in (p.src, p.dst))
    n, m = shape
    scale = jnp.asarray(p.scale)
    a, b = float(scale) * src[: n * m : m], dst[:m]
    source, target = np.divmod(np.sort(order[np.flatnonzero(clique.members)]), m)
    bound = float(jnp.sqrt(p.cbar2) * graph.widening * p.noise_bound[0])
    others = other_poses(a, b, np.stack([source, target], axis=1), noise_bound=bound)
    return [replace(x.pose, scale=scale) for x in others[:OTHERS]]


def _apart(p: Problem, scale: Float[Array, ""]) -> OneToOne:
    """Find who agrees with whom at a scale: matches of one point do not."""
    edges = consistency_graph(
        p.src, p.dst, p.noise_bound, p.mask, scale=scale, cbar2=p.cbar2, one_to_one=True
    )  # fmt: skip
    return OneToOne(edges, jnp.zeros(p.mask.shape, jnp.float32))


def _largest(graph: Graph, settings: Settings, most: int, timed: Stopwatch) -> Clique:
    """Find the largest clique; it has each point once, so that no clique has more than ``most`` matches.

    A method that searches on the host does so at once: what the device would do before proves nothing here.
    """
    method, nothing = settings.clique, Clique(np.zeros(graph.mask.shape, bool), np.int32(most))
    if method.needs_host:
        return timed("clique, host", finish_on_host, method, graph.edge_bits, graph.mask, nothing)
    found = timed("clique, device", search_on_device, method, graph.edge_bits, graph.mask)
    return Clique(np.asarray(found.members), np.minimum(found.upper_bound, np.int32(most)))


_find_inliers = jax.jit(find_inliers)


@jax.jit
def _residuals(p: Problem, inliers: Bool[Array, " n"]) -> Float[Array, " n"]:
    """Fit the pose to inliers, and compute the squared residuals of all matches."""
    weights = jnp.where(inliers, p.confidence / p.noise_bound**2, 0)
    pose = fit_similarity(p.src, p.dst, weights, p.scale).pose
    return squared_residuals(pose, p.src, p.dst, p.noise_bound)


def _refined(
    p: Problem, start: Pose, refinement: Refinement, *, order: Int[np.ndarray, " n"], shape: tuple[int, int]
) -> tuple[Bool[np.ndarray, " n"], bool]:
    """Find the inliers where the joint cost (6) of pairs stops falling that have each point once.

    Pairs are chosen for a pose, and a pose is fitted to pairs, in turns; each lowers the cost. Rows are
    those of the method; ``order`` tells the match of each.
    """
    inliers, settled = _find_inliers(p, start, refinement)
    rows = np.flatnonzero(np.asarray(p.mask))
    place = np.full(shape, -1)
    place.ravel()[order[rows]] = rows
    for _ in range(refinement.iterations):
        r2 = np.asarray(_residuals(p, inliers))
        table = np.where(place >= 0, r2[place], np.inf)
        pairs = least_cost_pairs(table, float(p.cbar2))
        chosen = np.zeros(len(r2), bool)
        chosen[place[pairs[:, 0], pairs[:, 1]]] = True
        if np.array_equal(chosen, inliers):
            return chosen, bool(settled)
        inliers = chosen
    return np.asarray(inliers), False
