"""The front door: one call outside jit, numpy in and out, float64 throughout."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from teaser_jax import so3
from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import compile_ahead
from teaser_jax.certify.pose import MAX_TRACED
from teaser_jax.certify.pose import certify as certify_pose
from teaser_jax.ground.checks import whole_number
from teaser_jax.compilation import OLDER_EMITTERS, WHOLE_SUMS, WIDE_VECTORS
from teaser_jax.packing import (
    PackedProblem,
    PackedSolution,
    choices_of,
    fetched,
    pack_problem,
    pack_solution,
    unpack_problem,
    unpack_solution,
)  # fmt: skip
from teaser_jax.problem import extent, finite_rows, is_traced, read_problem
from teaser_jax.solve import Graph, conclude, prepare, usable_rows
from teaser_jax.stages.clique import Clique, clique_on_device, search_on_host
from teaser_jax.stages.clique_search import load_kernels
from teaser_jax.stages.consistency import rounding
from teaser_jax.stages.invariants import words
from teaser_jax.summary import summary
from teaser_jax.types import Pose, Problem, Settings, Solution, Status

SMALLEST_BUCKET = 32
INSIDE_JIT = (
    "register was called inside jit, vmap or grad. It runs on the host: use "
    "teaser_jax.solve(teaser_jax.make_problem(...)) there."
)


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """The answer of ``register``: host values in float64, in the input's frames and order.

    Attributes:
        pose: ``T_dst_src``.
        inliers: (n,) matches that the pose explains.
        status: What happened; ``status.advice`` says what to try.
        solution: The same as a pytree of numpy arrays, with the sets behind the pose.
        problem: What was asked, as read: ``certify`` and ``refit`` take it with the solution.
    """

    pose: Pose
    inliers: np.ndarray
    status: Status
    solution: Solution
    problem: Problem

    @cached_property
    def certificate(self) -> Certificate:
        """What is proved of the rotation, given the clique and the inliers; computed when first asked for.

        ``certify(result.problem, result.solution, ...)`` has more choices. It never turns ``ok`` true.
        """
        return certify_pose(self.problem, self.solution)

    @property
    def has_certificate(self) -> bool:
        """Whether the certificate is there already; to read ``certificate`` computes it."""
        return "certificate" in vars(self)

    @property
    def ok(self) -> bool:
        """Whether to trust the pose."""
        return self.status == Status.OK

    def __bool__(self) -> bool:
        return self.ok

    def __repr__(self) -> str:
        return summary(self)


def register(
    src: Any,
    dst: Any,
    *,
    noise_bound: Any,
    scale: Any = 1.0,
    cbar2: Any = 1.0,
    mask: Any = None,
    confidence: Any = None,
    pairs: Any = None,
    settings: Settings = Settings(),
    certify: bool = False,
) -> Registration:
    """Register matched points, most of which may be wrong: ``dst_i ~ s R src_i + t``.

    Centres both clouds in float64 and solves in float64 whatever JAX is set to, without touching
    its configuration. Sizes are padded to a few buckets, so a stream of different sizes compiles
    few programs.

    Args:
        src, dst: (n, 3) points, row i with row i; anything with ``__array__`` or ``__dlpack__``.
        noise_bound: Largest error of a right match, one number or (n,) [unit of the points].
        scale: Known scale [-], or None: estimate it.
        cbar2: Truncation of the cost, c-bar squared [-].
        mask: (n,) rows to use.
        confidence: (n,) weights of the matches in the final fit; 0 equals masked.
        pairs: (m, 2) index pairs to compare, or a ``networkx.Graph``; None: all.
        settings: How to solve.
        certify: Compute ``result.certificate`` at once, for the summary to tell.

    Returns:
        A ``Registration``; act upon it only where ``ok``.

    Raises:
        ValueError: Bad input, with what was received and what to do; also when called under jit,
            where ``solve`` is the function to use.
        MemoryError: More matches than there is memory for.
    """
    check_settings(settings)
    if is_traced(src, dst, noise_bound, scale, cbar2, mask, confidence, pairs, settings):
        raise ValueError(INSIDE_JIT)
    problem = host_problem(
        src, dst, noise_bound=noise_bound, scale=scale, cbar2=cbar2, mask=mask,
        confidence=confidence, pairs=pairs,
    )  # fmt: skip
    usable = finite_rows(problem.src, problem.dst, problem.mask)
    centred, origins = centre(problem, usable)
    try:
        solution = _solved(centred, settings, edge_dtype(centred, usable))
    except jax.errors.TracerArrayConversionError as error:  # constants inside somebody's jit
        raise ValueError(INSIDE_JIT) from error
    except ValueError as error:
        if "compiler_options" not in str(error):  # which JAX takes at the top level only
            raise
        raise ValueError(INSIDE_JIT) from error
    except jax.errors.JaxRuntimeError as error:
        if "memory" not in str(error).lower() and "RESOURCE_EXHAUSTED" not in str(error):
            raise
        raise MemoryError(
            f"{len(problem.src)} matches need more memory than there is (n^2 bits for the graph; "
            "n^2 numbers where the scale is voted by consensus): give fewer, the best ones first"
        ) from error
    result = registration_of(solution, problem, origins)
    if certify:
        _ = result.certificate  # computed here, and kept
    return result


def _solved(problem: Problem, settings: Settings, dtype: type) -> Solution:
    """Device, host, device; edges are tested in ``dtype``."""
    sent = pack_problem(problem, settings, *buckets(problem))
    with jax.enable_x64(True):
        graph, found, proved = before_clique(sent, choices_of(settings), dtype)
        clique = between(sent, graph, found, proved, settings)
        return concluded(sent, graph, clique, settings)


def warmup(
    max_points: int,
    *,
    scale: float | None = 1.0,
    settings: Settings = Settings(),
    certify: bool = False,
) -> list[int]:
    """Compile ahead whatever ``register`` needs for up to so many matches; two to four seconds a size.

    With ``jax.config.update("jax_compilation_cache_dir", ...)`` the next process finds the programs
    on disk and needs less than a second a size.

    Args:
        max_points: The largest number of matches to come.
        scale: None if the scale will be estimated; otherwise any number.
        settings: Those of the calls to come.
        certify: Whether certificates of up to 128 measurements will be asked for: some 25 seconds more.

    Returns:
        The sizes that now stand ready: matches are padded to the next one.

    Raises:
        ValueError: If ``max_points`` is below 1, or the settings make no sense.
    """
    whole_number("max_points", max_points, 1, what="the largest number of matches to come")
    sizes = sorted({bucket(n) for n in range(1, max_points + 1)})
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)
    for size in sizes:
        # Five right matches and nothing else: the programs are the same, and soon done.
        points = np.zeros((size, 3))
        points[:5] = corners
        mask = np.arange(size) < 5
        register(points, points, noise_bound=0.1, scale=scale, mask=mask, settings=settings)
    if settings.clique == "exact":
        load_kernels()
    if certify:
        compile_ahead(min(max_points, MAX_TRACED))
    return sizes


def check_settings(settings: Settings) -> None:
    """What ``Settings`` cannot check itself, because JAX rebuilds it with placeholders for numbers."""
    if not isinstance(settings, Settings):
        raise ValueError(f"settings is {settings!r}: expected teaser_jax.Settings(...).")
    if is_traced(settings):
        return
    low, high = settings.scale_range if len(settings.scale_range) == 2 else (None, None)
    numbers = {
        "gnc_factor": (settings.gnc_factor, lambda x: 1 < x < np.inf, "a number above 1"),
        "gnc_tolerance": (settings.gnc_tolerance, lambda x: 0 <= x < np.inf, "0 or a number above"),
        "scale_range": (low, lambda x: 0 <= x < float(high), "(low, high) with 0 <= low < high"),
    }
    for name, (value, good, expected) in numbers.items():
        try:
            fine = good(float(value))
        except (TypeError, ValueError):
            fine = False
        if not fine:
            raise ValueError(f"Settings.{name} is {getattr(settings, name)!r}: expected {expected}.")


def host_problem(src: Any, dst: Any, **known: Any) -> Problem:
    """``make_problem`` in float64 numpy, from anything that can be read on the host: for ``solve_batch``.

    Args:
        src, dst: (n, 3) matched points, row i with row i [length].
        known: The other arguments of ``make_problem``: ``noise_bound`` [length], ``scale``, ``cbar2``,
            ``mask``, ``confidence``, ``pairs``.

    Raises:
        ValueError: As ``make_problem``; inside jit, where ``make_problem`` is the function to use.
    """
    if is_traced(src, dst, known):
        raise ValueError("host_problem reads numbers on the host: inside jit use make_problem.")
    return read_problem(src, dst, dtype=np.dtype(np.float64), **known)


def centre(problem: Problem, usable: np.ndarray | slice) -> tuple[Problem, tuple[np.ndarray, np.ndarray]]:
    """The problem about the middle of its usable points, and the two origins taken away.

    The median is meant: one absurd coordinate must not move the origin far from the rest.
    """
    src, dst = problem.src[usable], problem.dst[usable]
    if not len(src):
        return problem, (np.zeros(3), np.zeros(3))
    origins = median(src), median(dst)
    return replace(problem, src=problem.src - origins[0], dst=problem.dst - origins[1]), origins


def median(points: Any) -> np.ndarray:
    """Of each coordinate, the upper one of two: a third of the time of ``numpy.median``."""
    half = len(points) // 2
    return np.partition(np.ascontiguousarray(points.T), half, axis=1)[:, half]


def bucket(n: int) -> int:
    """The padded size: powers of two up to 1024, then steps of 512 up to 2048, then of 1024.

    Eight programs serve all sizes from 300 to 6000, and padding costs a fifth of the time there.
    """
    if n <= 1024:
        return max(SMALLEST_BUCKET, 1 << (n - 1).bit_length())
    step = 512 if n <= 2048 else 1024
    return -(-n // step) * step


def buckets(problem: Problem) -> tuple[int, int | None]:
    """The padded sizes of its matches and of its pairs, if they are given."""
    m = None if problem.pairs is None else bucket(problem.pairs.shape[0])
    return bucket(problem.src.shape[0]), m


def edge_dtype(problem: Problem, usable: np.ndarray | slice) -> type:
    """float32 where that widens no edge test by more than a thousandth of the bound: twice as fast.

    The problem is centred. No edge is lost in either precision; a few more may be added.
    """
    src, dst = problem.src[usable], problem.dst[usable]
    if problem.scale is None or not len(src):
        return np.float64
    reach = np.sqrt(3) * (problem.scale * extent(src) + extent(dst))
    bound = np.sqrt(problem.cbar2) * problem.noise_bound[usable].min()
    return np.float32 if float32_will_do(reach, bound) else np.float64


def float32_will_do(reach: Any, bound: Any) -> Any:
    """Whether rounding of points that reach so far widens a bound by a thousandth at most."""
    in_range = (bound > 1e-6) & (reach < 1e6)  # their fourth powers are compared
    return in_range & (rounding(np.float32, reach) <= 1e-3 * bound)


def until_clique(sent: PackedProblem, choices: Settings, dtype: type) -> tuple[Graph, Clique, Array]:
    """Device program one: scale, graph, and the clique as far as the device takes it; is it proved?"""
    problem, settings = unpack_problem(sent, choices)
    graph = prepare(problem, settings, edge_dtype=dtype)
    found = device_clique(problem, graph, settings)
    return graph, found, found.proved


def device_clique(problem: Problem, graph: Graph, settings: Settings) -> Clique:
    """The clique as far as the device takes it, with its bound."""
    return clique_on_device(graph.edge_bits, usable_rows(problem)[0].mask, method=settings.clique)


def between(
    problem: PackedProblem | Problem, graph: Graph, found: Clique, proved: Array, settings: Settings
) -> Clique:
    """The host's turn, between the two programs: nothing where the device has a proof."""
    if settings.clique in ("none", "greedy") or (settings.clique == "exact" and proved):
        return found
    return search_on_host(
        np.asarray(graph.edge_bits), np.asarray(problem.mask), found,
        method=settings.clique, nodes=settings.clique_nodes, seconds=settings.clique_seconds,
    )  # fmt: skip


def since_clique(
    sent: PackedProblem, graph: Graph, clique: Clique, choices: Settings, room: int | None = None
) -> PackedSolution:
    """Device program two: the sets, the pose, the verdict."""
    problem, settings = unpack_problem(sent, choices)
    return pack_solution(conclude(problem, graph, clique, settings, room=room))


before_clique = jax.jit(until_clique, static_argnames="dtype", compiler_options=WHOLE_SUMS | WIDE_VECTORS)
after_clique = jax.jit(since_clique, compiler_options=WHOLE_SUMS | OLDER_EMITTERS)


def concluded(sent: PackedProblem, graph: Graph, clique: Clique, settings: Settings) -> Solution:
    """The last part, on the device; with a conic solver on the host, step by step."""
    if settings.rotation == "sdp":
        problem, settings = unpack_problem(sent, settings)
        return jax.device_get(conclude(problem, graph, clique, settings))
    return unpack_solution(fetched(after_clique(sent, graph, clique, choices_of(settings))))


def registration_of(
    solution: Solution, problem: Problem, origins: tuple[np.ndarray, np.ndarray]
) -> Registration:
    """The padded and centred solution, in the frames and rows of the user's problem."""
    solution = without_padding(with_origins(solution, *origins), problem)
    pose, selection = solution.pose, solution.selection
    # A certificate may be asked for later, when the caller's arrays hold something else.
    kept = jax.tree.map(np.array, problem)
    return Registration(pose, selection.inliers, Status(int(solution.status)), solution, kept)


def with_origins(solution: Solution, src_origin: np.ndarray, dst_origin: np.ndarray) -> Solution:
    """The solution of centred clouds (or of a stack of them) in the frames that these came from."""
    pose = solution.pose
    turned = so3.rotate(pose.rotation, src_origin[..., None, :])[..., 0, :]
    with np.errstate(over="ignore", invalid="ignore"):  # of points at the end of all numbers
        translation = dst_origin + pose.translation - pose.scale[..., None] * turned
    translation = np.where(np.isfinite(translation), translation, 0)
    return replace(solution, pose=Pose(pose.rotation, translation, np.asarray(pose.scale)))


def without_padding(solution: Solution, problem: Problem) -> Solution:
    """The solution in the rows of its problem, or of a stack of them; padding came last."""
    n = problem.src.shape[-2]
    m = n if problem.pairs is None else problem.pairs.shape[-2]
    chosen = solution.selection

    def cut(pair_set: Any) -> Any:
        if pair_set is None:
            return None
        if pair_set.dtype == np.uint32:  # the words of the first n stay as they are
            return pair_set[..., :n, : words(n)]
        return pair_set[..., :m]

    selection = replace(
        chosen,
        scale_pairs=cut(chosen.scale_pairs),
        clique=chosen.clique[..., :n],
        rotation=cut(chosen.rotation),
        translation=chosen.translation[..., :n, :],
        inliers=chosen.inliers[..., :n],
    )
    return replace(solution, selection=selection, inliers=selection.inliers)
