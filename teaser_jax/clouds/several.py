"""Several answers to one set of matches between clouds, as the solver of rivals finds them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from teaser_jax.stages.rivals.search import RivalSearch, find_rivals

SEVERAL = RivalSearch(answers=12, rows=2048)


def several_poses(
    src: Float[np.ndarray, "m 3"],
    dst: Float[np.ndarray, "m 3"],
    voxel_size: float,
    bound: float,
    most: int,
) -> Float[np.ndarray, "k 4 4"]:
    """Find poses that several sets of matches agree on, best first.

    Args:
        src, dst: Matches, the clearest first, about the middles of their clouds [length].
        voxel_size: Width of a cell [length].
        bound: How far right matches lie apart at most, in cells.
        most: The largest number of matches, for which one program is compiled.
    """
    missing = most - len(src)
    a, b = (
        jnp.asarray(np.pad((x / voxel_size).astype(np.float32), ((0, missing), (0, 0)))) for x in (src, dst)
    )
    mask = jnp.asarray(np.arange(most) < len(src))
    bounds = jnp.full(most, bound, jnp.float32)
    found = jax.device_get(find_rivals(a, b, bounds, mask, scale=jnp.float32(1), search=SEVERAL))
    poses = np.asarray(found.pose.matrix, np.float64)[found.valid]
    poses[:, :3, 3] *= voxel_size
    return poses
