"""The last centimetres: a pose is moved to where the surfaces lie on one another."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.extra import small_gicp
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.pairing import moved
from teaser_jax.ground.checks import one_of

METHODS = {"gicp": "GICP", "plane": "PLANE_ICP", "point": "ICP"}
ROUNDS = 30
STRAY = 10.0  # cells that a pose is moved by at the most: points further away take no part
FEWEST, NEARLY_ALL = 20, 0.9  # points that take part; from this share on all do
SETTLED = 1e-3, 1e-4  # cells and radians in one round


def align(
    pose: Float[np.ndarray, "4 4"], src: Surface, dst: Surface, *, method: str = "plane", reach: float = 2.0
) -> Float[np.ndarray, "4 4"]:
    """Move a pose to where the surfaces near each other lie on one another.

    Args:
        pose: From the source to the target frame, as both stand here.
        src, dst: The surfaces, of one width of cells.
        method: "gicp" weighs by the local shape of both, "plane" by the normals of the target, "point" by
            nothing.
        reach: How far matches may lie apart, in cells.

    Returns:
        The pose where the rounds ended: no better than the one it started from if that was far off.
    """
    one_of("method", method, METHODS)
    target, tree = dst.for_alignment
    source = _in_reach(pose, src, dst, (reach + STRAY) * dst.voxel_size)
    if source is None:
        return pose
    found = small_gicp().align(
        target,
        source,
        tree,
        np.ascontiguousarray(pose, np.float64),
        METHODS[method],
        reach * dst.voxel_size,
        num_threads=1,  # sums of many threads are not the same bits each time
        max_iterations=ROUNDS,
        translation_epsilon=SETTLED[0] * dst.voxel_size,
        rotation_epsilon=SETTLED[1],
    )
    aligned = np.array(found.T_target_source)
    return aligned if np.isfinite(aligned).all() else pose


def _in_reach(pose: Float[np.ndarray, "4 4"], src: Surface, dst: Surface, reach: float) -> Any:
    """Choose the points of the source that may meet the target, as the library holds them; None: few are.

    The search for the nearest takes longest over points far away from all others.
    """
    near = dst.tree.in_reach(moved(pose, src.points), reach)
    count = int(np.count_nonzero(near))
    if count < FEWEST:
        return None
    if count > NEARLY_ALL * len(near):
        return src.for_alignment[0]
    return Surface(src.points[near], src.voxel_size, threads=src.threads).for_alignment[0]
