"""What the tables of the studies say to a claim: right, wrong, or not run."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.studies.methods import LIMIT, OURS
from teaser_jax.studies.results import Results
from teaser_jax.studies.study import OVERLAP

NEARLY_ALL = 0.95  # of the runs
TLS, CONSENSUS = "TLS", "consensus maximisation"
Models = dict[str, dict[str, Results]]  # studies by name, of each model


@dataclass(frozen=True)
class Verdict:
    """A ``Verdict`` is what a table says to a claim.

    Attributes:
        found: What it says, in words and numbers.
        holds: Whether the claim, or something better, is reproduced; None where it is not tested.
    """

    found: str
    holds: bool | None = None


def median(results: Results, method: str, value: Number, column: str) -> float:
    """Return the median of a column in one cell; NaN where there is none."""
    numbers = results.measured(method, value, column)
    numbers = numbers[np.isfinite(numbers)]
    return float(np.median(numbers)) if len(numbers) else float("nan")


def up_to(results: Results, last: Number) -> list[Number]:
    """List the cells that are no harder than one of them: more overlap, or fewer wrong matches."""
    down = results.study.sweep == OVERLAP
    return [v for v in results.values if (v >= last if down else v <= last)]


def robust_to(method: str, last: Number) -> Callable[[Results], Verdict]:
    """Test that a method is right in nearly all runs up to a value (down to it, where overlap is swept)."""

    def test(results: Results) -> Verdict:
        down = results.study.sweep == OVERLAP
        cells = up_to(results, last)
        if method not in results.methods or last not in results.values:
            return Verdict("not run")
        worst = min(results.success(method, v) for v in cells)
        rest = [v for v in results.values if v not in cells]
        found = f"{method}: at least {worst:.0%} right {'down' if down else 'up'} to there"
        if rest:
            found += "; beyond: " + _listed(results, method, rest)
        return Verdict(found, worst >= NEARLY_ALL)

    return test


def breaks_at(word: str, value: Number) -> Callable[[Results], Verdict]:
    """Test that a method whose name holds a word fails at a value."""

    def say(results: Results, name: str) -> Verdict:
        near = [v for v in results.values if abs(v - value) < 0.25]
        found = f"{name}: {_listed(results, name, near)}"
        return Verdict(found, results.success(name, value) < NEARLY_ALL)

    return _of_one(word, value, say)


def holds_at(word: str, value: Number) -> Callable[[Results], Verdict]:
    """Test that a method whose name holds a word is right in nine of ten runs at a value."""

    def say(results: Results, name: str) -> Verdict:
        share, runs = results.success(name, value), len(results.of(name, value))
        return Verdict(f"{name}: {share:.0%} of {runs} right at {value:.0%}", share >= 0.9)

    return _of_one(word, value, say)


def best_at(word: str, value: Number) -> Callable[[Results], Verdict]:
    """Test that a method whose name holds a word is right more often than every other at a value."""

    def say(results: Results, name: str) -> Verdict:
        rest = {m: results.success(m, value) for m in results.methods if m not in (name, LIMIT)}
        second = max(rest, key=lambda m: np.nan_to_num(rest[m], nan=-1))
        share = results.success(name, value)
        return Verdict(f"{name}: {share:.0%}, then {second}: {rest[second]:.0%}", share > rest[second])

    return _of_one(word, value, say)


def _of_one(word: str, value: Number, say: Callable[[Results, str], Verdict]) -> Callable[[Results], Verdict]:
    """Make a test of the first method whose name holds a word, where it was run at a value."""

    def test(results: Results) -> Verdict:
        named = [m for m in results.methods if word in m]
        return say(results, named[0]) if named and results.of(named[0], value) else Verdict("not run")

    return test


def faster_than(method: str, milliseconds: Number) -> Callable[[Results], Verdict]:
    """Test that the median time of a method lies below a limit in every cell."""

    def test(results: Results) -> Verdict:
        if method not in results.methods:
            return Verdict("not run")
        slowest = max(1e3 * median(results, method, v, "seconds") for v in results.values)
        return Verdict(f"{method}: at most {slowest:.2f} ms (median of each cell)", slowest < milliseconds)

    return test


def less_robust(value: Number) -> Callable[[Results], Verdict]:
    """Test that consensus maximisation fails where TLS does not, or more often."""

    def test(results: Results) -> Verdict:
        if not {TLS, CONSENSUS} <= set(results.methods) or value not in results.values:
            return Verdict("not run")
        tls, consensus = (results.success(name, value) for name in (TLS, CONSENSUS))
        found = f"right at {value:.0%}: {TLS} {tls:.0%}, {CONSENSUS} {consensus:.0%}"
        return Verdict(found, tls > consensus)

    return test


def _listed(results: Results, method: str, values: Iterable[Number]) -> str:
    return ", ".join(f"{results.success(method, v):.0%} at {v:.0%}" for v in values)


def clique_prunes(results: Results) -> Verdict:
    """Test that below 10 % of what the maximum clique leaves is wrong."""
    method = "maximum clique"
    if method not in results.methods:
        return Verdict("not run")
    means = {v: float(np.mean(results.measured(method, v, "outliers_left"))) for v in results.values}
    worst = max(means, key=lambda v: means[v])
    kept = min(float(np.mean(results.measured(method, v, "inliers_kept"))) for v in results.values)
    found = (
        f"on average at most {means[worst]:.1%} wrong after it (at {worst:.0%}), {kept:.0%} of the right kept"
    )
    return Verdict(found, means[worst] < 0.1)


def gnc_finds_rotation(results: Results) -> Verdict:
    """Test that GNC is right below 80 % wrong vectors, and the others wherever it is."""
    parts = [f"{m}: {_listed(results, m, [v for v in results.values if v >= 0.7])}" for m in results.methods]
    if "GNC" not in results.methods:
        return Verdict("not run")
    good = all(results.success("GNC", v) >= 0.95 for v in results.values if v < 0.75)
    best = [m for m in results.methods if m != "GNC"]
    hardest = results.values[-1]
    beyond = all(results.success(m, hardest) >= results.success("GNC", hardest) for m in best)
    return Verdict("; ".join(parts), good and beyond)


def certificates_tell(results: Results) -> Verdict:
    """Test that all right answers of GNC are certified and no wrong one is."""
    method = "GNC, certified"
    if method not in results.methods:
        return Verdict("not run")
    rows = [row for v in results.values for row in results.of(method, v)]
    right = [row for row in rows if row["rotation_deg"] < 1]
    wrong = [row for row in rows if row["rotation_deg"] > 5]
    proved = sum(row["proved"] for row in right)
    false = sum(row["proved"] for row in wrong)
    iterations = np.mean([row["iterations"] for row in right])
    seconds = np.mean([row["seconds"] for row in right])
    found = (
        f"{proved:.0f} of {len(right)} right answers (below 1 deg) proved, {false:.0f} of {len(wrong)} wrong "
        f"ones (above 5 deg); {iterations:.1f} iterations and {1e3 * seconds:.0f} ms on average"
    )
    return Verdict(found, proved >= 0.99 * len(right) and false == 0 and bool(iterations <= 24))


def stages_that_dominate(results: Results) -> Verdict:
    """Tell which stages take most of the time."""
    method = f"{OURS}, stage by stage"
    if method not in results.methods:
        return Verdict("not run")
    parts = []
    for value in (results.values[0], results.values[-1]):
        times = {
            name.removeprefix("stage_"): 1e3 * median(results, method, value, name)
            for name in results.study.columns
            if name.startswith("stage_")
        }
        largest = sorted(times, key=lambda k: -np.nan_to_num(times[k]))[:3]
        listed = ", ".join(f"{name} {times[name]:.0f} ms" for name in largest)
        parts.append(f"at {value:.0%}: {listed} of {np.nansum(list(times.values())):.0f} ms")
    return Verdict("; ".join(parts))


def icp_fails(results: Results) -> Verdict:
    """Test that ICP is right in less than half of the runs, wherever it starts."""
    named = [m for m in results.methods if "ICP" in m]
    if not named:
        return Verdict("not run")
    best = max(results.success(named[0], v) for v in results.values)
    return Verdict(f"{named[0]}: at most {best:.0%} right", best < 0.5)


def noise_is_borne(results: Results) -> Verdict:
    """Test that errors stay near those of least squares on the true inliers."""
    if OURS not in results.methods:
        return Verdict("not run")
    angle = lambda method, v: median(results, method, v, "rotation_deg")
    parts = [f"{v:.0%}: {angle(OURS, v):.1f} deg, the limit {angle(LIMIT, v):.1f}" for v in results.values]
    close = all(angle(OURS, v) <= 1.5 * angle(LIMIT, v) for v in results.values if v < 0.75)
    return Verdict(f"median error of {OURS} at " + "; ".join(parts), close)


def growth_is_borne(results: Results) -> Verdict:
    """Test that problems of every size are solved."""
    if OURS not in results.methods:
        return Verdict("not run")
    parts = [
        f"{v:.0f}: {results.success(OURS, v):.0%} in {1e3 * median(results, OURS, v, 'seconds'):.3g} ms"
        for v in results.values
    ]
    return Verdict("; ".join(parts), all(results.success(OURS, v) >= 0.95 for v in results.values))


# How far the paper's solver is robust in each of its figures 6 and 7.
ROBUST_TO = {"known-scale": 0.9, "extreme": 0.99, "unknown-scale": 0.8, "all-to-all": 0.1}


def other_models(models: Models) -> Verdict:
    """Test that what holds for the teapot holds for every other model."""
    parts, worst = [], 1.0
    for model, found in models.items():
        told = []
        for study, last in ROBUST_TO.items():
            if study in found and OURS in found[study].methods and last in found[study].values:
                results = found[study]
                least = min(results.success(OURS, v) for v in up_to(results, last))
                told.append(f"{study} {least:.0%} to {last:.0%}")
                worst = min(worst, least)
        parts += [f"{model}: " + ", ".join(told)] if told else []
    if not parts:
        return Verdict("not run: `--model PATH` draws from any model")
    return Verdict("right, at least: " + "; ".join(parts), worst >= NEARLY_ALL)
