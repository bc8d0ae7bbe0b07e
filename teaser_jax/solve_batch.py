"""Many problems in one call: checked here, solved on all devices and in all processes by the engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from teaser_jax.engine.batch import Chunk, Group, as_list, as_stack, solve_groups
from teaser_jax.engine.groups import by_size
from teaser_jax.engine.processes import all_of, check_agreement, local_mesh, share
from teaser_jax.ground.arrays import is_traced
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import Problem
from teaser_jax.settings import Settings, check_settings
from teaser_jax.solution import Solution

FLOATS = ("src", "dst", "noise_bound", "cbar2", "confidence", "scale")
DOUBLE, EXACT = np.dtype(np.float64), {"mask": np.dtype(bool), "pairs": np.dtype(np.int32)}


def solve_batch(
    problems: Sequence[Problem] | Problem,
    settings: Settings = Settings(),
    *,
    mesh: Mesh | None = None,
    chunk_size: int | None = None,
    progress: bool = False,
) -> list[Solution] | Solution:
    """Solve thousands of problems as ``solve`` does, on every device there is; outside jit, in float64.

    Problems are sorted by size, padded to the sizes of ``register`` and solved some at a time by a few
    compiled programs a size: one up to the clique, and one for each of up to four classes of clique sizes.
    An answer depends on its own problem alone, bit for bit: not on its neighbours, their order, the
    chunks or the number of devices. A problem that cannot be solved says so in its status.

    Points are read as they are; ``make_problem`` rounds to float32 unless JAX's x64 is on, and
    ``host_problem`` does not.

    Args:
        problems: Problems of any sizes, or a stack of them as from ``stack_problems``.
        settings: How to solve all of them. ``rotation="sdp"`` runs on the host: it is refused here.
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
    chunk_size = _check_choices(settings, mesh, chunk_size)

    def solved(groups: list[Group], assemble: Callable[[Iterator[Chunk]], Any]) -> Any:
        """Solve the chunks of this process and assemble them; None if it has no device or no problem."""
        devices = local_mesh(mesh)
        if devices is None or not groups:
            return None
        return assemble(solve_groups(groups, devices, settings, chunk_size, progress))

    if isinstance(problems, Problem):
        stack = read_stack(problems)
        check_agreement("solve_batch", (stack, repr(settings)))
        count = len(stack.src)
        if count == 0:
            raise ValueError("solve_batch received a stack of no problem.")
        part = share(count, mesh)
        mine, chosen = np.arange(count)[part], jax.tree.map(lambda x: x[part], stack)
        whole = solved([(mine, chosen)] if len(mine) else [], lambda chunks: as_stack(chunks, mine))
        found = [each for each in all_of(whole) if each is not None]
        return jax.tree.map(lambda *x: np.concatenate(x), *found)
    if not isinstance(problems, Sequence) or isinstance(problems, str | bytes):
        raise ValueError(
            f"problems is of type {type(problems).__name__}: expected a list of Problem, or a stacked one."
        )
    listed = read_list(problems)
    check_agreement("solve_batch", (listed, repr(settings)))
    local = listed[share(len(listed), mesh)]
    groups: list[Group] = [(places, [local[k] for k in places]) for places in by_size(local).values()]
    answers = solved(groups, lambda chunks: as_list(chunks, local))
    return [each for some in all_of(answers) for each in some or ()]


def _check_choices(settings: Any, mesh: Any, chunk_size: Any) -> int | None:
    """Check what is asked for beside the problems, and return the size of the chunks. Raises ValueError."""
    check_settings(settings)
    if settings.rotation.needs_host:
        raise ValueError('Settings(rotation="sdp") is solved on the host, one by one: use solve or register.')
    if mesh is not None and not isinstance(mesh, Mesh):
        raise ValueError(f"mesh is of type {type(mesh).__name__}: expected a jax.sharding.Mesh.")
    if mesh is not None and mesh.size == 0:
        raise ValueError("mesh has no device: give one that has, or None for all there are.")
    if chunk_size is None:
        return None
    return whole_number("chunk_size", chunk_size, 1, what="how many problems to send")


def read_list(problems: Sequence[Any]) -> list[Problem]:
    """Read problems in float64 numpy, and check each. Raises ValueError with the number of the bad one."""
    return [_read(problem, 1, f"problems[{k}]") for k, problem in enumerate(problems)]


def read_stack(stack: Problem) -> Problem:
    """Read a stacked problem in float64 numpy. Raises ValueError if its arrays do not belong together."""
    return _read(stack, 2, "the stacked problem")


def _read(problem: Any, axes: int, name: str) -> Problem:
    """Read a problem with so many axes in front of its coordinates, in float64 numpy. Raises ValueError."""
    if not isinstance(problem, Problem):
        raise ValueError(
            f"{name} is of type {type(problem).__name__}: expected a Problem, as from make_problem."
        )
    if is_traced(*vars(problem).values()):
        raise ValueError(
            "solve_batch was called inside jit, vmap or grad: use jax.vmap(teaser_jax.solve) there."
        )
    for field in (*FLOATS, *EXACT):
        _check_type(field, getattr(problem, field), name)
    as_array: Any = np.asarray  # of its many signatures none is that of a field
    given = {field: getattr(problem, field) for field in FLOATS}
    floats: dict[str, Any] = {k: None if x is None else as_array(x, np.float64) for k, x in given.items()}
    pairs = None if problem.pairs is None else as_array(problem.pairs)
    read = Problem(**floats, mask=as_array(problem.mask, bool), pairs=pairs)
    _check_shapes(read, axes, name)
    return read


def _check_type(field: str, value: Any, name: str) -> None:
    """Check that a field holds numbers of its kind. Raises ValueError."""
    dtype = getattr(value, "dtype", None)
    if dtype is EXACT.get(field, DOUBLE) and type(value) in (np.ndarray, np.float64):  # nearly always
        return
    if value is None and field in ("scale", "pairs"):
        return
    if isinstance(value, np.ma.MaskedArray):
        raise ValueError(f"{name} has {field} with hidden entries: make problems with host_problem.")
    if isinstance(value, jax.ShapeDtypeStruct):
        raise ValueError(f"{name} has {field} without numbers (of type {type(value).__name__}).")
    try:
        dtype = np.asarray(value).dtype if dtype is None else np.dtype(dtype)
    except ValueError as error:
        raise ValueError(
            f"{name} has {field} that is no array ({error}): make problems with make_problem."
        ) from None
    if field in EXACT:
        fits = dtype.kind in {"mask": "b", "pairs": "iu"}[field]
    else:
        fits = dtype.kind in "fiu" or jnp.issubdtype(dtype, jnp.floating)  # bfloat16 is no kind of numpy's
    if not fits:
        raise ValueError(f"{name} has {field} of type {dtype}: make problems with make_problem.")


def _check_shapes(read: Problem, axes: int, name: str) -> None:
    """Check that the arrays of a problem belong together. Raises ValueError."""
    if read.src.ndim != axes + 1:
        usual = "(n, 3); a stack goes in by itself, not in a list" if axes == 1 else "(b, n, 3)"
        raise ValueError(f"{name} has src of shape {read.src.shape}: expected {usual}.")
    rows, front, pairs = read.src.shape[:-1], read.src.shape[: axes - 1], read.pairs
    expected = {
        "src": (*rows, 3), "dst": (*rows, 3), "noise_bound": rows, "mask": rows, "confidence": rows,
        "cbar2": front, "scale": front,
        "pairs": (*front, *getattr(pairs, "shape", ())[axes - 1 : axes], 2),
    }  # fmt: skip
    for field, shape in expected.items():
        value = getattr(read, field)
        if value is not None and value.shape != shape:
            usual = {"src": "(..., n, 3)", "pairs": "(..., m, 2)"}.get(field) or str(shape)
            raise ValueError(f"{name} has {field} of shape {value.shape}: expected {usual}.")
    if pairs is not None and pairs.size and not 0 <= pairs.min() <= pairs.max() < rows[-1]:
        raise ValueError(f"{name} has pairs of rows that do not exist: rows run from 0 to {rows[-1] - 1}.")
