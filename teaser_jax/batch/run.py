"""Many problems in one call: device, host, device, in chunks, on all devices and in all processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int
from tqdm import tqdm

from teaser_jax.batch.groups import (
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
from teaser_jax.batch.programs import programs, rooms, unit
from teaser_jax.checks import whole_number
from teaser_jax.packing import PackedProblem, choices_of, pack_problem, unpack_solution
from teaser_jax.register import check_settings, with_origins, without_padding
from teaser_jax.stages.clique import search_batch_on_host
from teaser_jax.types import Problem, Settings, Solution

WORKERS = 2  # threads: while one is on the host, the other keeps the devices busy
RUNS_A_CHUNK = 4


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
        mine = np.arange(count)[share(count, mesh)]
        chosen = jax.tree.map(lambda x: x[mine], stack)
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


Part = tuple[Int[np.ndarray, " b"], "Problem | list[Problem]"]
Chunk = tuple[Int[np.ndarray, " b"], Solution]


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

    def run_length(self, size: Size) -> int:
        """Problems in one run of the programs."""
        return unit(size, self.mesh.devices.flat[0]) * self.mesh.size

    def length(self, problems: Problem | list[Problem], chunk_size: int | None, count: int) -> int:
        """Problems in a chunk, of so many: whole runs, and by default something for every thread."""
        run = self.run_length(size_of(problems if isinstance(problems, Problem) else problems[0]))
        runs = (
            min(RUNS_A_CHUNK, -(-count // (WORKERS * run))) if chunk_size is None else -(-chunk_size // run)
        )
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
        ready, settings = centred(sent), self.settings
        sent = ready.sent
        compiled = programs(choices_of(settings), self.mesh)
        with jax.enable_x64(True):  # of this thread only
            graph, clique, proved = self._in_runs(compiled.before, ready.narrow, (sent,), size)
            if settings.clique == "networkx" or (settings.clique == "exact" and not proved.all()):
                clique = search_batch_on_host(
                    graph.edge_bits, sent.mask, *clique, method=settings.clique,
                    nodes=settings.clique_nodes, seconds=settings.clique_seconds,
                )  # fmt: skip
            room = rooms(size, settings, np.sum(clique.members, axis=1))
            solution = unpack_solution(self._in_runs(compiled.after, room, (sent, graph, clique), size))
        return solution if ready.origins is None else with_origins(solution, *ready.origins)

    def _in_runs(self, program: Any, choice: np.ndarray, arrays: tuple[Any, ...], size: Size) -> Any:
        """What a program makes of each problem, in numpy; those that make the same choice share runs."""
        length, sharding = self.run_length(size), programs(choices_of(self.settings), self.mesh).sharding
        launched = []
        for each in np.unique(choice):
            alike = np.flatnonzero(choice == each)
            for k in range(0, len(alike), length):
                some = alike[k : k + length]
                sent = jax.device_put(_filled_up(arrays, some, length), sharding)
                launched.append((some, program(*sent, each.item())))
        order = np.concatenate([some for some, _ in launched])
        parts = [_fetched(answer, len(some)) for some, answer in launched]
        whole = jax.tree.map(lambda *x: np.concatenate(x), *parts)  # may be written to, as numpy's may
        if np.all(order[:-1] < order[1:]):
            return whole
        back = np.argsort(order)
        return jax.tree.map(lambda x: x[back], whole)


def _fetched(arrays: Any, count: int) -> Any:
    """The first rows, in numpy."""
    return jax.tree.map(lambda x: np.asarray(x)[:count], arrays)


def _filled_up(arrays: tuple[Any, ...], some: Int[np.ndarray, " k"], length: int) -> tuple[Any, ...]:
    """These rows of problems, graphs and cliques; what fills the run repeats the first, and is masked."""
    fill = np.append(some, np.repeat(some[:1], length - len(some)))
    if some[-1] - some[0] == length - 1:  # all in one piece: nothing is copied
        return jax.tree.map(lambda x: x[some[0] : some[0] + length], arrays)
    sent, *rest = jax.tree.map(lambda x: x[fill], arrays)
    sent.columns[len(some) :, 8] = 0
    return (sent, *rest)
