"""A peer in several processes at once, timed inside them.

Each process receives its share of the problems once and puts them into the peer's own terms. Then it waits
until all are ready, solves its share, and says how long that took by its own clock. What a process costs
besides (its start, the way of problems and answers between processes) is nobody's to pay.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from threading import Barrier
from time import perf_counter
from types import TracebackType
from typing import Any, Self

from teaser_jax import Pose
from teaser_jax.studies.peers import Question

PATIENCE = 60.0  # seconds that a process waits for the others to be ready


class Crew:
    """Processes that are asked about their shares of some cases, as often as wanted, all at the same time.

    Args:
        ask: Makes a case the question that is timed; a function of a module, which every process imports.
        processes: How many.
    """

    def __init__(self, ask: Callable[[Any], Question], processes: int) -> None:
        # Started afresh: a process that has threads must not be forked.
        context = get_context("spawn")
        self.start_together = context.Barrier(processes)  # held: who lets go of it takes it from all
        self.pipes, self.members = [], []
        with one_thread():
            for _ in range(processes):
                ours, theirs = context.Pipe()
                member = context.Process(target=_work, args=(ask, self.start_together, theirs), daemon=True)
                member.start()
                theirs.close()  # so that one who dies is noticed
                self.pipes.append(ours)
                self.members.append(member)

    def take(self, cases: list[Any]) -> list[Pose]:
        """Hand out cases, in place of those before; the answers, which also warm everything up."""
        count = len(self.pipes)
        for k, pipe in enumerate(self.pipes):
            pipe.send(cases[k::count])
        shares = [pipe.recv() for pipe in self.pipes]
        return [shares[k % count][k // count] for k in range(len(cases))]

    def seconds(self) -> float:
        """Of one round over all cases: those of the process that took longest."""
        for pipe in self.pipes:
            pipe.send(None)
        return max(pipe.recv() for pipe in self.pipes)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for pipe in self.pipes:
            pipe.close()  # which ends the work
        for member in self.members:
            member.join(PATIENCE)


@contextmanager
def one_thread() -> Iterator[None]:
    """Processes that start within have no threads besides: those would wait for one another."""
    before = os.environ.get("OMP_NUM_THREADS")
    os.environ["OMP_NUM_THREADS"] = "1"  # read once, when a library is loaded
    try:
        yield
    finally:
        del os.environ["OMP_NUM_THREADS"]
        if before is not None:
            os.environ["OMP_NUM_THREADS"] = before


def _work(ask: Callable[[Any], Question], start_together: Barrier, pipe: Connection) -> None:
    """A member: a list is its new share, None a round."""
    questions: list[Question] = []
    while True:
        try:
            share = pipe.recv()
        except EOFError:
            return
        if share is not None:
            questions = [ask(case) for case in share]
            pipe.send([question.answer() for question in questions])
            continue
        start_together.wait(PATIENCE)
        start = perf_counter()
        for question in questions:
            question.solve()
        pipe.send(perf_counter() - start)
