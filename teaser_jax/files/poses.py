"""Poses to files."""

from __future__ import annotations

from os import PathLike
from pathlib import Path

import numpy as np

from teaser_jax.ground.io import replacing
from teaser_jax.pose import Pose


def write_pose(path: str | PathLike[str], pose: Pose) -> None:
    """Write ``T_dst_src`` as four lines of four numbers, which ``numpy.loadtxt`` reads back exactly.

    The file appears whole or not at all.

    Raises:
        OSError: If it cannot be written.
    """
    with replacing(Path(path)) as partial:
        np.savetxt(partial, pose.matrix, fmt="%.17g")
