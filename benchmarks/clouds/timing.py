"""Time and memory by stage of a few pairs: methods take turns, warm, in a process of their own."""

from __future__ import annotations

import ctypes
import os

import numpy as np

from benchmarks.clouds.cases import CloudPair, pairs
from benchmarks.clouds.methods import OURS, find_methods, ours
from benchmarks.processes import forget_peak, in_child, peak_megabytes

TIMED = ("3DMatch kitchen", "KITTI 00", "bunny scans", "CAD to scan", "another place", "plain scenes")
ROUNDS = 3


def timed(quick: bool) -> list[dict]:
    """A row a pair and method: medians of a warm call in all, by stage, and on all cores together."""
    return in_child(measure, cores=len(os.sched_getaffinity(0)), rounds=1 if quick else ROUNDS)


def measure(rounds: int) -> list[dict]:
    """Ask every method about the first pair of each kind, in turns."""
    methods, _ = find_methods()
    first: dict[str, CloudPair] = {}
    for pair in pairs(quick=True):
        if pair.kind in TIMED:
            first.setdefault(pair.kind, pair)
    rows = []
    for kind, pair in first.items():
        peak = {name: _peak(method, pair) for name, method in methods.items()}  # this compiles, too
        stages = _stages(pair)
        answers = {name: [] for name in methods}
        for _ in range(rounds):
            for name, method in methods.items():
                answers[name].append(method(pair))
        for name, several in answers.items():
            rows.append(
                {
                    "kind": kind,
                    "pair": pair.name,
                    "points": len(pair.src),
                    "method": name,
                    "wall": float(np.median([x.wall for x in several])),
                    "cpu": float(np.median([x.cpu for x in several])),
                    "stages": {
                        stage: float(np.median([x.seconds[stage] for x in several]))
                        for stage in several[0].seconds
                    },
                    "megabytes": peak[name],
                    "stage_megabytes": stages if name == OURS else {},
                }
            )
    return rows


def _peak(method, pair: CloudPair) -> float:
    """The most memory of a warm call above that of the process before it [MB]."""
    method(pair)
    before = _held()
    method(pair)
    return peak_megabytes() - before


def _held() -> float:
    """Let the peak count from now on; the memory that is held [MB].

    What was freed goes back to the system first: a call that took it again would seem to need none.
    """
    ctypes.CDLL(None).malloc_trim(0)
    forget_peak()
    return peak_megabytes()


def _stages(pair: CloudPair) -> dict[str, float]:
    """The most memory of ours in each of the steps that it tells of, above that at the start [MB]."""
    most: dict[str, float] = {}
    before, step = _held(), "reading"

    def tell(next_step: str) -> None:
        nonlocal step
        most[step] = max(most.get(step, 0.0), peak_megabytes() - before)
        forget_peak()
        step = next_step

    ours(pair, tell)
    tell("")
    return most
