"""A batch on the devices of this process: chunk by chunk, each device, host, device."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Int

from teaser_jax.agreement import Graph
from teaser_jax.engine.compaction import rows_for
from teaser_jax.engine.frames import Centred, centred, with_origins, without_padding
from teaser_jax.engine.groups import by_shape, pack_list
from teaser_jax.engine.packing import PackedProblem, hide_rows, pack_problem, unpack
from teaser_jax.engine.programs import Programs, device_kind, on_mesh, run_length, sharding_over
from teaser_jax.engine.sizes import Size, size_of
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.problem import Problem
from teaser_jax.settings import Settings
from teaser_jax.solution import Solution
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.maximum import finish_on_host

# Threads: while some are on the host, others keep the devices busy. A CPU solves one run with little more
# than one core, and packing for an accelerator takes longer than solving there.
WORKERS = max(2, min(8, os.cpu_count() or 1))
RUNS_A_CHUNK = 4  # of the small runs of a CPU

Indices: TypeAlias = Int[np.ndarray, "_"]  # as many as may be
Group: TypeAlias = "tuple[Indices, Problem | list[Problem]]"  # places in the batch, and problems of one size
Chunk: TypeAlias = "tuple[Indices, Solution]"  # places in the batch, and their solutions, padded


def solve_groups(
    groups: list[Group], mesh: Mesh, settings: Settings, chunk_size: int | None, progress: bool
) -> Iterator[Chunk]:
    """Solve problems in chunks; each is yielded in order, as soon as it and those before it are solved.

    Args:
        groups: Problems of one size each, with their places.
        mesh: Devices of this process.
        settings: How to solve.
        chunk_size: Problems a chunk, rounded up to whole runs of a program; None: as many as suit.
        progress: Whether to show a bar.
    """
    from tqdm import tqdm

    solver = Solver(mesh, settings)
    chunks = []
    for places, problems in groups:
        length = solver.chunk_length(problems, chunk_size, len(places))
        chunks += [
            (places[k : k + length], problems, slice(k, k + length)) for k in range(0, len(places), length)
        ]
    with (
        ThreadPoolExecutor(WORKERS) as pool,
        tqdm(total=sum(len(p) for p, _ in groups), disable=not progress, unit="problem") as bar,
    ):
        waiting = [pool.submit(solver.solve, problems, rows) for _, problems, rows in chunks]
        try:
            for (places, _, _), answer in zip(chunks, waiting, strict=True):
                yield places, answer.result()
                bar.update(len(places))
        finally:
            for each in waiting:
                each.cancel()


def as_stack(chunks: Iterator[Chunk], mine: Indices) -> Solution:
    """Assemble the solutions of a stack, written into place as the chunks come in."""
    whole: Any = None
    for places, solution in chunks:
        if whole is None:
            whole = jax.tree.map(lambda x: np.empty((len(mine), *x.shape[1:]), x.dtype), solution)
        rows = places - mine[0]
        for into, leaf in zip(jax.tree.leaves(whole), jax.tree.leaves(solution), strict=True):
            into[rows] = leaf
    return whole


def as_list(chunks: Iterator[Chunk], problems: list[Problem]) -> list[Solution]:
    """Assemble the solutions of a list, each in the rows of its own problem."""
    answers: list[Any] = [None] * len(problems)
    for places, solution in chunks:
        chunk = [problems[place] for place in places]
        for rows in by_shape(chunk).values():
            leaves, form = jax.tree.flatten(without_padding(solution, chunk[rows[0]]))
            for row in rows:
                answers[places[row]] = jax.tree.unflatten(form, [leaf[row] for leaf in leaves])
    return answers


class Run(NamedTuple):
    """Problems that went through the first program side by side, and what the devices hold of them."""

    which: Indices  # in the chunk
    sent: PackedProblem
    graph: Graph
    clique: Clique
    settled: Bool[Any, " b"]


@dataclass(frozen=True)
class Solver:
    """Solves chunks on a mesh of this process; its threads share the compiled programs."""

    mesh: Mesh
    settings: Settings
    turn: Lock = field(default_factory=Lock)  # of a thread to use an accelerator

    @property
    def on_cpu(self) -> bool:
        """Whether host and devices are the same."""
        return device_kind(self.mesh) == "cpu"

    @cached_property
    def programs(self) -> Programs:
        """The programs for these settings on this mesh."""
        return on_mesh(jax.tree.structure(self.settings), self.mesh)

    def run_length(self, size: Size) -> int:
        """Count the problems that go through the programs side by side."""
        return run_length(size, device_kind(self.mesh)) * self.mesh.size

    def chunk_length(self, problems: Problem | list[Problem], chunk_size: int | None, count: int) -> int:
        """Choose how many of ``count`` problems make a chunk: whole runs, by default some for all threads."""
        run = self.run_length(size_of(problems if isinstance(problems, Problem) else problems[0]))
        most = RUNS_A_CHUNK if self.on_cpu else 1
        runs = min(most, -(-count // (WORKERS * run))) if chunk_size is None else -(-chunk_size // run)
        return run * runs

    def solve(self, problems: Problem | list[Problem], rows: slice) -> Solution:
        """Solve a chunk, in its own frames; solutions of a list stay padded, those of a stack do not."""
        if isinstance(problems, Problem):
            some = jax.tree.map(lambda x: x[rows], problems)
            size = size_of(some)
            return without_padding(self._solve(pack_problem(some, self.settings, size), size), some)
        size = size_of(problems[0])
        return self._solve(pack_list(problems[rows], self.settings, size), size)

    def _solve(self, sent: PackedProblem, size: Size) -> Solution:
        """Solve packed problems of one size."""
        near = centred(sent)
        with as_on_the_host():  # of this thread only
            runs, clique = self._find_cliques(near, size)
            solution = unpack(self._conclude(near.sent, runs, clique, size))
        return with_origins(solution, near.origins)

    def _find_cliques(self, near: Centred, size: Size) -> tuple[list[Run], Clique]:
        """Send all problems through the first program, and search on the host what it leaves open."""
        length = self.run_length(size)
        runs = []
        for which, narrow in in_runs(near.narrow, length):
            there = self._put(chosen_problems(near.sent, which, length))
            runs.append(Run(which, there, *self._run(self.programs.before, there, narrow)))
        searched = [self._search(run) for run in runs]
        runs = [run for run, _ in searched]
        return runs, in_order([run.which for run in runs], [clique for _, clique in searched])

    def _search(self, run: Run) -> tuple[Run, Clique]:
        """Finish the cliques of a run; they are returned on the devices, and in numpy."""
        count = len(run.which)
        clique, settled = first_of((run.clique, run.settled), count)
        if settled.all():
            return run, clique
        edge_bits, mask = first_of((run.graph.edge_bits, run.graph.mask), count)
        clique = finish_on_host(self.settings.clique, edge_bits, mask, clique)
        everywhere = filled_up(clique, np.arange(count), len(run.sent.columns))
        return run._replace(clique=self._put(everywhere)), clique

    def _conclude(self, sent: PackedProblem, runs: list[Run], clique: Clique, size: Size) -> Any:
        """Send all problems through the second program, and return what it found, in numpy."""
        length = self.run_length(size)
        graph, answers = None, []
        chosen = in_runs(rows_for(size, self.settings, np.sum(clique.members, axis=1)), length)
        for which, few in chosen:
            run = next((run for run in runs if np.array_equal(run.which, which)), None)
            if run is not None:
                there = run.sent, run.graph, run.clique
            else:  # not as they went through the first: by way of the host
                if graph is None:
                    graphs = [first_of(run.graph, len(run.which)) for run in runs]
                    graph = in_order([run.which for run in runs], graphs)
                company = filled_up((graph, clique), which, length)
                there = self._put((chosen_problems(sent, which, length), *company))
            answers.append(self._run(self.programs.after, *there, few))
        places = [which for which, _ in chosen]
        return in_order(places, [first_of(x, len(k)) for k, x in zip(places, answers, strict=True)])

    # Threads that leave the order of transfers and programs on a GPU to JAX (0.11) now and then, once in some
    # million problems, had a program start before the last of its problems were there. So they wait.

    def _put(self, arrays: Any) -> Any:
        """Put arrays onto the devices, a share on each."""
        there = jax.device_put(arrays, sharding_over(self.mesh))
        return there if self.on_cpu else jax.block_until_ready(there)

    def _run(self, program: Callable[..., Any], *args: Any) -> Any:
        """Run a program; on accelerators alone and to its end, which costs nothing: other threads pack."""
        if self.on_cpu:
            return program(*args)
        with self.turn:
            return jax.block_until_ready(program(*args))


def in_runs(choice: np.ndarray, length: int) -> list[tuple[Indices, Any]]:
    """Group problems into runs, each with what was chosen for it: those that chose alike share runs."""
    alike = [(np.flatnonzero(choice == each), each.item()) for each in np.unique(choice)]
    return [(which[k : k + length], each) for which, each in alike for k in range(0, len(which), length)]


def in_order(which: Sequence[Indices], parts: Sequence[Any]) -> Any:
    """Join what the runs have found into one stack, in the order of the chunk."""
    order = np.concatenate(which)
    whole = jax.tree.map(lambda *x: np.concatenate(x), *parts)  # may be written to, as numpy's may
    if np.all(order[:-1] < order[1:]):
        return whole
    back = np.argsort(order)
    return jax.tree.map(lambda x: x[back], whole)


def first_of(arrays: Any, count: int) -> Any:
    """Take the first ``count`` rows of arrays, in numpy."""
    return jax.tree.map(lambda x: np.asarray(x)[:count], arrays)


def chosen_problems(sent: PackedProblem, which: Indices, length: int) -> PackedProblem:
    """Take the problems of the given places; what fills the run repeats the first, with its rows masked."""
    filled = filled_up(sent, which, length)
    if len(which) < length:
        hide_rows(filled, len(which))
    return filled


def filled_up(arrays: Any, which: Indices, length: int) -> Any:
    """Take the given places of arrays; what fills the run repeats the first."""
    if len(which) == length == which[-1] - which[0] + 1:  # all in one piece: nothing is copied
        return jax.tree.map(lambda x: x[which[0] : which[0] + length], arrays)
    fill = np.append(which, np.repeat(which[:1], length - len(which)))
    return jax.tree.map(lambda x: x[fill], arrays)
