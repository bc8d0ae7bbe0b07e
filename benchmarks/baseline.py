"""Metrics with a unit, a direction and a tolerance, and what became of them since the baseline."""

from __future__ import annotations

import json
import os
import platform
import time
from importlib.metadata import version
from pathlib import Path
from typing import Literal, NamedTuple

BASELINE = Path(__file__).parent / "baseline.json"


def said(reached: bool) -> str:
    """Yes or no, for tables."""
    return "yes" if reached else "no"


class Metric(NamedTuple):
    """One number that a change must not make worse.

    Attributes:
        tolerance: The share of the baseline by which it may be worse.
        portable: Whether numbers of different machines can be compared.
    """

    name: str
    value: float
    unit: str
    better: Literal["lower", "higher"]
    tolerance: float
    portable: bool = True

    def change(self, before: Metric) -> float:
        """By which share of the baseline it got worse; negative: better."""
        worse = self.value - before.value if self.better == "lower" else before.value - self.value
        return worse / max(abs(before.value), 1e-12)


def machine() -> dict[str, str]:
    """What numbers are measured on."""
    import jax

    import teaser_jax
    from teaser_jax.studies.run import processor

    return {
        "device": f"{jax.devices()[0]} ({jax.devices()[0].device_kind})",
        "processor": processor(),
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
        "teaser_jax": teaser_jax.__version__,
        **{name: version(name) for name in ("jax", "numpy", "numba")},
        "date": time.strftime("%Y-%m-%d"),
    }


def update(name: str, metrics: list[Metric], where: dict[str, str]) -> None:
    """Make these numbers of a benchmark the ones that later runs are held against."""
    kept = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    kept[name] = {"machine": where, "metrics": [m._asdict() for m in metrics]}
    BASELINE.write_text(json.dumps(kept, indent=1) + "\n")


def compare(name: str, metrics: list[Metric], where: dict[str, str]) -> tuple[str, int]:
    """In words how a benchmark stands against its baseline, and how many metrics are worse.

    Times and memory of another machine are not held against each other, success and ratios are.
    """
    kept = json.loads(BASELINE.read_text()) if BASELINE.exists() else {}
    if name not in kept:
        return "No baseline.", 0
    old = kept[name]
    before = {m["name"]: Metric(**m) for m in old["metrics"]}
    hardware = ("device", "processor", "cores")
    same = all(where[key] == old["machine"][key] for key in hardware)
    held = [m for m in metrics if m.name in before and (same or m.portable)]
    worse = [m for m in held if m.change(before[m.name]) > m.tolerance]
    better = sum(m.change(before[m.name]) < -m.tolerance for m in held)
    than = f"the baseline ({old['machine']['processor']}, {old['machine']['date']})"
    lines = [
        f"Against {than}: {len(held)} metrics compared, {better} better and {len(worse)} worse beyond their "
        + ("tolerance." if same else "tolerance; times and memory are of another machine and left out.")
    ]
    lines += [
        f"- worse: {m.name}: {m.value:.4g} {m.unit}, was {before[m.name].value:.4g}, "
        f"tolerance {m.tolerance:.0%}"
        for m in worse
    ]
    missing = before.keys() - {m.name for m in metrics}
    lines += [f"- not measured: {name}" for name in sorted(missing)]
    return "\n".join(lines), len(worse)
