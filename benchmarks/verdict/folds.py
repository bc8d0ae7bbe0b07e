"""The limits of the verdict, chosen on some places and judged on others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from teaser_jax.clouds.trust.judge import LIMITS, Evidence, Limits, verdict_of
from teaser_jax.clouds.trust.lead import Lead
from teaser_jax.clouds.trust.observability import Observability
from teaser_jax.clouds.trust.rivals import Rivals
from teaser_jax.solution import Status

FOLDS = 7
# Where folds begin: limits that nobody has chosen on these places.
LOOSE = Limits(fit=0.15, fine_fit=0.10, own=0.10, visible=0.004, beyond_planes=0.0, whole=0.0)
ROUNDS = 3
# What each limit is chosen from. Cells and free space are not: too few pairs come near theirs.
CHOICES: dict[str, Sequence[float]] = {
    "fit": (0.15, 0.20, 0.25, 0.30), "fine_fit": (0.10, 0.14, 0.18, 0.22),
    "own": (0.10, 0.14, 0.18, 0.22, 0.26), "visible": (0.004, 0.008, 0.016, 0.03),
    "equal": (0.65, 0.7, 0.75, 0.8, 0.85), "of_fit": (0.7, 0.76, 0.82, 0.88),
    "beyond_planes": (0.0, 0.005, 0.01, 0.02, 0.04, 0.06),
    "lead": (0.08, 0.1, 0.15, 0.2, 0.3, 0.4), "against": (0.1, 0.2, 0.3),
    "good_fit": (0.5, 0.6, 0.7, 0.8, 0.85, 0.9),
    "whole": (0.0, 0.5, 0.7, 0.8, 0.9, 0.95),
}  # fmt: skip
Row = dict[str, Any]


def evidence_of(row: Row) -> Evidence | None:
    """Read the evidence of a pair as it was recorded."""
    e = row["evidence"]
    if e is None:
        return None
    rivals = Rivals(e["equal"], e["rival_fit"], Lead(e["lead"], e["against"]), ())
    seen = Observability(np.array(e["visible"]), np.eye(6), np.zeros(3))
    return Evidence(
        voxel_size=1.0, fine_voxel_size=1.0, cells=e["cells"], fit=e["fit"], fine_fit=e["fine_fit"],
        overlap=e["overlap"], support=e["support"], in_front=e["in_front"], residual=0.0,
        beyond_planes=e["beyond_planes"], seen=seen,
        rivals=rivals,
    )  # fmt: skip


def is_ok(row: Row, limits: Limits = LIMITS) -> bool:
    """Tell whether a pair would be ok at these limits."""
    evidence = evidence_of(row)
    return evidence is not None and verdict_of(evidence, limits=limits).status == Status.OK


def value(rows: Sequence[Row], limits: Limits, price: float) -> float:
    """Count right answers that are ok, less a price for each wrong one."""
    ok = [row for row in rows if is_ok(row, limits)]
    right = sum(row["right"] for row in ok)
    return right - price * (len(ok) - right)


def fitted(rows: Sequence[Row], price: float = 20.0, start: Limits = LOOSE) -> Limits:
    """Choose limits one after the other, until none does better; where it makes no difference, none is moved.

    Args:
        rows: Pairs.
        price: Right answers that one wrong one that is ok is worth.
        start: Where to begin.
    """
    best = start
    for _ in range(ROUNDS):
        before = best
        for name, choices in CHOICES.items():
            tried = [best, *(best._replace(**{name: x}) for x in choices)]
            best = max(tried, key=lambda limits: value(rows, limits, price))  # the first of equal ones
        if best == before:
            break
    return best


def by_folds(rows: Sequence[Row], price: float = 20.0) -> list[bool]:
    """Tell which pairs are ok at limits chosen on the places of other folds."""
    names = sorted({row["place"] for row in rows})
    fold_of = {name: k % FOLDS for k, name in enumerate(names)}
    chosen = []
    for fold in range(FOLDS):
        chosen.append(fitted([row for row in rows if fold_of[row["place"]] != fold], price))
    return [is_ok(row, chosen[fold_of[row["place"]]]) for row in rows]
