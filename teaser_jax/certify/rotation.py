"""A certificate for one rotation: how far its cost can be from the best there is (section VIII-C).

``certify_rotation`` is the door, inside jit and outside; the steps behind it are in ``proof.py``. A proof
speaks of these measurements: it says optimal, never right.
"""

from __future__ import annotations

from dataclasses import replace
from numbers import Real
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import certify_rows, compacted
from teaser_jax.certify.proof import CertifyMethod, prove
from teaser_jax.certify.stack import certify_stack
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import is_traced
from teaser_jax.so3 import AnyArray
from teaser_jax.stages.quadratic_form import in_frame_of

TOLERANCE = 1e-3
ITERATIONS = 200
AFFORDABLE = 200  # measurements that can have all iterations
MAX_MEASUREMENTS = 1000  # matrices of 128 MB, of which some eight live at once


def certify_rotation(
    src: Float[AnyArray, "k 3"],
    dst: Float[AnyArray, "k 3"],
    rotation: Float[AnyArray, "3 3"],
    *,
    noise_bound: Any,
    cbar2: Any = 1.0,
    mask: Bool[AnyArray, " k"] | None = None,
    tolerance: Any = TOLERANCE,
    iterations: int | None = None,
    method: CertifyMethod = "splitting",
    max_measurements: int = MAX_MEASUREMENTS,
) -> Certificate:
    """Bound how much better than ``rotation`` any rotation could fit ``dst_k ~ R src_k``.

    The candidate may come from anywhere. Everything is done in float64, whatever the input, without
    touching JAX's configuration. Outside jit the measurements that count are compacted first, and a
    stack of problems (b, k, 3) is taken, too: the closed form for all at once, then the splitting for
    those that it leaves, one by one.

    Args:
        src, dst: Vectors, row k with row k [length]; a known scale is part of ``src``.
        rotation: The candidate; projected on SO(3) first.
        noise_bound: delta_k, the bound of the vectors as they are given, one or (k,) [length].
        cbar2: Truncation, c-bar squared [-].
        mask: (k,) rows to use; rows that are not finite are left out.
        tolerance: The suboptimality that counts as optimal [-]. A gap below a millionth of c-bar squared
            does, too.
        iterations: Cap on rounds of the splitting. None: 200, and fewer for more than 200 measurements,
            so that the work stays that of 200.
        method: ``"splitting"``, ``"direct"`` (closed form only, no iteration) or ``"reference"``
            (Algorithm 3 as published, slow). Under vmap ``"direct"`` is the one to use: the splitting goes
            on until the slowest problem ends.
        max_measurements: More give ``TOO_LARGE``, and under jit ``ValueError``: time grows with their third
            power, memory with the second.

    Returns:
        A ``Certificate``; of a stack, one with a leading axis. Under jit in the dtype of the input: what is
            proved stays proved, but ``verify`` wants float64.

    Raises:
        ValueError: Shapes that do not fit, a method that is unknown, bounds that are not above 0 (under jit
            the rows of such bounds are left out).

    Gradients: none, inputs are stopped.

    References: Yang, Shi, Carlone, T-RO 2020, section VIII-C, problems (19) and (23), Algorithm 3.
    """
    shape = _check(src, dst, rotation, method)
    mask = np.ones(shape[:-1], bool) if mask is None else mask
    iterations = (
        default_iterations(shape[-2]) if iterations is None else whole_number("iterations", iterations, 0)
    )
    whole_number("max_measurements", max_measurements, 0)
    if is_traced(src, dst, rotation, noise_bound, cbar2, mask, tolerance):
        if len(shape) != 2:
            raise ValueError("a stack of problems was given inside jit: use jax.vmap(certify_rotation).")
        if shape[0] > max_measurements:
            raise ValueError(f"{shape[0]} measurements are more than max_measurements, {max_measurements}.")
        dtype = jnp.promote_types(jnp.result_type(src), jnp.float32)
        mask = as_mask(mask, shape[:1])
        if not is_traced(tolerance):
            check_tolerance(tolerance)
        src, dst, rotation, noise_bound, cbar2 = lax.stop_gradient((src, dst, rotation, noise_bound, cbar2))
        with jax.enable_x64(True):
            m, frame, constant = in_frame_of(
                rotation, src, dst, noise_bound=noise_bound, cbar2=cbar2, mask=mask
            )
            found = prove(m, frame, constant, tolerance, iterations=iterations, method=method)
            return narrowed(found, dtype)
    known: dict[str, Any] = dict(iterations=iterations, method=method, most=max_measurements)
    if len(shape) == 2:
        rows = compacted(src, dst, noise_bound, cbar2, mask)
        return certify_rows(rows, _checked(rotation), check_tolerance(tolerance), **known)
    b, k = shape[:2]
    mask = np.asarray(mask, bool)
    stacked = {"noise_bound": (noise_bound, (b, k)), "cbar2": (cbar2, (b,)), "mask": (mask, (b, k))}
    for name, (value, expected) in stacked.items():
        if np.shape(value) not in ((), expected):
            raise ValueError(
                f"{name} has shape {np.shape(value)}: expected () or {expected} for a stack of {b} problems."
            )
    if b == 0:
        raise ValueError("the stack holds no problem.")
    bounds, cbar2s, masks = (np.broadcast_to(value, expected) for value, expected in stacked.values())
    items = [compacted(src[i], dst[i], bounds[i], cbar2s[i], masks[i]) for i in range(b)]
    rotations = np.broadcast_to(_checked(rotation), (b, 3, 3))
    return certify_stack(items, rotations, check_tolerance(tolerance), **known)


def default_iterations(k: int) -> int:
    """Rounds of the splitting that cost what 200 rounds on 200 measurements do."""
    return ITERATIONS if k <= AFFORDABLE else max(3, round(ITERATIONS * (AFFORDABLE / k) ** 3))


def _check(src: Any, dst: Any, rotation: Any, method: str) -> tuple[int, ...]:
    if method not in ("splitting", "direct", "reference"):
        raise ValueError(f"method is {method!r}: expected 'splitting', 'direct' or 'reference'.")
    a, b, r = np.shape(src), np.shape(dst), np.shape(rotation)
    fits = a == b and len(a) in (2, 3) and a[-1] == 3 and r in ((3, 3), (*a[:-2], 3, 3))
    if any(np.iscomplexobj(x) for x in (src, dst, rotation) if not is_traced(x)):
        raise ValueError("src, dst and rotation are real; complex numbers were received.")
    if not fits:
        raise ValueError(
            f"src, dst and rotation have shapes {a}, {b} and {r}: expected (k, 3), (k, 3) and (3, 3), rows "
            "being measurements; or stacks of them."
        )
    return a


def _checked(rotation: Any) -> np.ndarray:
    rotation = np.asarray(rotation, np.float64)
    if not np.all(np.isfinite(rotation)):
        raise ValueError(f"rotation is not finite: {rotation.tolist()}.")
    return rotation


def check_tolerance(value: Any) -> float:
    """A number between 0 and 1, or ValueError."""
    if not isinstance(value, Real) and np.shape(value) != () or not 0 < value < 1:
        raise ValueError(f"tolerance is {value!r}: expected a number between 0 and 1.")
    return float(value)


def as_mask(mask: Any, shape: tuple[int, ...]) -> Bool[Array, " k"]:
    """The mask of traced measurements; ValueError if it is not one value a row."""
    mask = jnp.asarray(mask)
    if mask.shape != shape:
        raise ValueError(f"mask has shape {mask.shape}: expected {shape}.")
    return mask.astype(bool)


def narrowed(found: Certificate, dtype: Any) -> Certificate:
    """In the dtype of the input, for JAX may have no float64 outside; what is claimed is rounded down."""
    cast = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, found)
    if dtype == jnp.float64:
        return cast
    eps = 2 * jnp.finfo(dtype).eps
    return replace(
        cast,
        lower_bound=cast.lower_bound * (1 - eps),
        suboptimality=cast.suboptimality + eps,
        absolute_gap=cast.absolute_gap + eps,
    )
