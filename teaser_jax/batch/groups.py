"""Problems of all sizes, sorted into groups that share a compiled program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.packing import PackedProblem, pack_problem
from teaser_jax.problem import is_traced
from teaser_jax.register import bucket, float32_will_do, median
from teaser_jax.types import Problem, Settings

FLOATS = ("src", "dst", "noise_bound", "cbar2", "confidence", "scale")
DOUBLE, USUAL = np.dtype(np.float64), {"mask": np.dtype(bool), "pairs": np.dtype(np.int32)}

Origins = tuple[Float[np.ndarray, "b 3"], Float[np.ndarray, "b 3"]]


class Size(NamedTuple):
    """What a program is compiled for: padded matches and pairs, and whether the scale is known."""

    n: int
    m: int | None
    scale_is_known: bool


def read_list(problems: Sequence[Problem]) -> list[Problem]:
    """The problems in float64 numpy, each checked. Raises ValueError with the number of the bad one."""
    return [_read(problem, 1, f"problems[{k}]") for k, problem in enumerate(problems)]


def read_stack(stack: Problem) -> Problem:
    """A stacked problem in float64 numpy. Raises ValueError if its arrays do not belong together."""
    return _read(stack, 2, "the stacked problem")


def _read(problem: Any, axes: int, name: str) -> Problem:
    if not isinstance(problem, Problem):
        raise ValueError(
            f"{name} is of type {type(problem).__name__}: expected a Problem, as from make_problem."
        )
    if is_traced(*jax.tree.leaves(problem)):
        raise ValueError(
            "solve_batch was called inside jit, vmap or grad: use jax.vmap(teaser_jax.solve) there."
        )

    for field in (*FLOATS, "mask", "pairs"):
        value = getattr(problem, field)
        if isinstance(value, np.ma.MaskedArray):
            raise ValueError(f"{name} has {field} with hidden entries: make problems with host_problem.")
        if isinstance(value, jax.ShapeDtypeStruct):
            raise ValueError(f"{name} has {field} without numbers (of type {type(value).__name__}).")
        dtype = getattr(value, "dtype", None)
        if dtype is USUAL.get(field, DOUBLE) or (value is None and field in ("scale", "pairs")):
            continue
        try:
            dtype = np.asarray(value).dtype if dtype is None else np.dtype(dtype)
        except ValueError as error:
            raise ValueError(
                f"{name} has {field} that is no array ({error}): make problems with make_problem."
            ) from None
        fits = (
            dtype.kind in {"mask": "b", "pairs": "iu"}[field]
            if field in USUAL
            else dtype.kind in "fiu" or jnp.issubdtype(dtype, jnp.floating)  # bfloat16 is no kind of numpy's
        )
        if not fits:
            raise ValueError(f"{name} has {field} of type {dtype}: make problems with make_problem.")
    as_array: Any = np.asarray  # of its many signatures none is that of a field
    given = {field: getattr(problem, field) for field in FLOATS}
    floats: dict[str, Any] = {k: None if x is None else as_array(x, np.float64) for k, x in given.items()}
    read = Problem(
        **floats,
        mask=as_array(problem.mask, bool),
        pairs=None if problem.pairs is None else as_array(problem.pairs),
    )
    if read.src.ndim != axes + 1:
        usual = "(n, 3); a stack goes in by itself, not in a list" if axes == 1 else "(b, n, 3)"
        raise ValueError(f"{name} has src of shape {read.src.shape}: expected {usual}.")
    rows, front = read.src.shape[:-1], read.src.shape[: axes - 1]
    expected = {
        "src": (*rows, 3), "dst": (*rows, 3), "noise_bound": rows, "mask": rows, "confidence": rows,
        "cbar2": front, "scale": front,
        "pairs": (*front, *getattr(read.pairs, "shape", ())[axes - 1 : axes], 2),
    }  # fmt: skip
    for field, shape in expected.items():
        value = getattr(read, field)
        if value is not None and value.shape != shape:
            usual = {"src": "(..., n, 3)", "pairs": "(..., m, 2)"}.get(field) or str(shape)
            raise ValueError(f"{name} has {field} of shape {value.shape}: expected {usual}.")
    pairs = read.pairs
    if pairs is not None and pairs.size and not 0 <= pairs.min() <= pairs.max() < rows[-1]:
        raise ValueError(f"{name} has pairs of rows that do not exist: rows run from 0 to {rows[-1] - 1}.")
    return read


def size_of(problem: Problem) -> Size:
    """The group of one problem, or of a stack."""
    m = None if problem.pairs is None else bucket(problem.pairs.shape[-2])
    return Size(bucket(problem.src.shape[-2]), m, problem.scale is not None)


def by_size(problems: Sequence[Problem]) -> dict[Size, Int[np.ndarray, " b"]]:
    """The places of the problems of each size, in the user's order."""
    places: dict[Size, list[int]] = {}
    for k, problem in enumerate(problems):
        places.setdefault(size_of(problem), []).append(k)
    return {size: np.array(each) for size, each in places.items()}


def pack_list(problems: Sequence[Problem], settings: Settings, size: Size) -> PackedProblem:
    """Problems of one size as one batch on the host; those of as many rows are packed together."""
    whole: Any = None
    for rows in by_shape(problems).values():
        alike = [problems[k] for k in rows]
        packed = pack_problem(jax.tree.map(lambda *x: np.stack(x), *alike), settings, size.n, size.m)
        if len(rows) == len(problems):
            return packed
        if whole is None:
            whole = jax.tree.map(lambda x: np.empty((len(problems), *x.shape[1:]), x.dtype), packed)
        for into, part in zip(jax.tree.leaves(whole), jax.tree.leaves(packed), strict=True):
            into[rows] = part
    return whole


def by_shape(problems: Sequence[Problem]) -> dict[tuple[int, int | None], list[int]]:
    """The places of the problems of each number of rows and of pairs."""
    places: dict[tuple[int, int | None], list[int]] = {}
    for k, problem in enumerate(problems):
        m = None if problem.pairs is None else problem.pairs.shape[0]
        places.setdefault((problem.src.shape[0], m), []).append(k)
    return places


class Ready(NamedTuple):
    """A batch in the frames in which it will be solved."""

    sent: PackedProblem
    origins: Origins | None  # taken away from the points; None: nothing was
    narrow: Bool[np.ndarray, " b"]  # whose edges float32 can test


def centred(sent: PackedProblem) -> Ready:
    """Points are moved to their middle where float32 could not tell consistent matches otherwise.

    Most batches of a study need nothing, and finding the middle takes a quarter of the time of solving
    a small problem.
    """
    narrow = _float32_will_do(sent)
    if narrow.all():
        return Ready(sent, None, narrow)
    columns = sent.columns.copy()
    origins = np.zeros((len(columns), 3)), np.zeros((len(columns), 3))
    for k in np.flatnonzero(~narrow):
        usable = _usable(columns[k])
        for origin, rows in zip(origins, (slice(0, 3), slice(3, 6)), strict=True):
            if usable.any():
                origin[k] = median(columns[k, rows, usable])
                columns[k, rows] -= origin[k][:, None]
    sent = sent._replace(columns=columns)
    return Ready(sent, origins, _float32_will_do(sent))


def _usable(columns: Float[np.ndarray, "*b 9 n"]) -> Bool[np.ndarray, "*b n"]:
    """Rows of numbers that the mask admits."""
    return (columns[..., 8, :] > 0) & np.isfinite(columns[..., :7, :]).all(axis=-2)


def _float32_will_do(sent: PackedProblem) -> Bool[np.ndarray, " b"]:
    """Of each problem, whether its edges may be tested in float32 where it lies."""
    columns, numbers = sent.columns, sent.numbers
    if numbers.shape[-1] < 6:  # a voted scale keeps all digits
        return np.zeros(len(columns), bool)
    with np.errstate(invalid="ignore", over="ignore"):  # numbers that make no sense: a status will say so
        # Rows that the mask hides can but widen the extent: most problems pass with them.
        narrow = _reach_is_small(columns, numbers, _extents(columns), columns[:, 8] > 0)
        rest = np.flatnonzero(~narrow)
        if len(rest):
            wide = columns[rest]
            usable = _usable(wide)
            seen = np.where(usable[:, None], wide, 0)
            narrow[rest] = _reach_is_small(seen, numbers[rest], _extents(seen), usable)
    return narrow


def _extents(columns: Float[np.ndarray, "b 9 n"]) -> Float[np.ndarray, "b 2"]:
    """The largest coordinate of each problem's two clouds; NaN where there is one."""
    b, _, n = columns.shape
    clouds = columns.reshape(b, 9 * n)[:, : 6 * n].reshape(b, 2, 3 * n)  # a view: no copy of the points
    return np.maximum(clouds.max(axis=2), -clouds.min(axis=2))


def _reach_is_small(
    columns: Float[np.ndarray, "b 9 n"],
    numbers: Float[np.ndarray, "b 6"],
    extents: Float[np.ndarray, "b 2"],
    usable: Bool[np.ndarray, "b n"],
) -> Bool[np.ndarray, " b"]:
    reach = np.sqrt(3) * (numbers[:, 5] * extents[:, 0] + extents[:, 1])
    bound = np.sqrt(numbers[:, 0]) * np.where(usable, columns[:, 6], np.inf).min(axis=1, initial=np.inf)
    return np.asarray(float32_will_do(reach, bound))
