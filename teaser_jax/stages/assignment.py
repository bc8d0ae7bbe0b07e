"""Which point is which, given a pose: pairs that have each point of either cloud once, at the least cost."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.optimize import linear_sum_assignment

from teaser_jax.ground.arrays import Number


def least_cost_pairs(r2: Float[np.ndarray, "n m"], cbar2: Number) -> Int[np.ndarray, "k 2"]:
    """Choose pairs of points so that the truncated cost (6) over all points is least, each point once.

    A point without a partner costs as much as an outlier, so no pair is farther apart than that.

    Args:
        r2: Squared residuals of every source point with every target point, infinite where the two are no
            match [bounds squared].
        cbar2: Truncation [-].

    Returns:
        Rows (i, j), source point i with target point j, in the order of the source.
    """
    saved = np.minimum(r2, cbar2) - cbar2
    i, j = linear_sum_assignment(saved)
    inside = r2[i, j] <= cbar2
    return np.stack([i[inside], j[inside]], axis=1)
