"""What ``ok`` is worth: precision and recall on problems with and without an answer."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from itertools import chain

from scipy.stats import binomtest

import teaser_jax as tj
from benchmarks.baseline import Metric
from benchmarks.problems import (
    Case,
    all_wrong,
    mismatched_real_pairs,
    protocol,
    real_pairs,
    without_correspondences,
)  # fmt: skip
from teaser_jax.settings import ExactClique

NAMES = ("problems", "right", "ok", "right_and_ok")
# Dense graphs of wrong matches would use any budget, and the answer is wrong whatever it is.
HOPELESS = tj.Settings(clique=ExactClique(seconds=1.0))


def cases(quick: bool) -> Iterator[Case]:
    """1 000 problems with an answer, 1 000 without, the real ones, and the real ones mismatched."""
    k = 10 if quick else 1
    rates = [r / 10 for r in range(10)]
    right = [
        *(protocol(100, r, 36 // k) for r in rates),
        *(protocol(1000, r / 100, 36 // k) for r in range(95, 100)),
        *(protocol(100, r, 30 // k, unknown=True) for r in rates),
        *(protocol(1000, r, 10 // k, unknown=True) for r in (0.5, 0.8)),
        *(protocol(5000, r, 10 // k) for r in (0.95, 0.99)),
        *(without_correspondences(o, 24 // k) for o in (1.0, 0.8, 0.6, 0.4, 0.2)),
    ]
    wrong = all_wrong(
        {30: 300 // k, 100: 300 // k, 300: 210 // k, 1000: 120 // k, 3000: 45 // k, 5000: 30 // k}
    )
    return chain(*right, wrong, real_pairs(), mismatched_real_pairs())


def run(quick: bool) -> list[dict]:
    """A row a cell: problems, right answers, trusted answers, and both."""
    tally: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0, 0])
    for case in cases(quick):
        settings = HOPELESS if case.truth is None else tj.Settings()
        result = tj.register(
            case.src, case.dst, noise_bound=case.noise_bound, scale=case.scale, settings=settings
        )
        right, ok = case.is_right(result.pose), result.ok
        for i, hit in enumerate((True, right, ok, right and ok)):
            tally[case.cell][i] += hit
    return [{"cell": cell, **dict(zip(NAMES, counts, strict=True))} for cell, counts in tally.items()]


def _total(rows: list[dict]) -> dict[str, int]:
    return {name: sum(row[name] for row in rows) for name in NAMES}


def metrics(rows: list[dict]) -> list[Metric]:
    """Precision and recall of ``ok``."""
    total = _total(rows)
    both = total["right_and_ok"]
    return [
        Metric("precision of ok", both / total["ok"], "share", "higher", 0.002),
        Metric("recall of ok", both / total["right"], "share", "higher", 0.005),
    ]


def report(rows: list[dict]) -> str:
    """Precision and recall with their one-sided 95 % confidence limits, then every cell."""
    total = _total(rows)

    def share(hits: int, of: int) -> str:
        limit = binomtest(hits, of, alternative="greater").proportion_ci(0.95).low
        return f"{100 * hits / of:.2f} % ({hits} of {of}; above {100 * limit:.2f} % with 95 % confidence)"

    lines = [
        "What `ok` is worth, over all problems below (clique budget 1 s where no match is right):",
        "",
        f"- precision, answers called ok that are right: {share(total['right_and_ok'], total['ok'])}",
        f"- recall, right answers that are called ok: {share(total['right_and_ok'], total['right'])}",
        "",
        "| cell | problems | right | ok | right and ok |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {r['cell']} | {r['problems']} | {r['right']} | {r['ok']} | {r['right_and_ok']} |" for r in rows
    ]
    return "\n".join(lines)
