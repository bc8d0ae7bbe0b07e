"""Fit the verdict on raw clouds by folds over made-up places.

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


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.verdict", description=__doc__)
    parser.add_argument("--places", type=int, default=8, help="of each kind")
    parser.add_argument(
        "--first", type=int, default=0, help="number of the first place: 8 and more were not fitted on"
    )
    parser.add_argument("--viewpoints", action="store_true", help="tell where the sensors stood")
    parser.add_argument(
        "-o", "--output", type=Path, default=Path("verdict.jsonl"), help="a line for each pair"
    )
    asked = parser.parse_args()
    rows = record(asked.output, asked.places, first=asked.first, viewpoints=asked.viewpoints)
    print(report(rows))


def report(rows: Sequence[Row]) -> str:
    """Write the rates by kind, at the limits as they are and at those of folds, and the limits of a fit."""
    lines = [
        "ok given a right answer, a wrong one, none: at the limits as they are; chosen by folds over places",
        "",
    ]
    now, folded = [is_ok(row) for row in rows], by_folds(rows)
    for kind in [*dict.fromkeys(row["kind"] for row in rows), "all"]:
        of = [row["kind"] == kind or kind == "all" for row in rows]
        some = [row for row, x in zip(rows, of, strict=True) if x]
        cells = [
            _cells(rates(some, [ok for ok, x in zip(oks, of, strict=True) if x])) for oks in (now, folded)
        ]
        lines.append(f"{kind:10} {cells[0]}   |   {cells[1]}")
    for name, oks in (("as they are", now), ("by folds", folded)):
        found = rates(rows, oks)
        precision = ", ".join(
            f"{found.precision(s):.1%} (at least {found.least_precision(s):.1%}) at {s:.0%}" for s in SHARES
        )
        lines.append(f"precision {name}: {precision} of pairs with an answer")
    best = fitted(rows)
    chosen = ", ".join(f"{name} {getattr(best, name):g} ({getattr(LIMITS, name):g})" for name in CHOICES)
    return "\n".join([*lines, f"chosen on all places (as they are): {chosen}"])


def rates(rows: Sequence[Row], oks: Sequence[bool]) -> Rates:
    """Count how often ok was said where the answer was right, where it was wrong, and where there is none."""
    rate = lambda kind: Rate(
        sum(ok for row, ok in zip(rows, oks, strict=True) if kind(row)), sum(1 for row in rows if kind(row))
    )
    answers = [row for row in rows if row["answer"]]
    return Rates(
        Rate(sum(row["right"] for row in answers), len(answers)),
        rate(lambda row: row["answer"] and row["right"]),
        rate(lambda row: row["answer"] and not row["right"]),
        rate(lambda row: not row["answer"]),
    )


def _cells(found: Rates) -> str:
    """Write three rates with their limits: hits of cases, and what the true share is above or below of."""
    right, wrong, none = found.right, found.wrong, found.none
    return (
        f"{right.hits:3} of {right.of:3} (> {right.low:4.0%})"
        f"  {wrong.hits:2} of {wrong.of:3} (< {wrong.high:4.0%})"
        f"  {none.hits:2} of {none.of:3} (< {none.high:4.0%})"
    )


if __name__ == "__main__":
    main()
