"""The clique stage by itself, on graphs where it is all of the work, and what a budget buys."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

import jax
import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.problems import Case, real_pairs
from benchmarks.speed import ours
from teaser_jax.engine.frames import centred_one
from teaser_jax.engine.packing import pack_problem
from teaser_jax.engine.programs import ON_ONE_DEVICE
from teaser_jax.engine.sizes import size_of
from teaser_jax.settings import ExactClique
from teaser_jax.stages.clique.maximum import finish_on_host, search_on_device

BUDGET = 0.3  # seconds


def graphs() -> Iterator[tuple[Case, float]]:
    """Graphs, and the milliseconds wanted there."""
    p = tj.synthetic.random_problem(0, n=5000, outlier_rate=0.0)
    yield Case("complete, N = 5000, no wrong match", p.src, p.dst, p.noise_bound, 1.0, p.truth), 5.0
    for sigmas in (2.0, 1.5, 1.0):
        for seed in range(3):
            p = tj.synthetic.random_problem((1, seed), n=1000, outlier_rate=0.5)
            cell = f"nearly a clique, N = 1000, 50 % wrong, bound of {sigmas:.1f} sigma"
            yield Case(cell, p.src, p.dst, sigmas * tj.synthetic.SIGMA, 1.0, p.truth), 200.0


def stage(case: Case, repeats: int) -> dict:
    """Median time of the stage, device and host together."""
    settings = tj.Settings()
    problem = tj.host_problem(case.src, case.dst, noise_bound=case.noise_bound)
    near = centred_one(pack_problem(problem, settings, size_of(problem)))
    choices = jax.tree.structure(settings)
    search, seconds = jax.jit(search_on_device), []
    with jax.enable_x64(True):
        graph, _, _ = ON_ONE_DEVICE.before(near.sent, choices, near.edge_dtype)
        for _ in range(repeats + 1):  # the first one compiles
            start = time.perf_counter()
            found = search(settings.clique, graph.edge_bits, graph.mask)
            clique = finish_on_host(settings.clique, graph.edge_bits, graph.mask, found)
            size = int(np.sum(np.asarray(clique.members)))
            seconds.append(time.perf_counter() - start)
    return {
        "cell": case.cell,
        "milliseconds": 1e3 * float(np.median(seconds[1:])),
        "size": size,
        "upper": int(clique.upper_bound),
    }


def budgeted(case: Case, repeats: int) -> dict:
    """What a call comes back with when its budget is short, and how far it goes over it."""

    def timed(settings: tj.Settings) -> tuple[float, tj.Registration]:
        ours(case, settings)
        seconds = []
        for _ in range(repeats):
            start = time.perf_counter()
            result = ours(case, settings)
            seconds.append(time.perf_counter() - start)
        return 1e3 * float(np.median(seconds)), result

    milliseconds, result = timed(tj.Settings(clique=ExactClique(seconds=BUDGET)))
    return {
        "cell": case.cell,
        "milliseconds": milliseconds,
        "without_search": timed(tj.Settings(clique="greedy"))[0],
        "size": int(result.solution.clique_size),
        "upper": int(result.solution.clique_upper_bound),
        "right": case.is_right(result.pose),
    }


def run(quick: bool) -> list[dict]:
    """A row a graph; the last ones are of budgets."""
    repeats = 1 if quick else 5
    rows = [{"part": "stage", "wanted": most, **stage(case, repeats)} for case, most in graphs()]
    for case in real_pairs():
        if "mac_demo" in case.cell:
            for bound in (0.05, 0.1):
                cell = f"{case.cell}, bound {bound}"
                rows.append(
                    {"part": "budget", **budgeted(replace(case, cell=cell, noise_bound=bound), repeats)}
                )
    return rows


def metrics(rows: list[dict]) -> list[Metric]:
    """Times, and gaps that hold on any machine of this speed."""
    found = []
    for cell in dict.fromkeys(r["cell"] for r in rows if r["part"] == "stage"):
        same = [r for r in rows if r["cell"] == cell]
        slowest = max(r["milliseconds"] for r in same)
        found.append(Metric(f"{cell}: slowest", slowest, "ms", "lower", 0.5, portable=False))
        proved = sum(r["size"] == r["upper"] for r in same) / len(same)
        found.append(Metric(f"{cell}: proved", proved, "share", "higher", 0.0))
    for r in (r for r in rows if r["part"] == "budget"):
        gap = r["upper"] / r["size"]
        found.append(Metric(f"{r['cell']}, {BUDGET} s: gap", gap, "ratio", "lower", 0.1, portable=False))
    return found


def report(rows: list[dict]) -> str:
    """Two tables."""
    text = [
        "Median time of the clique stage, device and host together, the slowest of the graphs of a kind.",
        "",
        "| graph | graphs | slowest [ms] | sizes | proved | wanted |",
        "|---|---|---|---|---|---|",
    ]
    for cell in dict.fromkeys(r["cell"] for r in rows if r["part"] == "stage"):
        same = [r for r in rows if r["cell"] == cell]
        slowest, proved = max(r["milliseconds"] for r in same), sum(r["size"] == r["upper"] for r in same)
        sizes, most = ", ".join(str(r["size"]) for r in same), same[0]["wanted"]
        reached = said(slowest <= most and proved == len(same))
        text.append(
            f"| {cell} | {len(same)} | {slowest:.2f} | {sizes} | {proved} of {len(same)} "
            f"| {most:.0f} ms: {reached} |"
        )
    limited = [r for r in rows if r["part"] == "budget"]
    if limited:
        text += [
            "",
            f"The whole call under `Settings(clique=ExactClique(seconds={BUDGET}))`; a call without a search",
            "takes what stands beside it. Wanted: a gap of at most 1.5, and at most a tenth over the budget.",
            "",
            "| pair | call [ms] | without search [ms] | clique | at most | gap | pose right | wanted |",
            "|---|---|---|---|---|---|---|---|",
        ]
    for r in limited:
        gap = r["upper"] / r["size"]
        within = r["milliseconds"] - r["without_search"] <= 1100 * BUDGET
        text.append(
            f"| {r['cell']} | {r['milliseconds']:.0f} | {r['without_search']:.0f} | {r['size']} "
            f"| {r['upper']} | {gap:.2f} | {said(r['right'])} | {said(within and gap <= 1.5)} |"
        )
    return "\n".join(text)
