"""Where the time goes: the stages of ``register`` one by one, each timed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import numpy as np

from teaser_jax.agreement import prepare
from teaser_jax.engine.frames import centred_one, with_origins, without_padding
from teaser_jax.engine.packing import pack_problem, unpack_problem
from teaser_jax.engine.sizes import size_of
from teaser_jax.ground.arrays import is_traced
from teaser_jax.ground.checks import whole_number
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.problem import clean, host_problem
from teaser_jax.register import INSIDE_JIT, Registration
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solve import conclude
from teaser_jax.stages.clique.maximum import finish_on_host, search_on_device


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

    Stages run as programs of their own, so their sum lies above the time of one ``register`` call, in which
    neighbours are fused.

    Args:
        src, dst: (n, 3) matched points, row i with row i [length].
        settings: How to solve.
        repeats: How often each stage runs after its first call.
        known: The other arguments of ``register``: ``noise_bound`` [length], ``scale``, ...

    Returns:
        Seconds of each stage, and the answer.

    Raises:
        ValueError: As ``register``, and if ``repeats`` is below 1.
    """
    whole_number("repeats", repeats, 1, what="how often to time each stage after its first call")
    check_settings(settings)
    if is_traced(src, dst, settings, known):
        raise ValueError(INSIDE_JIT.format("profile"))
    problem = host_problem(src, dst, **known)
    on_host = {"centre", "clique, host"} | ({"rotation"} if settings.rotation.needs_host else set())
    timed = Stopwatch(repeats, frozenset(on_host))
    near = timed("centre", centred_one, pack_problem(problem, settings, size_of(problem)))
    with as_on_the_host():
        p, excluded = timed("clean", clean, unpack_problem(near.sent))
        graph = prepare(p, settings, edge_dtype=near.edge_dtype, run=timed)
        found = timed("clique, device", search_on_device, settings.clique, graph.edge_bits, graph.mask)
        clique = timed("clique, host", finish_on_host, settings.clique, graph.edge_bits, graph.mask, found)
        found = conclude(p, excluded, graph, clique, settings, offset=near.sent.offset, run=timed)
        solution = jax.device_get(found)
    solution = with_origins(without_padding(solution, problem), near.origins)
    medians = {name: float(np.median(seconds)) for name, seconds in timed.warm.items()}
    return Profile(timed.cold, medians, Registration.of(problem, solution))


@dataclass(frozen=True)
class Stopwatch:
    """Runs stages, each compiled by itself and some times over, and notes their seconds."""

    repeats: int
    on_host: frozenset[str]  # names of the stages that are not compiled
    cold: dict[str, float] = field(default_factory=dict)
    warm: dict[str, list[float]] = field(default_factory=dict)

    def __call__(self, name: str, stage: Callable[..., Any], *inputs: Any, **choices: Any) -> Any:
        """Run a stage, note its seconds, and return its output."""
        run = stage if name in self.on_host else _compiled(stage, tuple(choices))
        for repeat in range(self.repeats + 1):
            start = time.perf_counter()
            output = jax.block_until_ready(run(*inputs, **choices))
            seconds = time.perf_counter() - start
            if repeat == 0:  # added up, for those who run a stage more than once
                self.cold[name] = self.cold.get(name, 0.0) + seconds
            else:
                self.warm.setdefault(name, []).append(seconds)
        return output


@lru_cache(maxsize=64)
def _compiled(stage: Callable[..., Any], choices: tuple[str, ...]) -> Callable[..., Any]:
    """Turn a stage into a program of its own; what it is asked to choose is static."""
    return jax.jit(stage, static_argnames=choices)
