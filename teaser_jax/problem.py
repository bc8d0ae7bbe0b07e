"""The problem: matched points and what is known of them. It is made, stacked, padded and cleaned here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from teaser_jax import reading
from teaser_jax.ground.arrays import AnyArray, Placeholder, is_traced
from teaser_jax.ground.forks import check_fork


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Problem:
    """Matched points and what is known about them. Built by ``make_problem``.

    Attributes:
        src, dst: Matched points, row i with row i [length unit of the user].
        noise_bound: beta_i, the largest error of a right match [same unit].
        cbar2: Truncation c-bar squared of the cost (6) [-].
        mask: Rows to use; padding is masked.
        confidence: Weight of each match in the final fit, w_i = confidence_i / beta_i^2 [-].
        scale: Known scale [-], or None: estimate it. None is structure, so static under jit.
        pairs: Index pairs whose TIMs are used, or None for all. A pair (i, i) is padding.
    """

    src: Float[AnyArray, "... n 3"] | Placeholder
    dst: Float[AnyArray, "... n 3"] | Placeholder
    noise_bound: Float[AnyArray, "... n"] | Placeholder
    cbar2: Float[AnyArray, "..."] | Placeholder
    mask: Bool[AnyArray, "... n"] | Placeholder
    confidence: Float[AnyArray, "... n"] | Placeholder
    scale: Float[AnyArray, "..."] | Placeholder | None = None
    pairs: Int[AnyArray, "... m 2"] | Placeholder | None = None


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
    """Make a registration problem from matched points: row i of ``src`` belongs to row i of ``dst``.

    Concrete arrays are checked in full. On traced arrays only shapes and dtypes are checked, and
    rows that cannot be used (NaN, infinity, bounds not above 0) are left out while solving.

    Args:
        src, dst: (n, 3) points, any real dtype; integers become floats, entries that a numpy
            masked array hides become NaN. Clouds of Open3D and structured arrays with x, y, z are read, too.
        noise_bound: Largest error of a right match [length unit of dst], one number or (n,).
        scale: The known scale [-], or None: estimate it.
        cbar2: Truncation of the cost, c-bar squared [-].
        mask: (n,) rows to use.
        confidence: (n,) weights >= 0 of the matches in the final fit; 0 equals masked.
        pairs: (m, 2) rows to compare with one another (not correspondences), or a ``networkx.Graph`` on row
            numbers; None: all.

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
    return jax.tree.map(_on_device, read)


def _on_device(array: AnyArray) -> Array:
    """Put an array onto the device, on purpose: a guard against transfers is not for it."""
    check_fork()
    return array if isinstance(array, jax.Array) else jax.device_put(array)


def host_problem(
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
    """Make a problem in float64 numpy, from anything that can be read on the host: for ``solve_batch``.

    Args:
        src, dst: (n, 3) matched points, row i with row i [length].
        noise_bound, scale, cbar2, mask, confidence, pairs: As for ``make_problem``.

    Returns:
        A pytree of numpy arrays.

    Raises:
        ValueError: As ``make_problem``; inside jit, where ``make_problem`` is the function to use.
    """
    if is_traced(src, dst, noise_bound, scale, cbar2, mask, confidence, pairs):
        raise ValueError("host_problem reads numbers on the host: inside jit use make_problem.")
    return read_problem(
        src, dst, dtype=np.dtype(np.float64), noise_bound=noise_bound, scale=scale, cbar2=cbar2, mask=mask,
        confidence=confidence, pairs=pairs,
    )  # fmt: skip


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
    """Read a problem and leave its concrete numbers in numpy, in ``dtype`` (None: JAX's choice).

    ``make_problem`` and ``host_problem`` read by it. Under jit, jnp would trace what is read and checked
    here.

    Raises:
        ValueError: As ``make_problem``.
    """
    src, dst = reading.point_rows(src, "src"), reading.point_rows(dst, "dst")
    if src.shape[0] != dst.shape[0]:
        cure = (
            "Match the clouds first and index both with the matches."
            if pairs is None
            else "If pairs are correspondences, pass src[pairs[:, 0]] and dst[pairs[:, 1]], without pairs."
        )
        raise ValueError(
            f"src has {src.shape[0]} rows and dst has {dst.shape[0]}: rows are matches, row i of src "
            f"with row i of dst. {cure}"
        )
    n = src.shape[0]
    if dtype is None:
        with jax.numpy_dtype_promotion("standard"):  # clouds may be of two kinds, whatever JAX is set to
            dtype = wide_type(jnp.result_type(*(jax.dtypes.canonicalize_dtype(x.dtype) for x in (src, dst))))
    noise_bound = reading.one_a_match(noise_bound, "noise_bound", n)
    confidence = np.ones(n) if confidence is None else reading.one_a_match(confidence, "confidence", n)
    mask = np.ones(n, bool) if mask is None else reading.truth_values(mask, n)
    pairs = None if pairs is None else reading.row_pairs(pairs, n)
    cbar2 = reading.positive_number(cbar2, "cbar2")
    scale = None if scale is None else reading.known_scale(scale)
    reading.check_values(src, dst, noise_bound, mask, confidence, dtype)
    with np.errstate(over="ignore"):  # rows that are masked or not finite may hold anything
        rows = [x.astype(dtype) for x in (src, dst, noise_bound, confidence)]
    return Problem(
        src=rows[0],
        dst=rows[1],
        noise_bound=rows[2],
        cbar2=reading.in_type(cbar2, "cbar2", dtype),
        mask=mask,
        confidence=rows[3],
        scale=None if scale is None else reading.in_type(scale, "scale", dtype),
        pairs=None if pairs is None else pairs.astype(np.int32),
    )


def wide_type(dtype: Any) -> np.dtype:
    """Return the type in which numbers of a type are computed: float32 for half precision, else the same."""
    return np.dtype(np.float32) if np.dtype(dtype).itemsize < 4 else np.dtype(dtype)


def check_precision(problem: Problem) -> None:
    """Check that JAX can hold the numbers of a problem in numpy: it rounds them unless its x64 is on.

    Raises:
        ValueError: If the bound is lost in the rounding, as ``make_problem``.
    """
    held = jax.dtypes.canonicalize_dtype(problem.src.dtype)
    if isinstance(problem.src, np.ndarray) and held != problem.src.dtype and not is_traced(problem):
        p = problem
        reading.check_values(p.src, p.dst, p.noise_bound, p.mask, p.confidence, held)


def stack_problems(problems: Iterable[Problem]) -> Problem:
    """Stack problems of any sizes as one batch: padded to the largest, padding masked.

    Numpy arrays stay numpy. Gradients: exact.

    Raises:
        ValueError: If there are none, or scale or pairs are given in some but not in all.
    """
    if isinstance(problems, Problem) or not isinstance(problems, Iterable):
        raise ValueError(f"stack_problems takes a list of problems, and received {type(problems).__name__}.")
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
    if not on_host:
        check_fork()
    stack = np.stack if on_host else jnp.stack
    return jax.tree.map(lambda *x: stack(x), *[pad_problem(p, n, m) for p in problems])


def pad_problem(problem: Problem, n: int, m: int | None = None) -> Problem:
    """Pad a problem to n rows (and m pairs): added rows are masked and change nothing.

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


def _in_range(numbers: Float[Array, "*k"]) -> Bool[Array, "*k"]:
    """Tell which numbers are above zero and have a cube, as derivatives by a bound do."""
    most = float(jnp.finfo(numbers.dtype).max) ** 0.32  # 1e12 in float32
    return (numbers > 1 / most) & (numbers < most)


@jax.jit  # one operation for those who call it outside jit
def clean(problem: Problem) -> tuple[Problem, Int[Array, ""]]:
    """Mask unusable rows of a problem and make them harmless; count the rows that are not finite.

    Whoever solves a problem cleans it once, at the door; the stages receive clean rows and never ask again.
    Values are replaced *before* anything is computed from them, so that neither results nor
    gradients of the other rows see a NaN. Without a truncation or a known scale that makes sense, no row can
    be used. Half precision becomes float32: it has no linear algebra, and turns by a tenth of a degree.

    Gradients: exact for the rows that stay, zero for the others.
    """
    problem = jax.tree.map(
        lambda x: x.astype(wide_type(x.dtype)) if jnp.issubdtype(x.dtype, jnp.floating) else x, problem
    )
    finite = (
        jnp.all(jnp.isfinite(problem.src), axis=1)
        & jnp.all(jnp.isfinite(problem.dst), axis=1)
        & jnp.isfinite(problem.noise_bound)
        & jnp.isfinite(problem.confidence)
    )
    bound, confidence = problem.noise_bound, problem.confidence
    usable = problem.mask & finite & _in_range(bound) & _in_range(confidence)
    usable &= _in_range(bound / jnp.sqrt(jnp.where(usable, confidence, 1)))
    # A bound that is lost in the digits of its point. Outside jit it is refused.
    usable &= bound > jnp.finfo(bound.dtype).eps * jnp.max(jnp.abs(problem.dst), axis=1)
    cbar2, scale = problem.cbar2, problem.scale
    sensible = _in_range(cbar2)
    if scale is not None:
        sensible &= _in_range(scale)
        scale = jnp.where(sensible, scale, 1)
    usable &= sensible
    cleaned = replace(
        problem,
        cbar2=jnp.where(sensible, cbar2, 1),
        scale=scale,
        src=jnp.where(usable[:, None], problem.src, 0),
        dst=jnp.where(usable[:, None], problem.dst, 0),
        noise_bound=jnp.where(usable, problem.noise_bound, 1),
        confidence=jnp.where(usable, problem.confidence, 0),
        mask=usable,
    )
    return cleaned, jnp.sum(problem.mask & ~finite, dtype=jnp.int32)
