"""A certificate for one rotation: how far its cost can be from the best there is (section VIII-C).

``certify_rotation`` is the door, inside jit and outside; the steps behind it are in ``proof.py``. A proof
speaks of these measurements: it says optimal, never right.
"""

from __future__ import annotations

from numbers import Integral
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Bool, Float

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import certify_rows, compacted
from teaser_jax.certify.proof import CertifyMethod, prove
from teaser_jax.certify.stack import certify_stack
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
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting. None: 200, and fewer for more than 200 measurements,
            so that the work stays that of 200.
        method: ``"splitting"``, ``"direct"`` (closed form only, no iteration) or ``"reference"``
            (Algorithm 3 as published, slow). Under vmap ``"direct"`` is the one to use: the splitting goes
            on until the slowest problem ends.
        max_measurements: More give ``TOO_LARGE``: time grows with their third power, memory with the second.

    Returns:
        A ``Certificate``; of a stack, one with a leading axis.

    Raises:
        ValueError: Shapes that do not fit, a method that is unknown, bounds that are not above 0.

    Gradients: none, inputs are stopped.

    References: Yang, Shi, Carlone, T-RO 2020, section VIII-C, problems (19) and (23), Algorithm 3.
    """
    shape = _check(src, dst, rotation, method)
    mask = np.ones(shape[:-1], bool) if mask is None else mask
    iterations = (
        default_iterations(shape[-2]) if iterations is None else check_count("iterations", iterations)
    )
    check_count("max_measurements", max_measurements)
    if is_traced(src, dst, rotation, noise_bound, cbar2, mask, tolerance):
        if len(shape) != 2:
            raise ValueError("a stack of problems was given inside jit: use jax.vmap(certify_rotation).")
        if shape[0] > max_measurements:
            raise ValueError(f"{shape[0]} measurements are more than max_measurements, {max_measurements}.")
        dtype = jnp.result_type(src)
        src, dst, rotation, noise_bound, cbar2 = lax.stop_gradient((src, dst, rotation, noise_bound, cbar2))
        with jax.enable_x64(True):
            m, frame, constant = in_frame_of(
                rotation, src, dst, noise_bound=noise_bound, cbar2=cbar2, mask=mask
            )
            found = prove(m, frame, constant, tolerance, iterations=iterations, method=method)
            return jax.tree.map(
                lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, found
            )
    known: dict[str, Any] = dict(iterations=iterations, method=method, most=max_measurements)
    if len(shape) == 2:
        rows = compacted(src, dst, noise_bound, cbar2, mask)
        return certify_rows(rows, _checked(rotation), check_tolerance(tolerance), **known)
    b = shape[0]
    bounds, cbar2s = np.asarray(noise_bound, float), np.broadcast_to(np.asarray(cbar2, float), (b,))
    bounds = np.broadcast_to(bounds[:, None] if bounds.ndim == 1 else bounds, shape[:-1])
    items = [compacted(src[i], dst[i], bounds[i], cbar2s[i], np.asarray(mask)[i]) for i in range(b)]
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


def check_count(name: str, value: Any) -> int:
    """A whole number, 0 or above, or ValueError."""
    if isinstance(value, bool) or not isinstance(value, Integral) or value < 0:
        raise ValueError(f"{name} is {value!r}: expected a whole number, 0 or above.")
    return int(value)


def check_tolerance(value: Any) -> float:
    """A number above 0, or ValueError."""
    if not 0 < float(value) < np.inf:
        raise ValueError(f"tolerance is {value}: expected a number above 0.")
    return float(value)
