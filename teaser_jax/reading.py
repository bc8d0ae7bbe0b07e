"""What the user gave for a problem, read as arrays and checked. Tracers pass unread.

Validation lives here and not in the records: JAX rebuilds records all the time, also from
placeholders that are no arrays.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from teaser_jax.ground.arrays import AnyArray, as_numpy, is_traced

MOST_CONFIDENCE = 1e9


def _read(value: Any, name: str) -> AnyArray:
    """Return a tracer as it is, or read any other value as numpy."""
    return value if is_traced(value) else as_numpy(value, name)


def real_numbers(value: Any, name: str) -> AnyArray:
    """Read real numbers as a tracer, or as a numpy array in the machine's own byte order.

    Raises:
        ValueError: If the value cannot be read, or holds anything but real numbers.
    """
    array = _read(value, name)
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


def point_rows(value: Any, name: str) -> AnyArray:
    """Read points as (n, 3) numbers, of arrays and of clouds that others hold.

    Raises:
        ValueError: On any other shape, with the shape and what to do.
    """
    array = real_numbers(coordinates_of(value), name)
    shape = array.shape
    if 0 in shape:
        raise ValueError(
            f"{name} is empty (shape {shape}): an answer that can be trusted needs at least 5 matches (rows)."
        )
    if len(shape) != 2 or shape[1] != 3:
        raise ValueError(
            f"{name} has shape {shape}: expected (n, 3), one point a row; {_way_out(name, shape)}."
        )
    return array


def coordinates_of(value: Any) -> Any:
    """Find the coordinates in a cloud of Open3D (either API) or in a structured array; return others as is.

    Structured arrays with fields x, y, z are what readers of PCD files and ROS messages give.
    """
    names = getattr(getattr(value, "dtype", None), "names", None)
    if names is not None and {"x", "y", "z"} <= set(names):
        return np.stack([np.asarray(value[axis], np.float64) for axis in "xyz"], axis=-1)
    if hasattr(value, "__array__") or hasattr(value, "__dlpack__"):
        return value
    if hasattr(value, "points") and hasattr(value, "has_points"):
        return np.asarray(value.points)
    positions = getattr(getattr(value, "point", None), "positions", None)
    if positions is not None:
        return positions.cpu().numpy() if hasattr(positions, "cpu") else positions
    return value


def _way_out(name: str, shape: tuple[int, ...]) -> str:
    """Tell what makes points of a wrong shape (n, 3): the advice works when it is followed."""
    if len(shape) == 0:
        return "one number is no point"
    if len(shape) == 1:
        return (
            f"pass numpy.reshape({name}, (-1, 3)) if x, y, z follow one another"
            if shape[0] % 3 == 0
            else "give three coordinates for each point"
        )
    if len(shape) == 2 and shape[0] in (2, 3, 4) and shape[1] > shape[0]:
        columns = {2: f"numpy.pad({name}, ((0, 1), (0, 0))).T", 3: f"{name}.T", 4: f"{name}[:3].T"}[shape[0]]
        return f"points are rows, so pass {columns}"
    if len(shape) == 2 and shape[1] == 2:
        return f"points in a plane get a third coordinate: pass numpy.pad({name}, ((0, 0), (0, 1)))"
    if len(shape) == 2 and shape[1] > 3:
        return f"pass {name}[:, :3] if more columns follow the coordinates"
    if len(shape) == 2:
        return "give three coordinates for each point"
    if shape[-1] == 3 and shape.count(1) >= len(shape) - 2:
        return f"pass {name}.reshape(-1, 3)"
    if shape[-1] == 3:
        return (
            f"pass {name}.reshape(-1, 3) if this is one organised cloud; of a stack of problems give one, "
            f"{name}[0], at a time, or all to solve_batch or jax.vmap"
        )
    if shape[-2] == 3:
        return f"points are rows, so swap the last two axes: numpy.swapaxes({name}, -1, -2)"
    return "give three coordinates for each point"


def one_a_match(value: Any, name: str, n: int) -> AnyArray:
    """Read one number for all matches, or one for each, as (n,). Raises ValueError on any other shape."""
    array = real_numbers(value, name)
    if array.shape not in ((), (n,)):
        raise ValueError(f"{name} has shape {array.shape}: expected one number or one a match, ({n},).")
    return jnp.broadcast_to(array, (n,)) if is_traced(array) else np.broadcast_to(array, (n,))


def positive_number(value: Any, name: str) -> AnyArray:
    """Read one number, finite and above 0 where it is known. Raises ValueError on anything else."""
    array = real_numbers(value, name)
    if array.shape != ():
        raise ValueError(f"{name} has shape {array.shape}: expected one number.")
    if not is_traced(array) and not (np.isfinite(array) and array > 0):
        raise ValueError(f"{name} is {array}: give a number above 0.")
    return array


def known_scale(value: Any) -> AnyArray:
    """Read the known scale, one number above 0. Raises ValueError on anything else."""
    array = _read(value, "scale")
    if array.dtype.kind in "US" and array.shape == ():
        raise ValueError(f"scale is the text '{array}': give a number, or pass scale=None to estimate it.")
    return positive_number(array, "scale")


def in_type(number: AnyArray, name: str, dtype: Any) -> AnyArray:
    """Convert a number above 0 to a type. Raises ValueError if it is none above 0 there, or infinite."""
    with np.errstate(over="ignore", under="ignore"):  # of which the error speaks
        converted = number.astype(dtype)
    if not is_traced(converted) and not (np.isfinite(converted) and converted > 0):
        raise ValueError(f"{name} is {number}, which {dtype} cannot hold: give one nearer to 1.")
    return converted


def truth_values(value: Any, n: int) -> AnyArray:
    """Read the mask of the matches, (n,) truth values. Raises ValueError on anything else."""
    array = _read(value, "mask")
    if array.shape != (n,) or array.dtype.kind != "b":
        convertible = array.shape == (n,) and array.dtype.kind in "iuf"
        raise ValueError(
            f"mask has shape {array.shape} and dtype {array.dtype}: expected ({n},) truth values, "
            f"one a match{'; pass mask.astype(bool)' if convertible else ''}."
        )
    return array


def row_pairs(value: Any, n: int) -> AnyArray:
    """Read pairs of row numbers, (m, 2), also of a ``networkx.Graph``. Raises ValueError on anything else."""
    if hasattr(value, "edges") and hasattr(value, "nodes"):  # a networkx.Graph
        value = np.asarray(list(value.edges()), dtype=object).reshape(-1, 2)
        if not all(isinstance(x, (int, np.integer)) for x in value.ravel()):
            raise ValueError("the nodes of the pairs graph must be row numbers (integers).")
        value = value.astype(np.int64)
    array = _read(value, "pairs")
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


def check_values(src: Any, dst: Any, noise_bound: Any, mask: Any, confidence: Any, dtype: Any) -> None:
    """Check the numbers that are concrete; whatever is traced is left to the solver.

    Raises:
        ValueError: If bounds or confidences make no sense, no row is finite, or the bound is lost in
            the rounding of the coordinates in ``dtype``.
    """
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
    """Refuse numbers so large, or held in so few digits, that the bound is lost in their rounding."""
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
    """Name the row to mask where a single one is far beyond the others; otherwise say nothing."""
    reach = np.maximum(np.abs(src[usable]).max(axis=1), np.abs(dst[usable]).max(axis=1))
    row = np.arange(len(src))[usable][np.argmax(reach)]
    half = len(reach) // 2
    usual = float(np.partition(reach, half)[half])  # no mean of two, which may be no number any more
    if usual * 1e3 >= largest:
        return ""
    return f". Half of the matches stay within {usual:.3g}: if row {row} is corrupt, mask it"


def finite_rows(src: Any, dst: Any, mask: Any) -> np.ndarray | slice:
    """Make an index of the finite rows under the mask: a slice, which copies nothing, if these are all."""
    if np.all(mask) and np.isfinite(src).all() and np.isfinite(dst).all():
        return slice(None)
    return np.asarray(mask) & np.isfinite(src).all(axis=1) & np.isfinite(dst).all(axis=1)


def extent(points: Any) -> float:
    """Find the largest coordinate of points, signs apart [length]."""
    return float(max(points.max(), -points.min()))
