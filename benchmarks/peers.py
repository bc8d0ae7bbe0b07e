"""Other libraries, asked about the cases of the benchmarks; the adapters are those of the studies."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from benchmarks.problems import Case
from teaser_jax.studies.peers import Peer as Adapter
from teaser_jax.studies.peers import Question, find_peers

# Names of the studies' peers that take part, and the most matches that they can be asked about.
MOST = {"TEASER++": None, "kiss-matcher": None, "Open3D FGR": 10_000, "Open3D RANSAC-10k": 1000}


class Peer(NamedTuple):
    """A case as another library takes it, ready to be timed, and the cases that it can be asked."""

    ask: Callable[[Case], Question]
    suits: Callable[[Case], bool]


def _asked(adapter: Adapter, most: int | None) -> Peer:
    # A scale that Open3D finds is a guess by other means: here it is asked about known ones.
    finds_scale = adapter.finds_scale and most is None

    def suits(case: Case) -> bool:
        return (case.scale is not None or finds_scale) and (most is None or len(case.src) <= most)

    return Peer(lambda case: adapter.ask(case.src, case.dst, case.noise_bound, case.scale), suits)


PEERS = {name: _asked(adapter, MOST[name]) for name, adapter in find_peers()[0].items() if name in MOST}


def peers_for(case: Case) -> dict[str, Callable[[Case], Question]]:
    """The peers of this environment that can be asked about a case."""
    return {name: peer.ask for name, peer in PEERS.items() if peer.suits(case)}
