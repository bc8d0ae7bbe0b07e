"""The time of one warm call, beside the peers in the same run, on one core and on two.

Methods take turns on the problems of a cell, so that a noisy minute hits all, and medians are reported.
A cell in which a method gave a wrong answer has no time for it.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.peers import peers_for
from benchmarks.problems import Case, protocol, real_pairs
from benchmarks.processes import available_cores, in_child
from teaser_jax.studies.peers import Question

CORES = (1, 2)
OURS, GREEDY = "teaser_jax", "teaser_jax, clique='greedy'"
PATIENCE = 10.0  # seconds that a method may take in a cell before its rounds end
SETTLE = 0.02  # seconds between two methods: threads of the one before may still spin
REAL_MEDIAN = 80.0  # milliseconds wanted as the median of the pairs below
DEFAULT = tj.Settings()
KISS, TEASER = "kiss-matcher", "TEASER++"


class Cell(NamedTuple):
    """Problems of one kind, and what is wanted there."""

    name: str
    cases: list[Case]
    rounds: int
    milliseconds: float | None = None  # at most so many
    ratio: float | None = None  # or: at most the time of kiss-matcher divided by this


def cells() -> Iterator[Cell]:
    """Every cell of the table."""
    for n, rates, trials, rounds, known in (
        (100, (0.5, 0.7, 0.9), 10, 20, dict(ratio=1.0)),
        (1000, (0.95, 0.97, 0.99), 5, 20, dict(ratio=3.0)),
        (5000, (0.95, 0.99), 3, 7, dict(ratio=5.0)),
        (10_000, (0.99,), 1, 5, dict(milliseconds=300.0)),
    ):
        for rate in rates:
            name = f"known scale, N = {n}, {round(100 * rate)} % wrong"
            yield Cell(name, list(protocol(n, rate, trials)), rounds, **known)
    for n, trials, rounds, most in ((100, 10, 10, None), (1000, 3, 5, 100.0), (3000, 1, 5, 700.0)):
        name = f"unknown scale, N = {n}, 80 % wrong"
        yield Cell(name, list(protocol(n, 0.8, trials, unknown=True)), rounds, most)
    for overlap, most in ((0.2, 50.0), (0.5, 150.0), (0.8, 400.0)):
        case = all_to_all(overlap)
        yield Cell(f"all to all, {len(case.src)} matches", [case], 5, most)
    for case in real_pairs():
        hard = "mac_demo" in case.cell
        yield Cell(case.cell, [case], 5, 800.0 if hard else None)
        if hard:
            wide = f"{case.cell}, bound 0.1"
            yield Cell(wide, [replace(case, noise_bound=0.1)], 3, 3000.0)


def all_to_all(overlap: float) -> Case:
    """100 points against a part of them, every one with every one."""
    seed = (3, round(10 * overlap))
    p = tj.synthetic.all_to_all(seed, n=100, overlap=overlap, sigma=0.003, noise_bound=0.01)
    return Case("", p.src, p.dst, p.noise_bound, 1.0, p.truth, p.inliers)


def ours(case: Case, settings: tj.Settings = DEFAULT) -> tj.Registration:
    """The call that is measured."""
    return tj.register(case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale, settings=settings)


def ask_ours(settings: tj.Settings = DEFAULT) -> Callable[[Case], Question]:
    """A case as we take it: as it is. What ``register`` makes of it counts."""
    return lambda case: Question(partial(ours, case, settings), lambda result: result.pose)


def warm(quick: bool) -> list[dict]:
    """A row a cell and method: median time of a call, right answers, proved cliques."""
    return [row for cell in cells() for row in _rows(cell, 1 if quick else cell.rounds)]


def _rows(cell: Cell, rounds: int) -> Iterator[dict]:
    asked: dict[str, Callable[[Case], Question]] = {
        OURS: ask_ours(),
        GREEDY: ask_ours(tj.Settings(clique="greedy")),
        **peers_for(cell.cases[0]),
    }
    methods = {method: [ask(case) for case in cell.cases] for method, ask in asked.items()}
    right = {  # this compiles, too
        method: sum(case.is_right(q.answer()) for case, q in zip(cell.cases, questions, strict=True))
        for method, questions in methods.items()
    }
    proved = sum(bool(ours(case).solution.clique_is_maximum) for case in cell.cases)
    seconds: dict[str, list[float]] = {method: [] for method in methods}
    for _ in range(rounds):
        for method, questions in methods.items():
            if sum(seconds[method]) > PATIENCE:
                continue
            time.sleep(SETTLE)
            for question in questions:
                start = time.perf_counter()
                question.solve()
                seconds[method].append(time.perf_counter() - start)
    for method in methods:
        yield {
            "cell": cell.name,
            "method": method,
            "trials": len(cell.cases),
            "right": right[method],
            "proved": proved if method == OURS else None,
            "milliseconds": 1e3 * float(np.median(seconds[method])),
            "wanted_ms": cell.milliseconds,
            "wanted_ratio": cell.ratio,
        }


def run(quick: bool) -> list[dict]:
    """The table on one core, and on two where there are two."""
    chosen = [cores for cores in CORES if cores <= available_cores()]
    return [{"cores": k, **row} for k in chosen for row in in_child(warm, cores=k, quick=quick)]


class Line(NamedTuple):
    """What is known of one cell on so many cores: times of those who were right."""

    own: dict
    times: dict[str, float]
    wrong: list[str]

    @property
    def peers(self) -> dict[str, float]:
        """Times of the others."""
        return {k: v for k, v in self.times.items() if not k.startswith(OURS)}

    @property
    def reached(self) -> bool | None:
        """Whether the cell is as fast as wanted; None where nothing to compare with is known."""
        own, most, ratio = self.times.get(OURS), self.own["wanted_ms"], self.own["wanted_ratio"]
        if most is None and ratio is not None and KISS in self.times:
            most = self.times[KISS] / ratio
        return None if most is None else own is not None and own <= most


def lines_of(rows: list[dict]) -> Iterator[Line]:
    """The rows of each cell together."""
    for own in (r for r in rows if r["method"] == OURS):
        same = [r for r in rows if (r["cell"], r["cores"]) == (own["cell"], own["cores"])]
        times = {r["method"]: r["milliseconds"] for r in same if r["right"] == r["trials"]}
        yield Line(own, times, [r["method"] for r in same if r["right"] < r["trials"]])


def metrics(rows: list[dict]) -> list[Metric]:
    """Times of this machine, and ratios to peers, which hold on others."""
    found = []
    for line in lines_of(rows):
        name = f"{line.own['cell']}, cores: {line.own['cores']}"
        found.append(Metric(f"{name}: right", line.own["right"] / line.own["trials"], "share", "higher", 0.0))
        found.append(
            Metric(f"{name}: proved", line.own["proved"] / line.own["trials"], "share", "higher", 0.0)
        )
        if OURS in line.times:
            found.append(Metric(f"{name}: time", line.times[OURS], "ms", "lower", 0.5, portable=False))
            for peer in (KISS, TEASER):
                if peer in line.times:
                    ratio = line.times[peer] / line.times[OURS]
                    found.append(Metric(f"{name}: {peer} / ours", ratio, "ratio", "higher", 0.3))
    return found


def report(rows: list[dict]) -> str:
    """A line a cell, with the ratio to the fastest peer."""
    text = [
        "Median time of one warm call; whoever gave a wrong answer in a cell has no time there. `greedy` is",
        "the same call without the search that proves the clique. The ratio is that of the fastest peer's",
        "time to ours. Wanted: at most a time, or kiss-matcher's time divided by a number.",
        "",
        "| cell | cores | teaser_jax [ms] | clique proved | greedy [ms] | peers [ms] | ratio | wanted |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for line in lines_of(rows):
        own, times = line.own, line.times
        beside = [f"{k} {v:.2f}" for k, v in line.peers.items()]
        beside += [f"{k} wrong" for k in line.wrong if not k.startswith(OURS)]
        shown = [f"{times[k]:.2f}" if k in times else "wrong" for k in (OURS, GREEDY)]
        ratio = f"{min(line.peers.values()) / times[OURS]:.2f}" if line.peers and OURS in times else ""
        wanted = ""
        if line.reached is not None:
            aim = (
                f"{own['wanted_ms']:.0f} ms"
                if own["wanted_ms"]
                else f"kiss-matcher / {own['wanted_ratio']:.0f}"
            )
            wanted = f"{aim}: {said(line.reached)}"
        text.append(
            f"| {own['cell']} | {own['cores']} | {shown[0]} | {own['proved']} of {own['trials']} "
            f"| {shown[1]} | {', '.join(beside) or 'none'} | {ratio} | {wanted} |"
        )
    for cores in sorted({r["cores"] for r in rows}):
        scans = [line for line in lines_of(rows) if _is_scan(line.own) and line.own["cores"] == cores]
        if scans:
            median = float(np.median([line.times.get(OURS, np.inf) for line in scans]))
            text += [
                "",
                f"Cores: {cores}. Median of the {len(scans)} pairs of KITTI and ETH: {median:.1f} ms "
                f"(wanted: {REAL_MEDIAN:.0f} ms: {said(median <= REAL_MEDIAN)}).",
            ]
    return "\n".join(text)


def _is_scan(row: dict) -> bool:
    return "kitti" in row["cell"] or "eth" in row["cell"]
