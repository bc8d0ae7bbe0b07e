"""Many problems in one call: device, host, device, in chunks, on all devices and in all processes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from threading import Lock
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int
from tqdm import tqdm

from teaser_jax.batch.groups import (
    Ready,
    Size,
    by_shape,
    by_size,
    centred,
    pack_list,
    read_list,
    read_stack,
    size_of,
)
from teaser_jax.batch.processes import all_of, check_agreement, local_mesh, share
from teaser_jax.batch.programs import Programs, platform, programs, rooms, unit
from teaser_jax.ground.checks import whole_number
from teaser_jax.packing import PackedProblem, choices_of, pack_problem, unpack_solution
from teaser_jax.register import check_settings, with_origins, without_padding
from teaser_jax.solve import Graph
from teaser_jax.stages.clique import Clique, search_batch_on_host
from teaser_jax.types import Problem, Settings, Solution

# Threads: while some are on the host, others keep the devices busy. A CPU solves one run with little more
# than one core, and packing for an accelerator takes longer than solving there.
WORKERS = max(2, min(8, os.cpu_count() or 1))
RUNS_A_CHUNK = 4  # of the small runs of a CPU


def solve_batch(
    problems: Sequence[Problem] | Problem,
    settings: Settings = Settings(),
    *,
    mesh: Mesh | None = None,
    chunk_size: int | None = None,
    progress: bool = False,
) -> list[Solution] | Solution:
    """``solve`` for thousands of problems, on every device there is; outside jit, in float64.

    Problems are sorted by size, padded to the sizes of ``register`` and solved some at a time by a few
    compiled programs a size: one up to the clique, and one for each of up to four classes of clique sizes.
    An answer depends on its own problem alone, bit for bit: not on its neighbours, their order, the
    chunks or the number of devices. A problem that cannot be solved says so in its status.

    Points are read as they are; ``make_problem`` rounds to float32 unless JAX's x64 is on, and
    ``host_problem`` does not.

    Args:
        problems: Problems of any sizes, or a stack of them as from ``stack_problems``.
        settings: The same for all. ``rotation="sdp"`` is a solver on the host: not here.
        mesh: Devices to use, as a ``jax.sharding.Mesh`` of any shape; None: all. Where it spans processes
            (``jax.distributed``), each of them calls with the same problems, solves its share, and
            receives all answers.
        chunk_size: Problems packed, sent and fetched at a time, rounded up to whole runs of a program;
            None: what a few megabytes hold.
        progress: Show a bar with the time left.

    Returns:
        Solutions in numpy, in the order of the problems: a list for a list, a stack for a stack.

    Raises:
        ValueError: On arrays that do not belong together, with the number of the problem; under jit,
            where ``jax.vmap(solve)`` is the function to use; on settings that make no sense; where
            processes call with different problems.

    Gradients: none; ``jax.vmap(solve)`` has them.
    """
    check_settings(settings)
    if settings.rotation == "sdp":
        raise ValueError('Settings(rotation="sdp") is solved on the host, one by one: use solve or register.')
    if chunk_size is not None:
        chunk_size = whole_number("chunk_size", chunk_size, 1, what="how many problems to send")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is of type {type(mesh).__name__}: expected a jax.sharding.Mesh.")
    if mesh is not None and mesh.size == 0:
        raise ValueError("mesh has no device: give one that has, or None for all there are.")
    if isinstance(problems, Problem):
        stack = read_stack(problems)
        check_agreement("solve_batch", (stack, repr(settings)))
        count = len(stack.src)
        if count == 0:
            raise ValueError("solve_batch received a stack of no problem.")
        part = share(count, mesh)
        mine, chosen = np.arange(count)[part], jax.tree.map(lambda x: x[part], stack)
        parts = [(mine, chosen)] if len(mine) else []
        whole = _filled(parts, lambda chunks: _stacked(chunks, mine), mesh, settings, chunk_size, progress)
        found = [each for each in all_of(whole) if each is not None]
        return jax.tree.map(lambda *x: np.concatenate(x), *found)
    if not isinstance(problems, Sequence) or isinstance(problems, str | bytes):
        raise ValueError(
            f"problems is of type {type(problems).__name__}: expected a list of Problem, or a stacked one."
        )
    listed = read_list(problems)
    check_agreement("solve_batch", (listed, repr(settings)))
    mine = np.arange(len(listed))[share(len(listed), mesh)]
    local = [listed[k] for k in mine]
    parts = [(places, [local[k] for k in places]) for places in by_size(local).values()]
    answers = _filled(parts, lambda chunks: _listed(chunks, local), mesh, settings, chunk_size, progress)
    return [each for some in all_of(answers) for each in some or ()]


Rows = Int[np.ndarray, " b"]
Part = tuple[Rows, "Problem | list[Problem]"]
Chunk = tuple[Rows, Solution]


def _filled(
    parts: list[Part], assemble: Any, mesh: Any, settings: Settings, chunk_size: Any, bar: bool
) -> Any:
    """What ``assemble`` makes of the solved chunks; None where this process has no device or problem."""
    devices = local_mesh(mesh)
    if devices is None or not parts:
        return None
    return assemble(_solved(parts, devices, settings, chunk_size, bar))


def _solved(
    parts: list[Part], mesh: Mesh, settings: Settings, chunk_size: int | None, progress: bool
) -> Iterator[Chunk]:
    """The chunks in order, each as soon as it and those before it are solved."""
    solver = Solver(mesh, settings)
    chunks = [
        (places[k : k + length], problems, slice(k, k + length))
        for places, problems in parts
        for length in [solver.length(problems, chunk_size, len(places))]
        for k in range(0, len(places), length)
    ]
    with (
        ThreadPoolExecutor(WORKERS) as pool,
        tqdm(total=sum(len(p) for p, _ in parts), disable=not progress, unit="problem") as bar,
    ):
        waiting = [pool.submit(solver.solve, problems, rows) for _, problems, rows in chunks]
        try:
            for (places, _, _), answer in zip(chunks, waiting, strict=True):
                yield places, answer.result()
                bar.update(len(places))
        finally:
            for each in waiting:
                each.cancel()


def _stacked(chunks: Iterator[Chunk], mine: np.ndarray) -> Solution:
    """One stack, written as the chunks come in."""
    whole: Any = None
    for places, solution in chunks:
        if whole is None:
            whole = jax.tree.map(lambda x: np.empty((len(mine), *x.shape[1:]), x.dtype), solution)
        rows = places - mine[0]
        for into, leaf in zip(jax.tree.leaves(whole), jax.tree.leaves(solution), strict=True):
            into[rows] = leaf
    return whole


def _listed(chunks: Iterator[Chunk], problems: list[Problem]) -> list[Solution]:
    """One solution a problem, in its own rows."""
    answers: list[Any] = [None] * len(problems)
    for places, solution in chunks:
        chunk = [problems[place] for place in places]
        for rows in by_shape(chunk).values():
            leaves, form = jax.tree.flatten(without_padding(solution, chunk[rows[0]]))
            for row in rows:
                answers[places[row]] = jax.tree.unflatten(form, [leaf[row] for leaf in leaves])
    return answers


@dataclass(frozen=True)
class Solver:
    """Solves chunks on a mesh of this process; its threads share the compiled programs."""

    mesh: Mesh
    settings: Settings
    turn: Lock = field(default_factory=Lock)  # of a thread to use an accelerator

    def run_length(self, size: Size) -> int:
        """Problems in one run of the programs."""
        return unit(size, platform(self.mesh)) * self.mesh.size

    @property
    def on_cpu(self) -> bool:
        """Whether host and devices are the same."""
        return platform(self.mesh) == "cpu"

    def length(self, problems: Problem | list[Problem], chunk_size: int | None, count: int) -> int:
        """Problems in a chunk, of so many: whole runs, and by default something for every thread."""
        run = self.run_length(size_of(problems if isinstance(problems, Problem) else problems[0]))
        most = RUNS_A_CHUNK if self.on_cpu else 1
        runs = min(most, -(-count // (WORKERS * run))) if chunk_size is None else -(-chunk_size // run)
        return run * runs

    def solve(self, problems: Problem | list[Problem], rows: slice) -> Solution:
        """A chunk, in its own frames; of a stack without padding, of a list with it."""
        if isinstance(problems, Problem):
            some = jax.tree.map(lambda x: x[rows], problems)
            size = size_of(some)
            return without_padding(self._solve(pack_problem(some, self.settings, size.n, size.m), size), some)
        size = size_of(problems[0])
        return self._solve(pack_list(problems[rows], self.settings, size), size)

    def _solve(self, sent: PackedProblem, size: Size) -> Solution:
        ready = centred(sent)
        with jax.enable_x64(True):  # of this thread only
            runs, clique = self._until_cliques(ready, size)
            solution = unpack_solution(self._since_cliques(ready.sent, runs, clique, size))
        return solution if ready.origins is None else with_origins(solution, *ready.origins)

    def _until_cliques(self, ready: Ready, size: Size) -> tuple[list[Run], Clique]:
        """The first program on all problems, and the host's search where it has no proof."""
        length, before = self.run_length(size), self.compiled.before
        runs = []
        for rows, narrow in _in_runs(ready.narrow, length):
            there = self._put(_problems(ready.sent, rows, length))
            runs.append(Run(rows, there, *self._run(before, there, narrow)))
        searched = [self._searched(run, ready.sent) for run in runs]
        runs = [run for run, _ in searched]
        return runs, _in_order([run.rows for run in runs], [clique for _, clique in searched])

    def _searched(self, run: Run, sent: PackedProblem) -> tuple[Run, Clique]:
        """The cliques of a run on the devices, and in numpy."""
        count, settings = len(run.rows), self.settings
        clique, proved = _fetched((run.clique, run.proved), count)
        if settings.clique != "networkx" and (settings.clique != "exact" or proved.all()):
            return run, clique
        clique = search_batch_on_host(
            _fetched(run.graph.edge_bits, count), sent.mask[run.rows], *clique, method=settings.clique,
            nodes=settings.clique_nodes, seconds=settings.clique_seconds,
        )  # fmt: skip
        everywhere = _filled_up(clique, np.arange(count), len(run.sent.columns))
        return run._replace(clique=self._put(everywhere)), clique

    def _since_cliques(self, sent: PackedProblem, runs: list[Run], clique: Clique, size: Size) -> Any:
        """The second program on all problems, in numpy."""
        length, after = self.run_length(size), self.compiled.after
        graph, answers = None, []
        chosen = _in_runs(rooms(size, self.settings, np.sum(clique.members, axis=1)), length)
        for rows, room in chosen:
            there = next((run[1:4] for run in runs if np.array_equal(run.rows, rows)), None)
            if there is None:  # not as they went through the first: through the host
                if graph is None:
                    graphs = [_fetched(run.graph, len(run.rows)) for run in runs]
                    graph = _in_order([run.rows for run in runs], graphs)
                company = _filled_up((graph, clique), rows, length)
                there = self._put((_problems(sent, rows, length), *company))
            answers.append(self._run(after, *there, room))
        places = [rows for rows, _ in chosen]
        return _in_order(places, [_fetched(x, len(k)) for k, x in zip(places, answers, strict=True)])

    @cached_property
    def compiled(self) -> Programs:
        """The programs for these settings on this mesh."""
        return programs(choices_of(self.settings), self.mesh)

    # Threads that leave the order of transfers and programs on a GPU to JAX (0.11) now and then, once in some
    # million problems, had a program start before the last of its problems were there. So they wait.

    def _put(self, arrays: Any) -> Any:
        """Onto the devices, a share each."""
        there = jax.device_put(arrays, self.compiled.sharding)
        return there if self.on_cpu else jax.block_until_ready(there)

    def _run(self, program: Callable[..., Any], *args: Any) -> Any:
        """A program, on accelerators alone and to its end, which takes no longer: others pack meanwhile."""
        if self.on_cpu:
            return program(*args)
        with self.turn:
            return jax.block_until_ready(program(*args))


class Run(NamedTuple):
    """Problems that went through the first program side by side, and what the devices hold of them."""

    rows: Rows  # in the chunk
    sent: PackedProblem
    graph: Graph
    clique: Clique
    proved: Any


def _in_runs(choice: np.ndarray, length: int) -> list[tuple[Rows, Any]]:
    """Rows for each run, and their choice: those that make the same one share runs."""
    alike = [(np.flatnonzero(choice == each), each.item()) for each in np.unique(choice)]
    return [(rows[k : k + length], each) for rows, each in alike for k in range(0, len(rows), length)]


def _in_order(rows: Sequence[Rows], parts: Sequence[Any]) -> Any:
    """One stack of what runs have found, in the order of the chunk."""
    order = np.concatenate(rows)
    whole = jax.tree.map(lambda *x: np.concatenate(x), *parts)  # may be written to, as numpy's may
    if np.all(order[:-1] < order[1:]):
        return whole
    back = np.argsort(order)
    return jax.tree.map(lambda x: x[back], whole)


def _fetched(arrays: Any, count: int) -> Any:
    """The first rows, in numpy."""
    return jax.tree.map(lambda x: np.asarray(x)[:count], arrays)


def _problems(sent: PackedProblem, rows: Rows, length: int) -> PackedProblem:
    """These problems, and in what fills the run a repeated one whose rows are masked."""
    filled = _filled_up(sent, rows, length)
    if len(rows) < length:
        filled.columns[len(rows) :, 8] = 0
    return filled


def _filled_up(arrays: Any, rows: Rows, length: int) -> Any:
    """These rows; what fills the run repeats the first."""
    if len(rows) == length == rows[-1] - rows[0] + 1:  # all in one piece: nothing is copied
        return jax.tree.map(lambda x: x[rows[0] : rows[0] + length], arrays)
    fill = np.append(rows, np.repeat(rows[:1], length - len(rows)))
    return jax.tree.map(lambda x: x[fill], arrays)
