"""Where the time goes: the stages of ``register`` one by one, each timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from teaser_jax.ground.checks import whole_number
from teaser_jax.packing import pack_problem
from teaser_jax.problem import finite_rows, is_traced, pad_problem
from teaser_jax.register import (
    INSIDE_JIT,
    Registration,
    between,
    buckets,
    centre,
    check_settings,
    concluded,
    device_clique,
    edge_dtype,
    host_problem,
    registration_of,
)  # fmt: skip
from teaser_jax.solve import (
    Graph,
    find_edges,
    find_inliers,
    find_rotation,
    find_scale,
    find_translation,
    usable_rows,
)  # fmt: skip
from teaser_jax.stages.trust import judge
from teaser_jax.types import Pose, Problem, Settings


@dataclass(frozen=True)
class Profile:
    """Seconds of each stage, first call (compilation included) and warm, and the answer.

    Attributes:
        cold, warm: Stage name to seconds; warm is the median of the repeats.
        result: What ``register`` returns.
    """

    cold: dict[str, float]
    warm: dict[str, float]
    result: Registration

    def __str__(self) -> str:
        rows = [f"  {'stage':<24}{'first call':>12}{'warm':>12}"]
        rows += [
            f"  {name:<24}{1e3 * self.cold[name]:>9.2f} ms{1e3 * seconds:>9.2f} ms"
            for name, seconds in self.warm.items()
        ]
        total = (
            f"  {'total':<24}{1e3 * sum(self.cold.values()):>9.2f} ms{1e3 * sum(self.warm.values()):>9.2f} ms"
        )
        return "\n".join([*rows, total])


def profile(
    src: Any, dst: Any, *, settings: Settings = Settings(), repeats: int = 5, **known: Any
) -> Profile:
    """Run ``register`` stage by stage and time each, apart from and after compilation.

    Arguments are those of ``register``. Stages run as programs of their own, so their sum lies
    above the time of one ``register`` call, in which neighbours are fused.

    Raises:
        ValueError: As ``register``, and if ``repeats`` is below 1.
    """
    whole_number("repeats", repeats, 1, what="how often to time each stage after its first call")
    check_settings(settings)
    if is_traced(src, dst, settings, known):
        raise ValueError(INSIDE_JIT.replace("register", "profile"))
    problem = host_problem(src, dst, **known)
    cold: dict[str, float] = {}
    warm: dict[str, list[float]] = {}

    def timed(name: str, run: Callable[..., Any], *inputs: Any) -> Any:
        for repeat in range(repeats + 1):
            start = time.perf_counter()
            output = jax.block_until_ready(run(*inputs))
            seconds = time.perf_counter() - start
            cold[name] = seconds if repeat == 0 else cold[name]
            if repeat > 0:
                warm.setdefault(name, []).append(seconds)
        return output

    usable = finite_rows(problem.src, problem.dst, problem.mask)
    centred, origins = timed("centre", centre, problem, usable)
    padded = pad_problem(centred, *buckets(centred))
    with jax.enable_x64(True):
        scale, scale_pairs = timed("scale", _find_scale, padded, settings)
        dtype = edge_dtype(centred, usable)
        edges = timed("consistency graph", lambda *x: _find_edges(*x, dtype=dtype), padded, scale)
        graph = Graph(scale, scale_pairs, edges)
        found = timed("clique, device", _device_clique, padded, graph, settings)
        clique = timed("clique, host", between, padded, graph, found, found.proved, settings)
        turn = find_rotation if settings.rotation == "sdp" else _find_rotation  # a solver on the host
        turned = timed("rotation", turn, padded, scale, clique.members, settings)
        cascade, _ = timed(
            "translation", _find_translation, padded, scale, clique.members, turned.rotation, settings
        )
        inliers = clique.members
        if settings.refine:
            inliers, _ = timed("refinement", _find_inliers, padded, cascade, settings)
        timed("verdict", _judge, padded, cascade, inliers, clique.members, edges)
        sent = pack_problem(centred, settings, *buckets(centred))
        solution = concluded(sent, graph, clique, settings)
    medians = {name: float(np.median(seconds)) for name, seconds in warm.items()}
    return Profile(cold, medians, registration_of(solution, problem, origins))


@jax.jit
def _judge(problem: Problem, pose: Pose, inliers: Array, clique: Array, edge_bits: Array) -> Array:
    settled = jnp.ones((), bool)
    return judge(usable_rows(problem)[0], pose, inliers, clique, edge_bits, converged=settled)


_find_scale, _find_edges, _find_rotation, _find_translation, _find_inliers, _device_clique = (
    jax.jit(f, static_argnames="dtype" if f is find_edges else ())
    for f in (find_scale, find_edges, find_rotation, find_translation, find_inliers, device_clique)
)
