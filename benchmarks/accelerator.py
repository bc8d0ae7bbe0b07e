"""Many problems on a GPU: throughput beside the processor of the same machine, and the same answers."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.batch import one_by_one, right, seconds
from benchmarks.problems import protocol

# Matches, wrong matches, problems drawn, times that each is repeated, wanted [problems/s].
CELLS = (
    (50, 0.5, 1024, 64, None),
    (50, 0.9, 1024, 64, None),
    (100, 0.5, 1024, 64, 200_000),
    (100, 0.8, 1024, 64, 200_000),
    (100, 0.9, 1024, 64, 200_000),
    (1000, 0.95, 64, 32, None),
)
SIDE_BY_SIDE = 4096  # problems under jit(vmap(solve))


@jax.jit
@jax.vmap
def inside_jit(problem: tj.Problem) -> tj.Pose:
    """As in a training step."""
    return tj.solve(problem, tj.Settings(clique="greedy")).pose


def cell(n: int, rate: float, count: int, times: int, wanted: int | None, rounds: int) -> dict[str, Any]:
    """One size and share of wrong matches."""
    cases = list(protocol(n, rate, count))
    few = tj.stack_problems([tj.host_problem(c.src, c.dst, noise_bound=c.noise_bound) for c in cases])
    many = jax.tree.map(lambda x: np.concatenate([x] * times), few)
    here, there = (Mesh(np.array(jax.devices(kind)[:1]), ("x",)) for kind in ("cpu", jax.default_backend()))

    start = time.perf_counter()
    answers = tj.solve_batch(many, mesh=there)
    cold = time.perf_counter() - start
    on_cpu = tj.solve_batch(few, mesh=here)
    with jax.enable_x64(True):
        some = jax.device_put(jax.tree.map(lambda x: x[:SIDE_BY_SIDE], many))
        jax.block_until_ready(inside_jit(some))

        taken = seconds(
            {
                "there": lambda: tj.solve_batch(many, mesh=there),
                "here": lambda: tj.solve_batch(few, mesh=here),
                "vmap": lambda: jax.block_until_ready(inside_jit(some)),
            },
            rounds,
        )
    sizes = {"there": count * times, "here": count, "vmap": len(some.src)}

    repeated = jax.tree.map(lambda x: x.reshape(times, count, *x.shape[1:]), answers)
    first = jax.tree.map(lambda x: x[0], repeated)
    sets = [jax.tree.leaves(s.selection) for s in (first, on_cpu)]
    poses = [jax.tree.leaves(s.pose) for s in (first, on_cpu)]
    return {
        "cell": cases[0].cell,
        "batch": count * times,
        "wanted": wanted,
        "cold": cold,
        "rates": {name: sizes[name] / taken[name] for name in taken},
        "right": right(cases, one_by_one(first.pose)),
        "same_bits": all(np.all(x == x[:1]) for x in jax.tree.leaves(repeated)),
        "other_sets": int(
            sum(any(np.any(x[k] != y[k]) for x, y in zip(*sets, strict=True)) for k in range(count))
        ),
        "pose_difference": max(float(np.max(np.abs(x - y))) for x, y in zip(*poses, strict=True)),
    }


def run(quick: bool) -> list[dict]:
    """A row a cell; none where there is no accelerator."""
    if jax.default_backend() == "cpu":
        return []
    cells = CELLS[3:4] if quick else CELLS
    return [cell(*each, rounds=2 if quick else 7) for each in cells]


def metrics(rows: list[dict]) -> list[Metric]:
    """Throughput, and success."""
    found = []
    for r in rows:
        name, rates = r["cell"], r["rates"]
        found.append(Metric(f"{name}: batch", rates["there"], "problems/s", "higher", 0.4, portable=False))
        found.append(Metric(f"{name}: right", r["right"], "share", "higher", 0.01))
    return found


def report(rows: list[dict]) -> str:
    """A line a cell."""
    text = [
        "Problems a second, warm: `solve_batch` of a stack on the accelerator and, of a part of it, on the "
        f"processor beside it; and `jit(vmap(solve))` of {SIDE_BY_SIDE} problems that lie on the "
        "accelerator, with greedy cliques. Each problem is in the stack several times: all copies must have "
        "the same bits. Against the processor: problems with another set, and the largest difference of a "
        "pose.",
        "",
        "| cell | batch | accelerator | processor | jit(vmap) | wanted | reached | right | same bits "
        "| other sets | pose | first call [s] |",
        "|---|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        rates, wanted = r["rates"], r["wanted"]
        reached = "-" if wanted is None else said(rates["there"] >= wanted)
        text.append(
            f"| {r['cell']} | {r['batch']} | {rates['there']:.0f} | {rates['here']:.0f} "
            f"| {rates['vmap']:.0f} "
            f"| {wanted or '-'} | {reached} | {r['right']:.1%} | {said(r['same_bits'])} | {r['other_sets']} "
            f"| {r['pose_difference']:.0e} | {r['cold']:.1f} |"
        )
    return "\n".join(text)
