"""The front door: one call outside jit, numpy in and out, float64 throughout."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import jax
import numpy as np
from jaxtyping import Bool

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import compile_ahead
from teaser_jax.certify.pose import certify as certify_pose
from teaser_jax.diagnosis import advice
from teaser_jax.engine.compiler import is_out_of_memory
from teaser_jax.engine.single import solve_one
from teaser_jax.engine.sizes import padded_size
from teaser_jax.ground.arrays import inside_jit, is_traced
from teaser_jax.ground.checks import whole_number
from teaser_jax.pose import Pose
from teaser_jax.problem import Problem, host_problem
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solution import Solution, Status
from teaser_jax.stages.clique.exact import ExactClique, load_kernels
from teaser_jax.summary import summary

INSIDE_JIT = (
    "{} was called inside jit, vmap or grad. It runs on the host: use "
    "teaser_jax.solve(teaser_jax.make_problem(...)) there."
)


@dataclass(frozen=True, eq=False, repr=False)
class Registration:
    """The answer of ``register``: host values in float64, in the input's frames and order.

    Attributes:
        pose: ``T_dst_src``.
        inliers: (n,) matches that the pose explains.
        status: What happened, as a number that programs can ask for.
        solution: Pose, status and the sets behind them, as a pytree of numpy arrays.
        problem: What was asked, as read: ``certify`` and ``refit`` take it with the solution.
    """

    pose: Pose
    inliers: Bool[np.ndarray, " n"]
    status: Status
    solution: Solution
    problem: Problem

    @classmethod
    def of(cls, problem: Problem, solution: Solution) -> Registration:
        """Make the answer to a problem, with copies of what was asked.

        A certificate may be asked for later, when the caller's arrays hold something else.
        """
        kept = jax.tree.map(np.array, problem)
        return cls(solution.pose, solution.inliers, Status(int(solution.status)), solution, kept)

    @cached_property
    def certificate(self) -> Certificate:
        """What is proved of the rotation, given the clique and the inliers; computed when first asked for.

        ``certify(result, ...)`` has more choices. It never turns ``ok`` true.
        """
        return certify_pose(self.problem, self.solution)

    @cached_property
    def advice(self) -> str:
        """What happened and what to try, in sentences.

        Where the answer is not ok, causes that the numbers show come first: a bound larger than the scene,
        or another scale at which the matches agree, for which the problem is solved once more.
        """
        return advice(self.problem, self.solution)

    @property
    def has_certificate(self) -> bool:
        """Whether the certificate is there already, so that asking for it costs nothing."""
        return "certificate" in self.__dict__  # where cached_property keeps it

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
    its configuration. Sizes are padded to a few, so a stream of different sizes compiles
    few programs.

    Args:
        src, dst: (n, 3) points, row i with row i; anything with ``__array__`` or ``__dlpack__``, clouds of
            Open3D, structured arrays with x, y, z.
        noise_bound: Largest error of a right match, one number or (n,) [unit of dst].
        scale: Known scale [-], or None: estimate it.
        cbar2: Truncation of the cost, c-bar squared [-].
        mask: (n,) rows to use.
        confidence: (n,) weights of the matches in the final fit; 0 equals masked.
        pairs: (m, 2) rows to compare with one another (not correspondences), or a ``networkx.Graph``; None:
            all.
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
        raise ValueError(INSIDE_JIT.format("register"))
    problem = host_problem(
        src, dst, noise_bound=noise_bound, scale=scale, cbar2=cbar2, mask=mask,
        confidence=confidence, pairs=pairs,
    )  # fmt: skip
    try:
        solution = solve_one(problem, settings)
    except (ValueError, TypeError, jax.errors.TracerArrayConversionError) as error:
        if not inside_jit():  # where even constants are tracers
            raise
        raise ValueError(INSIDE_JIT.format("register")) from error
    except (jax.errors.JaxRuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        raise MemoryError(
            f"{len(problem.src)} matches need more memory than there is (n^2 bits for the graph; "
            "n^2 numbers where the scale is voted by consensus): give fewer, the best ones first"
        ) from error
    result = Registration.of(problem, solution)
    if certify:
        _ = result.certificate  # computed here, and kept
    return result


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
    sizes = sorted({padded_size(n) for n in range(1, max_points + 1)})
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], float)
    for size in sizes:
        # Five right matches and nothing else: the programs are the same, and soon done.
        points = np.zeros((size, 3))
        points[:5] = corners
        mask = np.arange(size) < 5
        register(points, points, noise_bound=0.1, scale=scale, mask=mask, settings=settings)
    if isinstance(settings.clique, ExactClique):
        load_kernels()
    if certify:
        compile_ahead(max_points)
    return sizes
