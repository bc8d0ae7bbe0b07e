"""What ``ok`` is worth: three rates with their limits, and the precision that they mean."""

from __future__ import annotations

from typing import NamedTuple

from scipy.stats import binomtest

CONFIDENCE = 0.95
SHARES = (0.9, 0.5, 0.05)  # of pairs that have an answer, in three imagined uses


class Rate(NamedTuple):
    """How often something happened."""

    hits: int
    of: int

    @property
    def share(self) -> float:
        """The share; 0 of nothing."""
        return self.hits / self.of if self.of else 0.0

    @property
    def low(self) -> float:
        """What the true share is above of, with confidence."""
        return self._limit("greater").low if self.of else 0.0

    @property
    def high(self) -> float:
        """What the true share is below of, with confidence."""
        return self._limit("less").high if self.of else 1.0

    def _limit(self, side: str):
        return binomtest(self.hits, self.of, alternative=side).proportion_ci(CONFIDENCE)


class Rates(NamedTuple):
    """How often ``ok`` was said where the answer was right, where it was wrong, and where there is none.

    Attributes:
        found: Right answers, of pairs that have one.
    """

    found: Rate
    right: Rate
    wrong: Rate
    none: Rate

    def precision(self, share: float) -> float:
        """How many of the poses called ok are right where that share of the pairs has an answer."""
        return _precision(share, self.found.share, self.right.share, self.wrong.share, self.none.share)

    def least_precision(self, share: float) -> float:
        """The same at the worse limits of the three rates of ``ok``."""
        return _precision(share, self.found.share, self.right.low, self.wrong.high, self.none.high)


def rates(rows: list[dict]) -> Rates:
    """Add up rows of the table; those of pairs without an answer have no ``answers``."""
    total = lambda name: sum(row[name] for row in rows)
    answers, right = total("answers"), total("right")
    empty = [row for row in rows if not row["answers"]]
    none, none_ok = (sum(row[name] for row in empty) for name in ("pairs", "ok"))
    ok_right = total("ok_right")
    return Rates(
        Rate(right, answers),
        Rate(ok_right, right),
        Rate(total("ok") - none_ok - ok_right, answers - right),
        Rate(none_ok, none),
    )


def _precision(share: float, found: float, right: float, wrong: float, none: float) -> float:
    good = share * found * right
    bad = share * (1 - found) * wrong + (1 - share) * none
    return good / (good + bad) if good + bad else 0.0
