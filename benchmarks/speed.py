"""Time and memory of one call, warm and cold, beside the peers in the same run.

Problems and methods take turns, so that a noisy minute hits all of them, and medians are reported.
A cell in which a method gave a wrong answer has no time for it. Everything runs in child processes:
one on a single core, one on two, one for each first call and for each look at memory.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

CORES = (1, 2)
CACHE = ("JAX_COMPILATION", "JAX_PERSISTENT")  # variables that keep programs between processes
# N, share wrong, unknown scale
FIRST_CALLS = ((1000, 0.95, False), (1000, 0.8, True), (10_000, 0.99, False), (30_000, 0.99, False))

# jax and whatever imports it load in the functions: a first call counts from before that.


def cells(quick: bool) -> Iterator[tuple[str, list, int]]:
    """Name, problems and rounds of each cell."""
    from benchmarks.problems import Case, protocol, real_pairs
    from teaser_jax import synthetic

    def together(name: str, cases: list, rounds: int) -> tuple[str, list, int]:
        return name, cases, 1 if quick else rounds

    for n, rates, trials, rounds in (
        (100, (0.5, 0.7, 0.9), 10, 10),
        (1000, (0.95, 0.97, 0.99), 5, 10),
        (5000, (0.95, 0.99), 3, 5),
        (10_000, (0.99,), 1, 5),
    ):
        for rate in rates:
            name = f"known scale, N = {n}, {round(100 * rate)} % wrong"
            yield together(name, list(protocol(n, rate, trials)), rounds)
    for n, rate, trials, rounds in ((100, 0.8, 10, 5), (1000, 0.8, 3, 3), (3000, 0.8, 1, 2)):
        name = f"unknown scale, N = {n}, {round(100 * rate)} % wrong"
        yield together(name, list(protocol(n, rate, trials, unknown=True)), rounds)
    for overlap in (0.2, 0.5, 0.8):
        p = synthetic.all_to_all(
            (3, round(10 * overlap)), n=100, overlap=overlap, sigma=0.003, noise_bound=0.01
        )
        case = Case("", p.src, p.dst, p.noise_bound, 1.0, p.truth, p.inliers)
        yield together(f"all to all, {len(p.src)} matches", [case], 5)
    for case in real_pairs():
        yield together(case.cell, [case], 5)
        if "mac_demo" in case.cell:
            yield together(f"{case.cell}, bound 0.1", [replace(case, noise_bound=0.1)], 2)


def ours(case):
    """The default call; keeps the answer for its proof."""
    import teaser_jax as tj

    ours.result = tj.register(case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale)
    return ours.result.pose


def warm(quick: bool) -> list[dict]:
    """A row a cell and method: median time of a call, right answers, proved cliques."""
    from benchmarks.peers import PEERS

    rows = []
    for name, cases, rounds in cells(quick):
        peers = {k: solve for k, solve in PEERS.items() if cases[0].scale is not None or k == "TEASER++"}
        methods = {"teaser_jax": ours, **peers}
        right, proved = dict.fromkeys(methods, 0), 0
        for case in cases:  # also compiles
            for method, solve in methods.items():
                right[method] += case.is_right(solve(case))
            proved += bool(ours.result.solution.clique_is_maximum)
        seconds = {method: [] for method in methods}
        for _ in range(rounds):
            for case in cases:
                for method, solve in methods.items():
                    start = time.perf_counter()
                    solve(case)
                    seconds[method].append(time.perf_counter() - start)
        for method in methods:
            rows.append(
                {
                    "cell": name,
                    "method": method,
                    "trials": len(cases),
                    "right": right[method],
                    "proved": proved if method == "teaser_jax" else None,
                    "milliseconds": 1e3 * float(np.median(seconds[method])),
                }
            )
    return rows


def stream(quick: bool) -> list[dict]:
    """A robot's day: pairs of all sizes, one after the other, from the first call on."""
    import teaser_jax as tj
    from benchmarks.problems import protocol
    from teaser_jax.register import before_clique

    rng = np.random.default_rng(0)
    sizes = np.exp(rng.uniform(np.log(300), np.log(6000), 20 if quick else 200)).astype(int)
    compiled, milliseconds = before_clique._cache_size(), []
    for k, n in enumerate(sizes):
        case = next(protocol(int(n), (0.8, 0.9, 0.95)[k % 3], 1))
        start = time.perf_counter()
        tj.register(case.src, case.dst, noise_bound=case.noise_bound)
        milliseconds.append(1e3 * (time.perf_counter() - start))
    p50, p99 = np.percentile(milliseconds, [50, 99])
    return [
        {
            "pairs": len(sizes),
            "p50": p50,
            "p99": p99,
            "worst": max(milliseconds),
            "programs": before_clique._cache_size() - compiled,
        }
    ]


def first(n: int, rate: float, unknown: bool) -> dict:
    """Seconds to import and to the first answer of a fresh process, and its memory above an idle one."""
    start = time.perf_counter()
    import jax

    import teaser_jax as tj
    from benchmarks.problems import protocol

    imported = time.perf_counter()
    case = next(protocol(n, rate, 1, unknown=unknown))
    jax.block_until_ready(jax.numpy.zeros(1) + 1)
    idle, ready = _peak(), time.perf_counter()
    result = tj.register(case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale)
    return {
        "import": imported - start,
        "first": time.perf_counter() - ready,
        "megabytes": _peak() - idle,
        "right": case.is_right(result.pose),
    }


def _peak() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def run(quick: bool) -> list[dict]:
    """All parts, each in processes of its own; a row has the name of its part."""
    rows = []
    available = len(os.sched_getaffinity(0))
    for cores in (c for c in CORES if c <= available):
        rows += [{"part": "warm", "cores": cores, **row} for row in _child("warm", cores, quick)]
    rows += [{"part": "stream", **row} for row in _child("stream", available, quick)]
    for n, rate, unknown in FIRST_CALLS:
        if quick and n > 1000:
            continue
        name = f"{'unknown' if unknown else 'known'} scale, N = {n}"
        part = f"first {n} {rate} {int(unknown)}"
        rows.append({"part": "first", "cell": name, "cache": "none", **_child(part, available, quick)})
        if n == 1000:
            with tempfile.TemporaryDirectory() as folder:
                keep = {
                    "JAX_COMPILATION_CACHE_DIR": folder,
                    "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
                }
                _child(part, available, quick, keep)
                filled = _child(part, available, quick, keep)
            rows.append({"part": "first", "cell": name, "cache": "filled", **filled})
    return rows


def _child(part: str, cores: int, quick: bool, variables: dict[str, str] | None = None):
    """Run a part in a process of its own, on so many cores, without anybody's compilation cache."""
    environment = {k: v for k, v in os.environ.items() if not k.startswith(CACHE)}
    chosen = sorted(os.sched_getaffinity(0))[:cores]
    command = [sys.executable, "-m", "benchmarks.speed", *part.split(), *(["--quick"] if quick else [])]
    done = subprocess.run(
        command,
        env={**environment, **(variables or {}), "OMP_NUM_THREADS": str(cores)},
        preexec_fn=lambda: os.sched_setaffinity(0, chosen),
        cwd=Path(__file__).parents[1],
        stdout=subprocess.PIPE,
        check=True,
    )
    return json.loads(done.stdout.decode().splitlines()[-1])


def report(rows: list[dict]) -> str:
    """Warm calls with their ratio to the fastest peer, the stream, and first calls."""
    lines = [
        "Median time of one call, warm; every answer counted is right, others have no time. The ratio is",
        "that of the fastest peer's time to ours.",
        "",
        "| cell | cores | teaser_jax [ms] | clique proved | peers [ms] | ratio |",
        "|---|---|---|---|---|---|",
    ]
    warm_rows = [r for r in rows if r["part"] == "warm"]
    for mine in (r for r in warm_rows if r["method"] == "teaser_jax"):
        same = [r for r in warm_rows if (r["cell"], r["cores"]) == (mine["cell"], mine["cores"])]
        times = {r["method"]: r["milliseconds"] for r in same if r["right"] == r["trials"]}
        peers = {k: v for k, v in times.items() if k != "teaser_jax"}
        wrong = [f"{r['method']} wrong" for r in same if r["right"] < r["trials"] and r is not mine]
        beside = ", ".join([*(f"{k} {v:.2f}" for k, v in peers.items()), *wrong]) or "none"
        own = times.get("teaser_jax")
        ratio = f"{min(peers.values()) / own:.2f}" if peers and own else ""
        shown = f"{own:.2f}" if own else "wrong"
        lines.append(
            f"| {mine['cell']} | {mine['cores']} | {shown} | {mine['proved']} of {mine['trials']} "
            f"| {beside} | {ratio} |"
        )
    for row in (r for r in rows if r["part"] == "stream"):
        lines += [
            "",
            f"A stream of {row['pairs']} pairs of 300 to 6000 matches, first calls and compilation "
            f"included: median {row['p50']:.1f} ms, 99 % within {row['p99']:.0f} ms, "
            f"the worst {row['worst']:.0f} ms; {row['programs']} sizes compiled.",
        ]
    lines += [
        "",
        "The first answer of a fresh process, and the peak of its memory above an idle one:",
        "",
        "| cell | compilation cache | import [s] | first call [s] | memory [MB] |",
        "|---|---|---|---|---|",
    ]
    for r in (r for r in rows if r["part"] == "first"):
        lines.append(
            f"| {r['cell']} | {r['cache']} | {r['import']:.2f} | {r['first']:.2f} | {r['megabytes']:.0f} |"
        )
    return "\n".join(lines)


def main() -> None:
    """One part, its rows as JSON on the last line of the output."""
    parser = argparse.ArgumentParser()
    parser.add_argument("part", choices=("warm", "stream", "first"))
    parser.add_argument("numbers", nargs="*")
    parser.add_argument("--quick", action="store_true")
    options = parser.parse_args()
    if options.part == "first":
        n, rate, unknown = options.numbers
        rows = first(int(n), float(rate), bool(int(unknown)))
    else:
        rows = {"warm": warm, "stream": stream}[options.part](options.quick)
    print(json.dumps(rows))


if __name__ == "__main__":
    main()
