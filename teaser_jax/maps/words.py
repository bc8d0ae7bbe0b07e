"""The words for a map: what it rests on, what was refused, and what to do."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import numpy as np

from teaser_jax.maps.cycles import Refusal

if TYPE_CHECKING:
    from teaser_jax.maps.result import CloudMap
else:
    CloudMap = Any  # it imports this file

LISTED = 8  # names, or refusals, that a summary lists


def fate(result: CloudMap, row: int) -> str:
    """Say in one line what became of a pair."""
    p, pair = result.placing, result.pairs[row]
    both = f"{result.names[pair.j]} to {result.names[pair.i]}"
    if not pair.ok:
        return f"{both}: not trusted, {pair.status.name} ({pair.doubt})"
    if row in p.refused:
        return f"{both}: refused, {_contradiction(result, p.refused[row])}"
    if row in p.strained:
        return (
            f"{both}: refused, it fits the ways between its clouds and not the map: off by "
            f"{p.strained[row] ** 0.5:.1f} standard deviations"
        )
    if row in p.withheld:
        return f"{both}: withheld, as many pairs contradict it and no cycle confirms it"
    single = ", alone: no cycle confirms it" if row in p.bridges else ""
    return f"{both}: kept{single}; {pair.displacement:.3g} expected"


def _contradiction(result: CloudMap, refusal: Refusal) -> str:
    gap, votes, against = refusal.gap, refusal.votes, refusal.against
    names = " - ".join(_some([result.names[k] for k in gap.nodes], 5))
    said = f"it contradicts the way {names} by {gap.shift:.3g} and {gap.turn:.1f} deg"
    if refusal.is_clear:
        return f"{said}, and {against} pairs stand against {votes}"
    return f"{said}; in doubt: {votes} for it and {against} against it, so either may be wrong"


def summary(result: CloudMap) -> str:
    """Tell a person about a map: how many clouds are placed, by what, and what to do."""
    p, n = result.placing, len(result)
    placed, trusted = int(p.placed.sum()), sum(pair.ok for pair in result.pairs)
    rows = [
        f"{'ok' if result.ok else 'NOT OK'}: {placed} of {n} clouds placed",
        f"  pairs        {len(result.pairs)} asked, {trusted} trusted by themselves, {len(p.kept)} kept, "
        f"{len(result.refused)} refused",
        f"  held         {int(p.confirmed.sum())} clouds by cycles, {_loose(result)} by single pairs alone",
        f"  engine       {result.engine}",
        f"  time         {sum(result.seconds.values()):.1f} s",
    ]
    if not p.placed.all():
        rows.append(f"  not placed   {_listed(result.names[k] for k in np.flatnonzero(~p.placed))}")
    rows += [f"  refused      {why}" for _, why in result.refused[:LISTED]]
    more = len(result.refused) - LISTED
    rows += [f"  refused      and {more} more, see report()"] if more > 0 else []
    return "\n".join([*rows, f"  {_advice(result)}"])


def report(result: CloudMap) -> str:
    """Tell of each pair what became of it, after the summary."""
    order = sorted(range(len(result.pairs)), key=lambda k: (result.pairs[k].i, result.pairs[k].j))
    return "\n".join([summary(result), "Pairs", *(f"  {fate(result, k)}" for k in order)])


def _advice(result: CloudMap) -> str:
    p = result.placing
    said = []
    if len(result.pairs) < result.asked:
        said.append(
            f"The time was over: {result.asked - len(result.pairs)} pairs were not asked. With a folder the "
            "same call goes on."
        )
    if not p.placed.any():
        said.append("No pair is trusted: check that neighbouring clouds share a third of what they show.")
    elif not p.placed.all():
        said.append("No trusted pair joins the others to the map: give clouds between them.")
    if result.doubts:
        said.append(
            "Pairs contradict others and are left out, but no one can tell which are right: places may look "
            "alike. Give more clouds there, which close more cycles."
        )
    if _loose(result):
        said.append("What rests on a single pair is as sure as that pair: a cycle would confirm it.")
    return " ".join(said) or "All clouds are placed, and every place is held by pairs that agree in cycles."


def _loose(result: CloudMap) -> int:
    return int((result.placed & ~result.confirmed).sum())


def _listed(names: Iterable[str]) -> str:
    return ", ".join(_some([*names], LISTED))


def _some(names: list[str], most: int) -> list[str]:
    """Shorten a list in its middle."""
    if len(names) <= most:
        return names
    return [*names[: most // 2], "...", *names[-(most - 1 - most // 2) :]]
