"""A certificate for one rotation: how far its cost can be from the best there is (section VIII-C).

``certify_rotation`` is the door, inside jit and outside; the steps behind it are in ``proof.py``. A proof
speaks of these measurements: it says optimal, never right.
"""

from __future__ import annotations

from typing import Any, get_args

import numpy as np

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import certify_on_host
from teaser_jax.certify.host_measurements import read_measurements
from teaser_jax.certify.options import MAX_MEASUREMENTS, TOLERANCE, CertifyMethod, Options, checked_options
from teaser_jax.certify.stack import certify_stack
from teaser_jax.certify.traced import certify_traced
from teaser_jax.ground.arrays import as_numpy, is_traced
from teaser_jax.ground.checks import one_of
from teaser_jax.reading import real_numbers


# Longer than other functions: the docstring of a public door says all about its arguments.
def certify_rotation(
    src: Any,
    dst: Any,
    rotation: Any,
    *,
    noise_bound: Any,
    cbar2: Any = 1.0,
    mask: Any = None,
    tolerance: Any = TOLERANCE,
    iterations: int | np.integer | None = None,
    method: CertifyMethod = "splitting",
    max_measurements: int | np.integer = MAX_MEASUREMENTS,
) -> Certificate:
    """Bound how much better than ``rotation`` any rotation could fit ``dst_k ~ R src_k``.

    The candidate may come from anywhere. Everything is done in float64, whatever the input, without
    touching JAX's configuration. Outside jit the measurements that count are compacted first, and a
    stack of problems (b, k, 3) is taken, too: the closed form for all at once, then the splitting for
    those that it leaves, one by one.

    Args:
        src, dst: (k, 3) vectors, row k with row k [length]; a known scale is part of ``src``.
        rotation: (3, 3), the candidate; projected on SO(3) first.
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

    References: Yang, Shi, Carlone, T-RO 2021, section VIII-C, problems (19) and (23), Algorithm 3.
    """
    one_of("method", method, get_args(CertifyMethod))
    src, dst, rotation = (
        real_numbers(x, name) for x, name in ((src, "src"), (dst, "dst"), (rotation, "rotation"))
    )
    *stack, k, _ = _checked_shape(src, dst, rotation)
    options = checked_options(tolerance, iterations, method, max_measurements)
    mask = np.ones((*stack, k), bool) if mask is None else mask
    known = dict(noise_bound=noise_bound, cbar2=cbar2, mask=mask)
    if is_traced(src, dst, rotation, *known.values(), tolerance):
        if stack:
            raise ValueError("a stack of problems was given inside jit: use jax.vmap(certify_rotation).")
        return certify_traced(src, dst, rotation, **known, options=options, rounds=options.rounds(k))
    if stack:
        return _stack_on_host(src, dst, _finite(rotation), **known, options=options)
    measurements = read_measurements(src, dst, **known)
    return certify_on_host(measurements, _finite(rotation), options, rounds=options.rounds(k))


def _stack_on_host(
    src: Any, dst: Any, rotation: np.ndarray, *, noise_bound: Any, cbar2: Any, mask: Any, options: Options
) -> Certificate:
    """Certify a stack of rotations, (b, 3, 3) or one for all, each against its own measurements."""
    b, k = np.shape(src)[:2]
    noise_bound, cbar2 = real_numbers(noise_bound, "noise_bound"), real_numbers(cbar2, "cbar2")
    mask = as_numpy(mask, "mask")
    if mask.dtype.kind != "b":
        raise ValueError(f"mask has dtype {mask.dtype}: expected truth values.")
    stacked = {"noise_bound": (noise_bound, (b, k)), "cbar2": (cbar2, (b,)), "mask": (mask, (b, k))}
    for name, (value, expected) in stacked.items():
        if np.shape(value) not in ((), expected):
            raise ValueError(
                f"{name} has shape {np.shape(value)}: expected () or {expected} for a stack of {b} problems."
            )
    if b == 0:
        raise ValueError("the stack holds no problem.")
    bounds, truncations, masks = (np.broadcast_to(value, expected) for value, expected in stacked.values())
    items = [read_measurements(src[i], dst[i], bounds[i], truncations[i], masks[i]) for i in range(b)]
    rotations = np.broadcast_to(rotation, (b, 3, 3))
    return certify_stack(items, rotations, options, rounds=options.rounds(k))


def _checked_shape(src: Any, dst: Any, rotation: Any) -> tuple[int, ...]:
    """Return the shape of the vectors, (k, 3) or (b, k, 3); ValueError if the others do not fit it."""
    a, b, r = np.shape(src), np.shape(dst), np.shape(rotation)
    if not (a == b and len(a) in (2, 3) and a[-1] == 3 and r in ((3, 3), (*a[:-2], 3, 3))):
        raise ValueError(
            f"src, dst and rotation have shapes {a}, {b} and {r}: expected (k, 3), (k, 3) and (3, 3), rows "
            "being measurements; or stacks of them."
        )
    return a


def _finite(rotation: Any) -> np.ndarray:
    """Read a candidate, or a stack of them, in float64; ValueError if it is not finite."""
    rotation = np.asarray(rotation, np.float64)
    if not np.all(np.isfinite(rotation)):
        raise ValueError(f"rotation is not finite: {rotation.tolist()}.")
    return rotation
