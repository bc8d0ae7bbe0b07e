"""Many problems at once: throughput beside a loop over ``register`` and beside processes of a peer."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import partial
from typing import Any

import jax
import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.crew import Crew
from benchmarks.peers import PEERS
from benchmarks.problems import Case, protocol
from benchmarks.processes import available_cores
from teaser_jax.studies.peers import Question

# Matches, problems, what was wanted [problems/s] (None: three times the loop).
CELLS = ((50, 1024, 45_000), (100, 1024, 14_000), (1000, 64, None))
RATES = {50: (0.5, 0.8, 0.9), 100: (0.5, 0.8, 0.9), 1000: (0.95,)}
PEER = "kiss-matcher"


def seconds(
    works: dict[str, Callable[[], Any]], rounds: int, own: dict[str, Callable[[], float]] | None = None
) -> dict[str, float]:
    """Median times of works that take turns; each has run before. ``own``: those that return their time."""

    def timed(work: Callable[[], Any]) -> float:
        start = time.perf_counter()
        work()
        return time.perf_counter() - start

    clocks = {name: partial(timed, work) for name, work in works.items()} | (own or {})
    taken: dict[str, list[float]] = {name: [] for name in clocks}
    for _ in range(rounds):
        for name, clock in clocks.items():
            taken[name].append(clock())
    return {name: float(np.median(times)) for name, times in taken.items()}


def right(cases: list[Case], poses: list[tj.Pose]) -> float:
    """Share of accepted answers."""
    return float(np.mean([case.is_right(pose) for case, pose in zip(cases, poses, strict=True)]))


def one_by_one(poses: tj.Pose) -> list[tj.Pose]:
    """The poses of a stack."""
    return [jax.tree.map(lambda x, k=k: x[k], poses) for k in range(len(poses.scale))]


def ask_peer(case: Case) -> Question:
    """The peer's question, in its process."""
    return PEERS[PEER].ask(case)


def cell(n: int, rate: float, count: int, wanted: int | None, rounds: int, crew: Crew | None) -> dict:
    """One size and share of wrong matches."""
    cases = list(protocol(n, rate, count))
    problems = [tj.host_problem(c.src, c.dst, noise_bound=c.noise_bound) for c in cases]
    stack = tj.stack_problems(problems)
    some = cases[:: max(1, count // 64)]

    def loop() -> list[tj.Registration]:
        return [tj.register(c.src, c.dst, noise_bound=c.noise_bound) for c in some]

    start = time.perf_counter()
    batch = tj.solve_batch(stack)
    cold = time.perf_counter() - start
    alone = loop()
    works: dict[str, Callable[[], Any]] = {
        "stack": lambda: tj.solve_batch(stack),
        "list": lambda: tj.solve_batch(problems),
        "loop": loop,
    }
    row: dict[str, Any] = {"cell": cases[0].cell, "batch": count, "wanted": wanted, "cold": cold}
    own: dict[str, Callable[[], float]] = {}
    if crew is not None:
        row["right_peer"], row["peer_processes"] = right(cases, crew.take(cases)), len(crew.pipes)
        own["peer"] = crew.seconds
    taken = seconds(works, rounds, own)
    sizes = {"loop": len(some)}
    row["rates"] = {name: sizes.get(name, count) / taken[name] for name in taken}
    row["right"] = right(cases, one_by_one(batch.pose))
    row["right_loop"] = right(some, [a.pose for a in alone])
    row["proved"] = float(np.mean(batch.clique_is_maximum))
    row["proved_on_device"] = float(np.mean(proved_on_device(stack)))
    return row


def proved_on_device(stack: tj.Problem) -> np.ndarray:
    """Which cliques the device proves by itself, before the host's turn."""
    from teaser_jax.engine.packing import pack_problem
    from teaser_jax.engine.programs import before_search
    from teaser_jax.engine.sizes import size_of

    settings = tj.Settings()
    with jax.enable_x64(True):
        sent, choices = pack_problem(stack, settings, size_of(stack)), jax.tree.structure(settings)
        one = jax.jit(lambda x: before_search(x, choices, np.float32)[2])
        return np.asarray(jax.lax.map(one, sent, batch_size=64))


def run(quick: bool) -> list[dict]:
    """A row a cell; the peer's processes, one a core, are started once."""
    with ExitStack() as stack:
        crew = stack.enter_context(Crew(ask_peer, available_cores())) if PEER in PEERS else None
        share, rounds = (8, 2) if quick else (1, 9)
        return [
            cell(n, rate, count // share, wanted, rounds, crew)
            for n, count, wanted in CELLS
            for rate in RATES[n]
        ]


def metrics(rows: list[dict]) -> list[Metric]:
    """Throughput, and success."""
    found = []
    for r in rows:
        found.append(
            Metric(f"{r['cell']}: batch", r["rates"]["stack"], "problems/s", "higher", 0.4, portable=False)
        )
        ratio = r["rates"]["stack"] / r["rates"]["loop"]
        found.append(Metric(f"{r['cell']}: against a loop", ratio, "times", "higher", 0.4))
        found.append(Metric(f"{r['cell']}: right", r["right"], "share", "higher", 0.01))
    return found


def report(rows: list[dict]) -> str:
    """A line a cell."""
    processes = rows[0].get("peer_processes", 0)
    text = [
        "Problems a second, warm: `solve_batch` of a stack and of a list, a loop over `register`, and "
        f"{PEER} in {processes} processes, on the same problems, taking turns. The peer's processes hold "
        "their problems in its own arrays beforehand, start together and look at their own clocks: nothing "
        "is sent between processes in its time.",
        "",
        f"| cell | batch | stack | list | loop | {PEER} | wanted | reached | right: ours, loop, peer "
        "| proved on the device | first call [s] |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for r in rows:
        rates = r["rates"]
        wanted = r["wanted"] or 3 * rates["loop"]
        peer = f"{rates['peer']:.0f}" if "peer" in rates else "-"
        peer_right = f"{r['right_peer']:.1%}" if "right_peer" in r else "-"
        text.append(
            f"| {r['cell']} | {r['batch']} | {rates['stack']:.0f} | {rates['list']:.0f} "
            f"| {rates['loop']:.0f} | {peer} | {wanted:.0f} | {said(rates['stack'] >= wanted)} "
            f"| {r['right']:.1%}, {r['right_loop']:.1%}, {peer_right} | {r['proved_on_device']:.1%} "
            f"| {r['cold']:.1f} |"
        )
    return "\n".join(text)
