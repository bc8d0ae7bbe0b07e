"""A robot's day: pairs of all sizes, one after the other; what compiles, and what padding costs."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

import teaser_jax as tj
from benchmarks.baseline import Metric, said
from benchmarks.problems import Case, protocol
from benchmarks.processes import in_child
from benchmarks.speed import ours
from teaser_jax.engine import sizes as sizes_room
from teaser_jax.engine.programs import ON_ONE_DEVICE

LEAST, MOST = 300, 6000
WANTED_PROGRAMS, WANTED_PADDING = 8, 4 / 3


def pairs(count: int) -> Iterator[Case]:
    """Sizes even on a logarithmic axis, three shares of wrong matches."""
    sizes = np.exp(np.random.default_rng(0).uniform(np.log(LEAST), np.log(MOST), count)).astype(int)
    for k, n in enumerate(sizes):
        yield next(protocol(int(n), (0.8, 0.9, 0.95)[k % 3], 1))


def day(quick: bool, warmed: bool) -> dict:
    """Milliseconds of every call, and the programs that were compiled by them."""
    import jax

    compiled: list[str] = []

    def listen(event: str, *_: object, **__: object) -> None:
        if "backend_compile" in event:
            compiled.append(event)

    start = time.perf_counter()
    sizes = tj.warmup(max_points=MOST) if warmed else []
    warmup, milliseconds = time.perf_counter() - start, []
    before = _programs()
    jax.monitoring.register_event_duration_secs_listener(listen)
    for case in pairs(20 if quick else 200):
        start = time.perf_counter()
        ours(case)
        milliseconds.append(1e3 * (time.perf_counter() - start))
    p50, p99 = np.percentile(milliseconds, [50, 99])
    return {
        "part": "warmed" if warmed else "cold",
        "pairs": len(milliseconds),
        "p50": p50,
        "p99": p99,
        "worst": max(milliseconds),
        "sizes": _programs() - before,
        "compiled": len(compiled),
        "warmup": warmup,
        "warmed_sizes": len(sizes),
    }


def _programs() -> int:
    return ON_ONE_DEVICE.before._cache_size()


def padding(quick: bool) -> dict:
    """Time of calls in padded sizes over the time of the same calls in programs of their very size."""
    padded, times = sizes_room.padded_size, []
    for case in pairs(2 if quick else 12):
        seconds: dict = {padded: [], int: []}
        for repeat in range(2 if quick else 8):
            for bucket in seconds:
                sizes_room.padded_size = bucket
                start = time.perf_counter()
                ours(case)
                if repeat > 0:
                    seconds[bucket].append(time.perf_counter() - start)
        times.append([float(np.median(s)) for s in seconds.values()])
    sizes_room.padded_size = padded
    total = np.sum(times, axis=0)
    return {"part": "padding", "pairs": len(times), "ratio": float(total[0] / total[1])}


def run(quick: bool) -> list[dict]:
    """Each part in a process of its own."""
    days = [in_child(day, quick=quick, warmed=warmed) for warmed in (False, True)]
    return [*days, in_child(padding, quick=quick)]


def metrics(rows: list[dict]) -> list[Metric]:
    """Times of this machine; counts hold on any."""
    part = {r["part"]: r for r in rows}
    cold, warmed = part["cold"], part["warmed"]
    return [
        Metric("sizes compiled", cold["sizes"], "programs", "lower", 0.0),
        Metric("compiled after warmup", warmed["compiled"], "programs", "lower", 0.0),
        Metric("after warmup, median", warmed["p50"], "ms", "lower", 0.5, portable=False),
        Metric("after warmup, 99 %", warmed["p99"], "ms", "lower", 0.5, portable=False),
        Metric("without warmup, worst", cold["worst"], "ms", "lower", 0.5, portable=False),
        Metric("padded / exact", part["padding"]["ratio"], "ratio", "lower", 0.15),
    ]


def report(rows: list[dict]) -> str:
    """A table and a sentence."""
    part = {r["part"]: r for r in rows}
    cold, warmed, ratio = part["cold"], part["warmed"], part["padding"]["ratio"]
    text = [
        f"{cold['pairs']} pairs of {LEAST} to {MOST} matches, even on a logarithmic axis, of which 80 to",
        "95 % are wrong, in the order in which they come.",
        "",
        "| | median [ms] | 99 % within [ms] | worst [ms] | sizes compiled | programs compiled |",
        "|---|---|---|---|---|---|",
    ]
    for name, r in (("from the first call on", cold), ("after `warmup(max_points=6000)`", warmed)):
        text.append(
            f"| {name} | {r['p50']:.1f} | {r['p99']:.1f} | {r['worst']:.0f} "
            f"| {r['sizes']} | {r['compiled']} |"
        )
    few, none = said(cold["sizes"] <= WANTED_PROGRAMS), said(warmed["compiled"] == 0)
    text += [
        "",
        f"The warmup takes {warmed['warmup']:.0f} s for {warmed['warmed_sizes']} sizes, small ones too.",
        f"Padded to these sizes, {part['padding']['pairs']} such pairs take {ratio:.2f} times as long as in",
        f"programs of their very size. Wanted: at most {WANTED_PROGRAMS} sizes ({few}), nothing compiled",
        f"after the warmup ({none}), less than a third lost to padding ({said(ratio < WANTED_PADDING)}).",
    ]
    return "\n".join(text)
