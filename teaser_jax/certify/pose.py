"""A certificate for the answer to a registration problem, and what the clique says of all poses."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, TypeVar, get_args

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool

from teaser_jax.certify.certificate import Certificate, CertificateStatus
from teaser_jax.certify.host import certify_on_host
from teaser_jax.certify.host_measurements import read_measurements
from teaser_jax.certify.options import MAX_MEASUREMENTS, TOLERANCE, CertifyMethod, Options, checked_options
from teaser_jax.certify.stack import certify_stack
from teaser_jax.certify.subject import About, subject_on_host, traced_subject
from teaser_jax.certify.traced import certify_traced
from teaser_jax.ground.arrays import AnyArray, is_traced, namespace
from teaser_jax.ground.checks import one_of
from teaser_jax.problem import Problem, clean
from teaser_jax.refit import as_judged
from teaser_jax.solution import Solution, problem_and_solution

MAX_TRACED = 128  # measurements under jit, where sizes are static

Records = TypeVar("Records")


def certify(
    problem: Problem | Any,
    solution: Solution | Any = None,
    *,
    about: About = "pose",
    tolerance: Any = TOLERANCE,
    iterations: int | np.integer | None = None,
    max_measurements: int | np.integer | None = None,
    method: CertifyMethod = "splitting",
) -> Certificate:
    """Prove how good the answer to a registration problem is, *given these measurements*.

    A certificate says that no rotation fits the chosen measurements better than it claims. It never
    says that the matches are right: where all are wrong, the best rotation is certified, too.

    Args:
        problem, solution: The answer of ``register`` alone, or a problem and what ``solve`` made of it;
            outside jit also stacks of them, where the closed form is tried on all at once and only what it
            leaves is iterated on.
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
        ValueError: If ``about`` is unknown, the two do not belong together, or under jit a stack is given.

    Gradients: none, inputs are stopped.

    References: section VIII-C; for the gaps Theorem 6.
    """
    one_of("about", about, get_args(About))
    one_of("method", method, get_args(CertifyMethod))
    problem, solution = problem_and_solution(problem, solution, "certify")
    traced = is_traced(problem, solution)
    if max_measurements is None:
        max_measurements = MAX_TRACED if traced else MAX_MEASUREMENTS
    options = checked_options(tolerance, iterations, method, max_measurements)
    if traced:
        return _traced(problem, solution, about, options)
    problem, solution = on_host((problem, solution))
    how = _on_host if np.ndim(solution.status) == 0 else _stack_on_host
    return how(problem, solution, about, options)


def _traced(problem: Problem, solution: Solution, about: About, options: Options) -> Certificate:
    """Certify one answer in the program that is being traced."""
    if np.ndim(solution.status) != 0:
        raise ValueError("the solution is a stack: inside jit use jax.vmap(certify).")
    problem, solution = lax.stop_gradient((problem, solution))
    p, _ = clean(problem)
    most = options.max_measurements
    subject, too_many = traced_subject(p, solution, about, most)
    found = certify_traced(
        subject.src, subject.dst, subject.rotation,
        noise_bound=subject.noise_bound, cbar2=problem.cbar2, mask=subject.mask,
        options=options, rounds=options.rounds(most),
    )  # fmt: skip
    return with_gaps(_nothing_proved_where(too_many, found), p, solution)


def _on_host(problem: Problem, solution: Solution, about: About, options: Options) -> Certificate:
    """Certify one answer outside jit."""
    subject = subject_on_host(problem, solution, about)
    measurements = read_measurements(
        subject.src, subject.dst, subject.noise_bound, problem.cbar2, subject.mask
    )
    rounds = options.rounds(measurements.measured)
    found = certify_on_host(measurements, subject.rotation, options, rounds=rounds)
    return with_gaps(found, problem, solution)


def _stack_on_host(problem: Problem, solution: Solution, about: About, options: Options) -> Certificate:
    """Certify a stack of answers outside jit."""
    count = len(solution.status)
    if np.ndim(problem.cbar2) != 1 or len(problem.cbar2) != count or count == 0:
        raise ValueError("problem and solution are not stacks of the same length.")
    items = [jax.tree.map(lambda x, i=i: x[i], (problem, solution)) for i in range(count)]
    subjects = [subject_on_host(p, s, about) for p, s in items]
    measurements = [
        read_measurements(subject.src, subject.dst, subject.noise_bound, p.cbar2, subject.mask)
        for subject, (p, _) in zip(subjects, items, strict=True)
    ]
    rotations = np.stack([subject.rotation for subject in subjects])
    rounds = options.rounds(max(m.measured for m in measurements))
    found = certify_stack(measurements, rotations, options, rounds=rounds)
    gaps = [with_gaps(found, p, s) for p, s in items]
    return replace(
        found,
        inlier_gap=np.array([g.inlier_gap for g in gaps]),
        explained_gap=np.array([g.explained_gap for g in gaps]),
    )


def on_host(records: Records) -> Records:
    """Fetch records to the host: numpy arrays in their place, numbers in float64."""

    def fetched(x: Any) -> np.ndarray:
        x = np.asarray(x)
        return x.astype(np.float64) if x.dtype.kind == "f" else x

    return jax.tree.map(fetched, records)


def _nothing_proved_where(too_many: Bool[Array, ""], found: Certificate) -> Certificate:
    """Take every claim of a certificate back where measurements were left out."""
    nothing = replace(
        found,
        lower_bound=jnp.zeros_like(found.lower_bound),
        suboptimality=jnp.ones_like(found.suboptimality),
        is_optimal=jnp.zeros_like(found.is_optimal),
        is_unique=jnp.zeros_like(found.is_unique),
        angle_bound=jnp.full_like(found.angle_bound, jnp.inf),
        status=jnp.full_like(found.status, CertificateStatus.TOO_LARGE),
    )
    return jax.tree.map(lambda a, b: jnp.where(too_many, a, b), nothing, found)


def with_gaps(found: Certificate, problem: Problem, solution: Solution) -> Certificate:
    """Add what the bound on the clique says of every pose: the inliers of any pose are a clique, too."""
    p = as_judged(problem, solution.selection)
    xp = namespace(p.src, solution.clique_upper_bound)
    most = xp.asarray(solution.clique_upper_bound)
    gap = most - xp.sum(solution.inliers & p.mask, dtype=most.dtype)
    unexplained = (xp.sum(_usable(p), dtype=most.dtype) - most).astype(p.cbar2.dtype) * p.cbar2
    explained_gap = (solution.cost - unexplained) / (xp.maximum(most, 1).astype(p.cbar2.dtype) * p.cbar2)
    return replace(found, inlier_gap=gap.astype(np.int32), explained_gap=explained_gap)


def _usable(p: Problem) -> Bool[AnyArray, " n"]:
    """Find the rows that the solver could use, on the host without JAX."""
    xp = namespace(p.src)
    numbers = xp.concatenate([p.src, p.dst, p.noise_bound[:, None], p.confidence[:, None]], axis=1)
    return p.mask & (p.noise_bound > 0) & (p.confidence > 0) & xp.all(xp.isfinite(numbers), axis=1)
