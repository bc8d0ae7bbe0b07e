"""Poses to files."""

from __future__ import annotations

from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.ground.io import replacing
from teaser_jax.pose import Pose, as_pose


def write_pose(path: str | PathLike[str], pose: Pose | Any) -> None:
    """Write ``T_dst_src`` as four lines of four numbers, which ``numpy.loadtxt`` reads back exactly.

    The file appears whole or not at all.

    Args:
        path: Where to.
        pose: A ``Pose``, an answer that has one, or a matrix.

    Raises:
        OSError: If it cannot be written.
        ValueError: If it is no pose; then no file changes.
    """
    matrix = as_pose(pose).matrix
    with replacing(Path(path)) as partial:
        np.savetxt(partial, matrix, fmt="%.17g")
