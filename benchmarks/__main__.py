"""Run benchmarks and write their tables: ``RESULTS.md`` for people, ``results/*.json`` for programs."""

from __future__ import annotations

import argparse
import json
import platform
import time
from importlib.metadata import version
from pathlib import Path

import jax

import teaser_jax
from benchmarks import accuracy, speed, trust

HERE = Path(__file__).parent
BENCHMARKS = {"accuracy": accuracy, "trust": trust, "speed": speed}


def machine() -> dict[str, str]:
    """What the numbers were measured on."""
    return {
        "device": str(jax.devices()[0]),
        "cpu": platform.processor() or platform.machine(),
        "python": platform.python_version(),
        "teaser_jax": teaser_jax.__version__,
        **{name: version(name) for name in ("jax", "numpy", "numba")},
        "date": time.strftime("%Y-%m-%d"),
    }


def write_page() -> None:
    """RESULTS.md from the JSON files: every number in it came out of a run."""
    parts = ["# Results", "", "Written by `python -m benchmarks`, never by hand.", ""]
    for name, module in BENCHMARKS.items():
        path = HERE / "results" / f"{name}.json"
        if not path.exists():
            continue
        record = json.loads(path.read_text())
        where = ", ".join(f"{k} {v}" for k, v in record["machine"].items())
        kind = "quick run, " if record["quick"] else ""
        parts += [f"## {name}", "", module.report(record["rows"]), "", f"*{kind}{where}*", ""]
    (HERE / "RESULTS.md").write_text("\n".join(parts))


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=list(BENCHMARKS), default=list(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="fewer runs; a look, not a result")
    options = parser.parse_args()
    for name in options.only:
        rows = BENCHMARKS[name].run(quick=options.quick)
        record = {"machine": machine(), "quick": options.quick, "rows": rows}
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / f"{name}.json").write_text(json.dumps(record, indent=1))
        print(BENCHMARKS[name].report(rows))
    write_page()


if __name__ == "__main__":
    main()
