"""Problems from arrays: validation, defaults, padding and stacking.

Validation lives here and not in the records: JAX rebuilds records all the time, also from
placeholders that are no arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from teaser_jax.types import Problem

MOST_CONFIDENCE = 1e9


def make_problem(
    src: Any,
    dst: Any,
    *,
    noise_bound: Any,
    scale: Any = 1.0,
    cbar2: Any = 1.0,
    mask: Any = None,
    confidence: Any = None,
    pairs: Any = None,
) -> Problem:
    """A registration problem from matched points: row i of ``src`` belongs to row i of ``dst``.

    Concrete arrays are checked in full. On traced arrays only shapes and dtypes are checked, and
    rows that cannot be used (NaN, infinity, bounds not above 0) are left out while solving.

    Args:
        src, dst: (n, 3) points, any real dtype; integers become floats, entries that a numpy
            masked array hides become NaN.
        noise_bound: Largest error of a right match [length unit of the points], one number or (n,).
        scale: The known scale [-], or None: estimate it.
        cbar2: Truncation of the cost, c-bar squared [-].
        mask: (n,) rows to use.
        confidence: (n,) weights >= 0 of the matches in the final fit; 0 equals masked.
        pairs: (m, 2) index pairs to compare, or a ``networkx.Graph`` on row numbers; None: all.

    Returns:
        A pytree for ``solve``; its dtype is that of the points (float32 unless JAX's x64 is on).

    Raises:
        ValueError: With what was received and what to do.

    Gradients: exact in ``src``, ``dst``, ``noise_bound``, ``scale`` and ``confidence``.
    """
    read = read_problem(
        src, dst, noise_bound=noise_bound, scale=scale, cbar2=cbar2, mask=mask,
        confidence=confidence, pairs=pairs,
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, read)


def read_problem(
    src: Any,
    dst: Any,
    *,
    dtype: Any = None,
    noise_bound: Any,
    scale: Any = 1.0,
    cbar2: Any = 1.0,
    mask: Any = None,
    confidence: Any = None,
    pairs: Any = None,
) -> Problem:
    """``make_problem`` with everything concrete left in numpy, in ``dtype`` (None: JAX's choice).

    Under jit, jnp would trace what is read and checked here.
    """
    src, dst = _points(src, "src"), _points(dst, "dst")
    if src.shape[0] != dst.shape[0]:
        raise ValueError(
            f"src has {src.shape[0]} rows and dst has {dst.shape[0]}: rows are matches, row i of src "
            "with row i of dst. Match the clouds first and index both with the matches."
        )
    n = src.shape[0]
    if dtype is None:
        dtype = jnp.result_type(*(jax.dtypes.canonicalize_dtype(x.dtype) for x in (src, dst)))
    noise_bound = _numbers(noise_bound, "noise_bound", n)
    confidence = np.ones(n) if confidence is None else _numbers(confidence, "confidence", n)
    mask = np.ones(n, bool) if mask is None else _mask(mask, n)
    pairs = None if pairs is None else _pairs(pairs, n)
    cbar2 = _scalar(cbar2, "cbar2")
    scale = None if scale is None else _scale(scale)
    _check_values(src, dst, noise_bound, mask, confidence, dtype)

    def ready(x: Any) -> Any:
        return x.astype(dtype)

    return Problem(
        ready(src), ready(dst), ready(noise_bound), ready(cbar2), mask, ready(confidence),
        None if scale is None else ready(scale), None if pairs is None else pairs.astype(np.int32),
    )  # fmt: skip


def stack_problems(problems: Sequence[Problem]) -> Problem:
    """Problems of any sizes as one batch: padded to the largest, padding masked.

    Numpy arrays stay numpy. Gradients: exact.

    Raises:
        ValueError: If there are none, or scale or pairs are given in some but not in all.
    """
    if isinstance(problems, Problem):
        raise ValueError("stack_problems takes a list of problems, and received one Problem.")
    problems = list(problems)
    if not problems:
        raise ValueError("stack_problems received no problem.")
    for k, p in enumerate(problems):
        if not isinstance(p, Problem) or p.src.ndim != 2 or p.src.shape != p.dst.shape:
            raise ValueError(
                f"problem {k} of the list is no single Problem with as many rows in src as in dst."
            )
    for name in ("scale", "pairs"):
        if len({getattr(p, name) is None for p in problems}) > 1:
            raise ValueError(f"some problems have {name}=None and some do not: stack each kind by itself.")
    n = max(p.src.shape[0] for p in problems)
    sizes = [p.pairs.shape[0] for p in problems if p.pairs is not None]
    m = max(sizes, default=None)
    on_host = not any(isinstance(x, jax.Array) for x in jax.tree.leaves(problems))
    stack = np.stack if on_host else jnp.stack
    return jax.tree.map(lambda *x: stack(x), *[pad_problem(p, n, m) for p in problems])


def pad_problem(problem: Problem, n: int, m: int | None = None) -> Problem:
    """The same problem in n rows (and m pairs): added rows are masked and change nothing.

    Keeps numpy arrays numpy. Gradients: exact.
    """

    def pad(x: Any, rows: int, value: Any) -> Any:
        if x.shape[0] > rows:
            raise ValueError(f"cannot pad {x.shape[0]} rows to {rows}")
        if rows == x.shape[0]:
            return x
        if isinstance(x, jax.Array):
            widths = [(0, rows - x.shape[0])] + [(0, 0)] * (x.ndim - 1)
            return jnp.pad(x, widths, constant_values=value)
        padded = np.full((rows, *x.shape[1:]), value, x.dtype)  # a tenth of the time of np.pad
        padded[: x.shape[0]] = x
        return padded

    return Problem(
        src=pad(problem.src, n, 0),
        dst=pad(problem.dst, n, 0),
        noise_bound=pad(problem.noise_bound, n, 1),
        cbar2=problem.cbar2,
        mask=pad(problem.mask, n, False),
        confidence=pad(problem.confidence, n, 0),
        scale=problem.scale,
        pairs=None if problem.pairs is None else pad(problem.pairs, m or problem.pairs.shape[0], 0),
    )


CONCRETE = (np.ndarray, float, int, type(None))


def is_traced(*values: Any) -> bool:
    """Whether any leaf is a tracer, so that its value is not known."""
    unclear = [x for x in values if not isinstance(x, CONCRETE)]
    return bool(unclear) and any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(unclear))


def as_numpy(value: Any, name: str) -> np.ndarray:
    """A numpy view or copy of anything with ``__array__`` or ``__dlpack__``, or nested lists."""
    if value is None:
        raise ValueError(f"{name} is missing: None was given where numbers are needed.")
    try:
        if isinstance(value, np.ma.MaskedArray):
            return _filled(value)
        if hasattr(value, "__dlpack__") and not hasattr(value, "__array__"):
            return np.from_dlpack(value)
        return np.asarray(value)
    except (TypeError, ValueError, RuntimeError, BufferError) as error:
        raise ValueError(
            f"{name} cannot be read as an array ({type(value).__name__}: {error}). Give an array on "
            "the host, or anything with __array__ or __dlpack__."
        ) from error


def _filled(array: np.ma.MaskedArray) -> np.ndarray:
    """What is hidden must not come back as a number: it becomes NaN, or False among truth values."""
    if not np.ma.is_masked(array):
        return array.data
    if array.dtype.kind == "b":
        return array.filled(False)
    return np.ma.filled(array.astype(np.float64) if array.dtype.kind in "iu" else array, np.nan)


def _array(value: Any, name: str) -> Any:
    return value if is_traced(value) else as_numpy(value, name)


def _floats(value: Any, name: str) -> Any:
    """Real numbers as a tracer, or as a numpy array in the machine's own byte order."""
    array = _array(value, name)
    if array.dtype.kind not in "fiub" and array.dtype != jnp.bfloat16:
        raise ValueError(
            f"{name} has dtype {array.dtype}: expected real numbers. Convert it, for instance with "
            "numpy.asarray(x, dtype=float)."
        )
    if array.dtype.kind == "b":
        raise ValueError(f"{name} holds truth values: expected real numbers.")
    if is_traced(array):
        return array if jnp.issubdtype(array.dtype, jnp.floating) else array.astype(float)
    known = array.dtype.kind != "f" or array.dtype.itemsize > 8 or not array.dtype.isnative
    return array.astype(np.float64) if known else array


def _points(value: Any, name: str) -> Any:
    array = _floats(value, name)
    shape = array.shape
    if 0 in shape:
        raise ValueError(
            f"{name} is empty (shape {shape}): an answer that can be trusted needs at least 5 matches (rows)."
        )
    if len(shape) == 2 and shape[0] == 3 and shape[1] != 3:
        raise ValueError(f"{name} has shape {shape}: points are rows, so pass {name}.T of shape (n, 3).")
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(
            f"{name} has shape {shape}: expected (n, 3), one point a row; pass {name}[:, :3] if more columns "
            "follow the coordinates."
        )
    return array


def _numbers(value: Any, name: str, n: int) -> Any:
    array = _floats(value, name)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{name} has shape {array.shape}: expected one number or one a match, ({n},).")
    return jnp.broadcast_to(array, (n,)) if is_traced(array) else np.broadcast_to(array, (n,))


def _scalar(value: Any, name: str) -> Any:
    array = _floats(value, name)
    if array.shape != ():
        raise ValueError(f"{name} has shape {array.shape}: expected one number.")
    if not is_traced(array) and not (np.isfinite(array) and array > 0):
        raise ValueError(f"{name} is {array}: give a number above 0.")
    return array


def _scale(value: Any) -> Any:
    array = _array(value, "scale")
    if array.dtype.kind in "US":
        raise ValueError(f"scale is the text '{array}': give a number, or pass scale=None to estimate it.")
    return _scalar(array, "scale")


def _mask(value: Any, n: int) -> Any:
    array = _array(value, "mask")
    if array.shape != (n,) or array.dtype.kind != "b":
        convertible = array.shape == (n,) and array.dtype.kind in "iuf"
        raise ValueError(
            f"mask has shape {array.shape} and dtype {array.dtype}: expected ({n},) truth values, "
            f"one a match{'; pass mask.astype(bool)' if convertible else ''}."
        )
    return array


def _pairs(value: Any, n: int) -> Any:
    if hasattr(value, "edges") and hasattr(value, "nodes"):  # a networkx.Graph
        value = np.asarray(list(value.edges()), dtype=object).reshape(-1, 2)
        if not all(isinstance(x, (int, np.integer)) for x in value.ravel()):
            raise ValueError("the nodes of the pairs graph must be row numbers (integers).")
        value = value.astype(np.int64)
    array = _array(value, "pairs")
    if array.shape[:1] == (0,):
        raise ValueError("pairs is empty, so that no matches are compared: pass pairs=None to compare all.")
    if array.ndim != 2 or array.shape[1] != 2 or array.dtype.kind not in "iu":
        raise ValueError(
            f"pairs has shape {array.shape} and dtype {array.dtype}: expected (m, 2) integers, "
            "the row numbers of each pair."
        )
    if not is_traced(array):
        low, high = int(np.min(array)), int(np.max(array))
        if low < 0 or high >= n:
            raise ValueError(f"pairs refer to rows {low} to {high}: rows run from 0 to {n - 1}.")
    return array


def _check_values(src: Any, dst: Any, noise_bound: Any, mask: Any, confidence: Any, dtype: Any) -> None:
    """Checks of what is concrete; anything traced is left to the solver."""
    if not is_traced(noise_bound, mask):
        bounds = noise_bound[mask]
        if not np.all(bounds > 0):
            raise ValueError(
                f"noise_bound contains {bounds[~(bounds > 0)][0]}: it is the largest error of a right match, "
                "a number above 0 in the unit of the points."
            )
        if not np.all(np.isfinite(bounds)):
            raise ValueError("noise_bound contains infinity: give the largest error of a right match.")
    if not is_traced(confidence, mask):
        weights = confidence[mask]
        if not np.all((weights >= 0) & np.isfinite(weights)):
            raise ValueError("confidence contains a negative or non-finite number: weights are 0 or above.")
        if np.any(weights > MOST_CONFIDENCE):  # sums of their products would overflow in float32
            raise ValueError(f"confidence contains {weights.max():.3g}: divide them all, only ratios count.")
    if is_traced(src, dst, mask, noise_bound):
        return
    usable = finite_rows(src, dst, mask)
    if mask.any() and not len(src[usable]):
        raise ValueError(
            "no row of src and dst is finite: every match holds NaN or infinity. Look where they come from; "
            "give the finite ones."
        )
    if len(src[usable]):
        _check_resolution(src, dst, noise_bound, usable, dtype)


def _check_resolution(src: Any, dst: Any, noise_bound: Any, usable: Any, dtype: Any) -> None:
    """Numbers so large, or held in so few digits, that the bound is lost in their rounding."""
    largest = max(extent(src[usable]), extent(dst[usable]))
    kind, bound = jnp.finfo(dtype), float(noise_bound[usable].min())
    # Lengths and bounds appear to the fourth power in the test of edges.
    most, least = float(kind.max) ** 0.25 / 10, float(kind.tiny) ** 0.25 * 10
    if max(largest, float(noise_bound[usable].max())) > most or bound < least:
        raise ValueError(
            f"coordinates reach {largest:.3g} and noise_bound is {bound:.3g}, beyond what {dtype} can "
            f"square and compare: rescale both to a sensible unit{_lonely_row(src, dst, usable, largest)}."
        )
    rounding = float(kind.eps) * largest
    if rounding > 0.01 * bound:
        wider = "" if dtype == jnp.float64 else ", or use register(), which does that in float64"
        raise ValueError(
            f"coordinates reach {largest:.3g}, where {dtype} resolves {rounding:.2g}: more than 1 % of "
            f"noise_bound {bound:.3g}. Subtract a common origin from each cloud first{wider}"
            f"{_lonely_row(src, dst, usable, largest)}."
        )
    for name, points in (("src", src), ("dst", dst)):
        if jnp.issubdtype(points.dtype, jnp.floating):
            lost = float(jnp.finfo(points.dtype).eps) * extent(points[usable])
            if lost > 0.1 * bound:
                raise ValueError(
                    f"{name} is given in {points.dtype}, which resolves {lost:.2g} at coordinates of "
                    f"{extent(points[usable]):.3g}: more than a tenth of noise_bound {bound:.3g}. The digits "
                    f"are lost already: subtract the origin before converting to {points.dtype}."
                )


def _lonely_row(src: Any, dst: Any, usable: Any, largest: float) -> str:
    """Advice, where a single row is what is too large."""
    reach = np.maximum(np.abs(src[usable]).max(axis=1), np.abs(dst[usable]).max(axis=1))
    row = np.arange(len(src))[usable][np.argmax(reach)]
    usual = float(np.median(reach.astype(np.float64)))
    if usual * 1e3 >= largest:
        return ""
    return f". Half of the matches stay within {usual:.3g}: if row {row} is corrupt, mask it"


def finite_rows(src: Any, dst: Any, mask: Any) -> np.ndarray | slice:
    """What picks the rows of numbers: a slice, which copies nothing, where that is all of them."""
    if np.all(mask) and np.isfinite(src).all() and np.isfinite(dst).all():
        return slice(None)
    return np.asarray(mask) & np.isfinite(src).all(axis=1) & np.isfinite(dst).all(axis=1)


def extent(points: Any) -> float:
    """The largest coordinate, signs apart."""
    return float(max(points.max(), -points.min()))
