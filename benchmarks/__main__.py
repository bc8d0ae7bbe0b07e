"""Run benchmarks and write their tables: ``RESULTS.md`` for people, ``results/*.json`` for programs."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from benchmarks import (
    accelerator,
    accuracy,
    baseline,
    batch,
    certificate,
    clique,
    clouds,
    cold,
    gradients,
    growth,
    learning,
    speed,
    stream,
    trust,
)

HERE = Path(__file__).parent
BENCHMARKS = {
    "accuracy": accuracy,
    "trust": trust,
    "speed": speed,
    "clique": clique,
    "stream": stream,
    "cold": cold,
    "growth": growth,
    "certificate": certificate,
    "batch": batch,
    "accelerator": accelerator,
    "gradients": gradients,
    "learning": learning,
    "clouds": clouds,
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
        parts += [
            f"## {name}",
            "",
            module.report(record["rows"]),
            "",
            record["baseline"],
            "",
            f"*{where}*",
            "",
        ]
    (HERE / "RESULTS.md").write_text("\n".join(parts))


def main() -> None:
    """The command line; exits with 1 if a metric is worse than its baseline allows."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--only", nargs="+", choices=list(BENCHMARKS), default=list(BENCHMARKS))
    parser.add_argument("--quick", action="store_true", help="fewer runs, printed and not kept")
    parser.add_argument("--update-baseline", action="store_true", help="hold later runs against this one")
    options = parser.parse_args()
    if options.quick and options.update_baseline:
        parser.error("a quick run is no baseline: leave out --quick")
    worse = 0
    for name in options.only:
        module = BENCHMARKS[name]
        rows = module.run(quick=options.quick)
        if not rows:
            print(f"{name}: nothing to measure on this machine.", flush=True)
            continue
        print(module.report(rows), flush=True)
        if options.quick:
            continue
        metrics, where = module.metrics(rows), baseline.machine()
        if options.update_baseline:
            baseline.update(name, metrics, where)
        said, failed = baseline.compare(name, metrics, where)
        worse += failed
        print(f"\n{said}\n", flush=True)
        listed = [m._asdict() for m in metrics]
        record = {"machine": where, "baseline": said, "metrics": listed, "rows": rows}
        (HERE / "results").mkdir(exist_ok=True)
        (HERE / "results" / f"{name}.json").write_text(json.dumps(record, indent=1) + "\n")
        write_page()
    sys.exit(worse > 0)


if __name__ == "__main__":
    main()
