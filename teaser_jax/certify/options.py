"""How to certify: the methods, the defaults, and what is asked of the arguments of all who certify."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float

from teaser_jax.ground.arrays import is_traced
from teaser_jax.ground.checks import shown, whole_number

CertifyMethod = Literal["splitting", "direct", "reference"]

TOLERANCE = 1e-3
ITERATIONS = 200
AFFORDABLE = 200  # measurements that can have all iterations
MAX_MEASUREMENTS = 1000  # matrices of 128 MB, of which some eight live at once


class Options(NamedTuple):
    """How to certify, once the arguments have been checked.

    Attributes:
        tolerance: The suboptimality that counts as optimal [-].
        iterations: Cap on rounds of the splitting; None: what the number of measurements allows.
        method: Where a dual matrix comes from.
        max_measurements: More are not looked at.
    """

    tolerance: Float[Array, ""] | float
    iterations: int | None
    method: CertifyMethod
    max_measurements: int

    def rounds(self, k: int) -> int:
        """Cap the rounds of the splitting for k measurements."""
        return default_iterations(k) if self.iterations is None else self.iterations


def checked_options(
    tolerance: Any,
    iterations: int | np.integer | None,
    method: CertifyMethod,
    max_measurements: int | np.integer,
) -> Options:
    """Check the options that all ways to certify share; the method is checked where it has its name.

    Raises:
        ValueError: A tolerance that is not between 0 and 1, or caps that are no whole numbers.
    """
    if not is_traced(tolerance):
        tolerance = _between_0_and_1(tolerance)
    if iterations is not None:
        iterations = whole_number("iterations", iterations, 0)
    return Options(tolerance, iterations, method, whole_number("max_measurements", max_measurements, 0))


def default_iterations(k: int) -> int:
    """Count the rounds of the splitting that cost on k measurements what 200 rounds cost on 200."""
    return ITERATIONS if k <= AFFORDABLE else max(3, round(ITERATIONS * (AFFORDABLE / k) ** 3))


def _between_0_and_1(value: Any) -> float:
    """Read a tolerance between 0 and 1, or raise ValueError."""
    number = np.asarray(value.item() if hasattr(value, "item") and np.shape(value) == () else value)
    if number.shape != () or number.dtype.kind not in "fiu" or not 0 < number < 1:
        raise ValueError(f"tolerance is {shown(value)}: expected a number between 0 and 1.")
    return float(number)
