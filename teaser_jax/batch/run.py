"""Many problems in one call: device, host, device, in chunks, on all devices and in all processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from numbers import Integral
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh
from jaxtyping import Int
from tqdm import tqdm

from teaser_jax.batch.groups import Size, by_size, centred, pack_list, read_list, read_stack, size_of
from teaser_jax.batch.processes import all_of, local_mesh, share
from teaser_jax.batch.programs import programs, unit
from teaser_jax.packing import PackedProblem, choices_of, fetched, pack_problem, unpack_solution
from teaser_jax.register import check_settings, with_origins, without_padding
from teaser_jax.stages.clique import Clique, search_batch_on_host
from teaser_jax.types import Problem, Settings, Solution

WORKERS = 2  # threads: while one is on the host, the other keeps the devices busy
RUNS_A_CHUNK = 8


def solve_batch(
    problems: Sequence[Problem] | Problem,
    settings: Settings = Settings(),
    *,
    mesh: Mesh | None = None,
    chunk_size: int | None = None,
    progress: bool = False,
) -> list[Solution] | Solution:
    """``solve`` for thousands of problems, on every device there is; outside jit, in float64.

    Problems are sorted by size, padded to the sizes of ``register`` and solved some at a time by one
    compiled program a size. An answer depends on its own problem alone, bit for bit: not on its
    neighbours, their order, the chunks or the number of devices. A problem that cannot be solved says
    so in its status.

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
            where ``jax.vmap(solve)`` is the function to use; on settings that make no sense.

    Gradients: none; ``jax.vmap(solve)`` has them.
    """
    check_settings(settings)
    if settings.rotation == "sdp":
        raise ValueError('Settings(rotation="sdp") is solved on the host, one by one: use solve or register.')
    if chunk_size is not None and (
        isinstance(chunk_size, bool) or not isinstance(chunk_size, Integral) or chunk_size < 1
    ):
        raise ValueError(f"chunk_size is {chunk_size!r}: expected the number of problems to send at a time.")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is of type {type(mesh).__name__}: expected a jax.sharding.Mesh.")
    if isinstance(problems, Problem):
        stack = read_stack(problems)
        count = len(stack.src)
        if count == 0:
            raise ValueError("solve_batch received a stack of no problem.")
        mine = np.arange(count)[share(count, mesh)]
        chosen = jax.tree.map(lambda x: x[mine], stack)
        parts = [(mine, chosen)] if len(mine) else []
        whole = _filled(parts, lambda chunks: _stacked(chunks, mine), mesh, settings, chunk_size, progress)
        found = [each for each in all_of(whole) if each is not None]
        return jax.tree.map(lambda *x: np.concatenate(x), *found)
    if not isinstance(problems, Sequence):
        raise ValueError(
            f"problems is of type {type(problems).__name__}: expected a list of Problem, or a stacked one."
        )
    listed = read_list(problems)
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
        for length in [solver.length(problems, chunk_size)]
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
        for row, place in enumerate(places):
            one = jax.tree.map(lambda x, row=row: x[row], solution)
            answers[place] = without_padding(one, problems[place])
    return answers


@dataclass(frozen=True)
class Solver:
    """Solves chunks on a mesh of this process; its threads share the compiled programs."""

    mesh: Mesh
    settings: Settings

    def run_length(self, size: Size) -> int:
        """Problems in one run of the programs."""
        return unit(size, self.mesh.devices.flat[0]) * self.mesh.size

    def length(self, problems: Problem | list[Problem], chunk_size: int | None) -> int:
        """Problems in a chunk: whole runs."""
        run = self.run_length(size_of(problems if isinstance(problems, Problem) else problems[0]))
        return run * (RUNS_A_CHUNK if chunk_size is None else -(-int(chunk_size) // run))

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
        length, answers = self.run_length(size), []
        order = np.argsort(~ready.narrow, kind="stable")  # those whose edges float32 tests come first
        for narrow in (True, False):
            of_kind = order[ready.narrow[order] == narrow]
            for k in range(0, len(of_kind), length):
                some = of_kind[k : k + length]
                answers.append(
                    (some, self._run(jax.tree.map(lambda x, i=some: x[i], ready.sent), narrow, length))
                )
        places = np.concatenate([some for some, _ in answers])
        back = np.argsort(places)
        solution = jax.tree.map(lambda *x: np.concatenate(x)[back], *[answer for _, answer in answers])
        return solution if ready.origins is None else with_origins(solution, *ready.origins)

    def _run(self, sent: PackedProblem, narrow: bool, length: int) -> Solution:
        """One run of both programs, with the host's search between them where a clique has no proof."""
        count, settings = len(sent.columns), self.settings
        sent = jax.tree.map(lambda x: _repeated(x, length), sent)
        sent.columns[count:, 8] = 0  # what fills the run is masked
        compiled = programs(choices_of(settings), self.mesh)
        with jax.enable_x64(True):  # of this thread only
            on_device = jax.device_put(sent, compiled.sharding)
            graph, found, proved = compiled.before(on_device, narrow)
            searched = settings.clique in ("exact", "networkx")
            if searched and (settings.clique == "networkx" or not np.asarray(proved)[:count].all()):
                mask = sent.columns[:, 8] > 0
                found = search_batch_on_host(
                    graph.edge_bits, mask, *found, method=settings.clique,
                    nodes=settings.clique_nodes, seconds=settings.clique_seconds,
                )  # fmt: skip
                found = jax.device_put(Clique(*found), compiled.sharding)
            packed = fetched(compiled.after(on_device, graph, found))
        return unpack_solution(jax.tree.map(lambda x: x[:count], packed))


def _repeated(x: Any, length: int) -> Any:
    """An array of its own with rows up to a length, the first one repeated."""
    return np.concatenate([x, np.repeat(x[:1], length - len(x), axis=0)])
