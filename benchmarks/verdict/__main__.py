"""Fit the verdict on raw clouds by folds over made-up places, and judge it on others.

``python -m benchmarks.verdict --places 8 -o pairs.jsonl``; whatever ends it, the same command goes on.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from benchmarks.clouds.rates import SHARES, Rate, Rates
from benchmarks.verdict.folds import CHOICES, Row, by_folds, fitted, is_ok
from benchmarks.verdict.record import record
from teaser_jax.clouds.trust.judge import LIMITS

REPORT = Path(__file__).parent.parent / "VERDICT.md"
HEAD = """# What `ok` of two raw clouds is worth

Made by `python -m benchmarks.verdict`: made-up rooms, corridors, streets, halls, hills and solids, each
scanned three times; every pair of scans of one place, and a pair of two places. An answer is right if it
displaces the overlap by less than two voxels. Numbers in brackets are limits with 95 % confidence: the true
rate is above the first and below the others. Where scans of a place hardly overlap, or see corners of empty
rooms, no one can tell, and few answers are right.
"""
HEADINGS = "| places | right answers | ok, given a right one | given a wrong one | given none |"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verdict", description=__doc__)
    parser.add_argument(
        "--places", type=int, default=8, help="of each kind to fit on, and as many to judge on"
    )
    parser.add_argument("--viewpoints", action="store_true", help="tell where the sensors stood")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("verdict.jsonl"), help="a line for each pair"
    )
    parser.add_argument("--report", type=Path, default=REPORT, help="where to write the tables")
    asked = parser.parse_args()
    rows = record(asked.output, 2 * asked.places, viewpoints=asked.viewpoints)
    asked.report.write_text(report(rows, asked.places))
    print(asked.report.read_text())


def report(rows: Sequence[Row], count: int) -> str:
    """Write the rates by kind: by folds over the first places, and at the limits as they are over all."""
    first = [row for row in rows if _number(row) < count]
    others = [row for row in rows if _number(row) >= count]
    best = fitted(first)
    chosen = ", ".join(f"{name} {getattr(best, name):g} ({getattr(LIMITS, name):g})" for name in CHOICES)
    parts = [
        HEAD,
        _table("Places that no limit was chosen on, at the limits as they are", others, _now(others)),
        _table("Places that the limits were chosen on", first, _now(first)),
        _table("The same by folds: limits chosen on six sevenths of the places", first, by_folds(first)),
        f"Limits that a fit to all of these places chooses, and in brackets those that stand: {chosen}.\n",
    ]
    return "\n".join(parts)


def _number(row: Row) -> int:
    return int(row["place"].split()[-1])


def _now(rows: Sequence[Row]) -> list[bool]:
    return [is_ok(row) for row in rows]


def _table(title: str, rows: Sequence[Row], oks: Sequence[bool]) -> str:
    lines = [f"## {title}", "", HEADINGS, "|---|---|---|---|---|"]
    for kind in [*dict.fromkeys(row["kind"] for row in rows), "all"]:
        some = [(row, ok) for row, ok in zip(rows, oks, strict=True) if kind in (row["kind"], "all")]
        found = rates([row for row, _ in some], [ok for _, ok in some])
        lines.append(f"| {kind} | {found.found.hits} of {found.found.of} | {_cells(found)} |")
    found = rates(rows, oks)
    precision = "; ".join(
        f"{found.precision(s):.1%} (> {found.least_precision(s):.0%}) where {s:.0%} of pairs have an answer"
        for s in SHARES
    )
    return "\n".join([*lines, "", f"Of the poses called `ok` are right: {precision}.", ""])


def rates(rows: Sequence[Row], oks: Sequence[bool]) -> Rates:
    """Count how often ok was said where the answer was right, where it was wrong, and where there is none."""
    pairs = list(zip(rows, oks, strict=True))
    kinds = (
        [ok for row, ok in pairs if row["answer"] and row["right"]],
        [ok for row, ok in pairs if row["answer"] and not row["right"]],
        [ok for row, ok in pairs if not row["answer"]],
    )
    answers = len(kinds[0]) + len(kinds[1])
    return Rates(Rate(len(kinds[0]), answers), *(Rate(sum(oks), len(oks)) for oks in kinds))


def _cells(found: Rates) -> str:
    right, wrong, none = found.right, found.wrong, found.none
    return " | ".join(
        [
            f"{right.hits} of {right.of} (> {right.low:.0%})",
            f"{wrong.hits} of {wrong.of} (< {wrong.high:.0%})",
            f"{none.hits} of {none.of} (< {none.high:.0%})",
        ]
    )


if __name__ == "__main__":
    main()
