"""How to solve: a record for each choice. What may be asked for is checked here and in the records.

    Settings(clique="greedy")                          # a name stands for the record with its defaults
    Settings(clique=ExactClique(seconds=5.0))          # numbers are those of the record
    Settings(rotation=Gnc(factor=1.2), refine=False)

Choices and caps are compiled into programs; numbers (factors, tolerances, ranges, budgets) are sent to them,
so that new ones compile nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from functools import lru_cache
from typing import Any, Literal, TypeAlias, get_args

import jax
import numpy as np

from teaser_jax.ground.checks import one_of, shown
from teaser_jax.ground.numbers import as_record, check_concrete
from teaser_jax.stages.clique.clique import CliqueMethod
from teaser_jax.stages.clique.every_match import EveryMatch
from teaser_jax.stages.clique.exact import ExactClique
from teaser_jax.stages.clique.greedy import GreedyClique
from teaser_jax.stages.clique.oracle import NetworkxClique
from teaser_jax.stages.refinement import Refinement
from teaser_jax.stages.rotation.gnc import Gnc
from teaser_jax.stages.rotation.pair_search import PairSearch
from teaser_jax.stages.rotation.relaxation import Relaxation
from teaser_jax.stages.rotation.robust import RotationMethod
from teaser_jax.stages.scale import ScaleVote
from teaser_jax.stages.vote.sweep import Criterion

TimGraph: TypeAlias = Literal["chain", "complete"]

# What each choice may be, and the names that stand for the records with their defaults.
SCALES = {method.name: method for method in (ScaleVote,)}
CLIQUES = {method.name: method for method in (ExactClique, GreedyClique, NetworkxClique, EveryMatch)}
ROTATIONS = {method.name: method for method in (Gnc, PairSearch, Relaxation)}
METHODS: dict[str, dict[str, Any]] = {"scale_search": SCALES, "clique": CLIQUES, "rotation": ROTATIONS}


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Settings:
    """How to solve. Choices and caps are static under jit, numbers are traced.

    A name or a truth value stands for the record with its defaults, and equals it:
    ``Settings(clique="greedy") == Settings(clique=GreedyClique())``.

    Attributes:
        scale_search: How an unknown scale is found: ``"vote"``, that is ``ScaleVote(range)``.
        vote: Scalar estimates by ``"tls"`` (11) or by maximum ``"consensus"``.
        clique: How wrong matches are pruned: ``"exact"``, that is ``ExactClique(nodes, seconds)``;
            ``"greedy"``; ``"networkx"``, the slow oracle; ``"none"``, not at all.
        tim_graph: TIMs of the rotation stage: ``"chain"`` of consecutive clique members, closed
            to a ring, or the ``"complete"`` graph of the clique. Given pairs take their place.
        rotation: How the rotation is found: ``"gnc"``, that is ``Gnc(factor, tolerance, iterations)``;
            ``"global"``, that is ``PairSearch(gnc)``; ``"sdp"``, that is ``Relaxation(gnc)``, on the host.
        refine: Whether the joint cost (6) is descended last: True, that is ``Refinement(iterations)``;
            False, that is None, gives the paper's plain cascade.

    Raises:
        ValueError: If a name is unknown or a number out of range. What is no record at all is refused by the
            function that is called with the settings, because JAX rebuilds them from placeholders.
    """

    scale_search: ScaleVote | Any = ScaleVote()
    vote: Criterion = field(default="tls", metadata={"static": True})
    clique: CliqueMethod | Any = ExactClique()
    tim_graph: TimGraph = field(default="chain", metadata={"static": True})
    rotation: RotationMethod | Any = Gnc()
    refine: Refinement | None | Any = Refinement()

    def __post_init__(self) -> None:
        one_of("Settings.vote", self.vote, get_args(Criterion))
        one_of("Settings.tim_graph", self.tim_graph, get_args(TimGraph))
        for name, known in METHODS.items():
            object.__setattr__(self, name, as_record(f"Settings.{name}", getattr(self, name), known))
        if isinstance(self.refine, str):
            one_of("Settings.refine", self.refine, (True, False))
        if isinstance(self.refine, bool | np.bool_):
            object.__setattr__(self, "refine", Refinement() if self.refine else None)

    def __repr__(self) -> str:
        chosen = [f"{each.name}={getattr(self, each.name)!r}" for each in fields(self)]
        usual = [f"{each.name}={each.default!r}" for each in fields(self)]
        return f"Settings({', '.join(x for x, default in zip(chosen, usual, strict=True) if x != default)})"


def check_record(name: str, record: Any, known: dict[str, Any]) -> None:
    """Check that a choice is one of the known records, and that its numbers are known. Raises ValueError."""
    if not isinstance(record, tuple(known.values())):
        usual = ", ".join(f"{name!r} or {method.__name__}(...)" for name, method in known.items())
        raise ValueError(f"{name} is {shown(record)}: expected {usual}.")
    check_concrete(record)
    first = getattr(record, "gnc", Gnc())
    if not isinstance(first, Gnc):
        raise ValueError(f"{type(record).__name__}.gnc is {shown(first)}: expected a Gnc(...).")
    check_concrete(first)


def check_settings(settings: Any) -> None:
    """Check what records cannot check themselves, because JAX rebuilds them from placeholders.

    Raises:
        ValueError: If these are no settings, a method is none, or a number is missing or out of range.
    """
    try:
        _check_plain(settings)
    except TypeError:  # numbers that have no hash, as those of arrays
        _check(settings)


def _check(settings: Any) -> None:
    """Check settings whose numbers may be arrays or tracers."""
    if not isinstance(settings, Settings):
        raise ValueError(
            f"settings is {shown(settings)}: expected Settings, as in Settings(clique='greedy')."
        )
    for name, known in METHODS.items():
        check_record(f"Settings.{name}", getattr(settings, name), known)
    if not isinstance(settings.refine, Refinement | None):
        one_of("Settings.refine", settings.refine, (True, False))
    settings.scale_search.check_concrete()


# The same settings come thousands of times; to check them takes 40 us, a fiftieth of a small problem.
_check_plain = lru_cache(maxsize=256)(_check)
