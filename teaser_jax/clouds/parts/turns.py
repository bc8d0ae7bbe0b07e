"""Rotations that leave no large gap: where a search without a guess begins."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from teaser_jax import so3

# Two irrational windings of the spiral: sqrt(2), and the positive root of x^4 = x + 4.
FIRST_WINDING, SECOND_WINDING = np.sqrt(2), 1.533751168755204288118041


def even_rotations(count: int) -> Float[np.ndarray, "count 3 3"]:
    """Spread rotations evenly over SO(3): a spiral on the sphere of quaternions.

    Of 2048 of them one lies within about 15 deg of any rotation.

    References: Alexa, Super-Fibonacci Spirals, CVPR 2022.
    """
    step = np.arange(count) + 0.5
    share = step / count
    first, second = 2 * np.pi * step / FIRST_WINDING, 2 * np.pi * step / SECOND_WINDING
    inner, outer = np.sqrt(share), np.sqrt(1 - share)
    quats = [inner * np.sin(first), inner * np.cos(first), outer * np.sin(second), outer * np.cos(second)]
    return so3.rotation_from_quat(np.stack(quats, axis=1))
