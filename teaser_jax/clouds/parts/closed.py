"""Whether one cloud is a body and the other a scan of one side of it: only then is all of a part searched.

A body has a front and a back from wherever one looks at it. A scan of it has one layer only, as the camera
looked. A room, seen from inside, and a street have one layer somewhere too, but so has their other scan.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.trust.pairing import LINES
from teaser_jax.clouds.voxel import LEAST_SPACINGS, spacing

ASKED = 10_000  # points that tell
PIXELS = 64  # along the diagonal, or as many as the sampling carries
THICK = 1.5  # pixels between a front and its back
# Real scans of parts have 0 - 0.06 and ray-cast ones 0.17 - 0.32, their models 0.33 (thin boards) and
# 0.6 - 0.95: at least 0.27 more. Two scans of a bunny (0.10 - 0.20), of a kitchen (0.21 - 0.33) or a street
# (0 - 0.02) are within 0.10 of one another; an empty room has 0.93.
MOST_OF_SCAN, LEAST_AHEAD = 0.40, 0.20
MOST_LARGER = 1.15  # a scan than its part, with errors


def closedness(points: Float[np.ndarray, "n 3"]) -> float:
    """Tell which share of a cloud has a front and a back, along the line of sight where it is least [-]."""
    points = points[:: max(1, len(points) // ASKED)]
    pixel = max(
        LEAST_SPACINGS * spacing(Tree(points)), float(np.linalg.norm(np.ptp(points, axis=0))) / PIXELS
    )
    if not pixel > 0:
        return 0.0
    return min(_thick_share(points, line, pixel) for line in LINES)


def _thick_share(points: Float[np.ndarray, "n 3"], line: Float[np.ndarray, "3"], pixel: float) -> float:
    """Compute the share of pixels whose points lie at two depths along a line."""
    right = np.cross(line, np.eye(3)[np.argmin(np.abs(line))])
    right /= np.linalg.norm(right)
    image = np.floor(points @ np.stack([right, np.cross(line, right)], axis=1) / pixel).astype(np.int64)
    image -= image.min(axis=0)
    place = image[:, 0] * (image[:, 1].max() + 1) + image[:, 1]
    order = np.argsort(place, kind="stable")
    first = np.flatnonzero(np.diff(place[order], prepend=-1))
    depth = (points @ line)[order]
    apart = np.maximum.reduceat(depth, first) - np.minimum.reduceat(depth, first)
    return float(np.mean(apart > THICK * pixel))


def which_is_part(src: Cloud, dst: Cloud) -> Literal["src", "dst"] | None:
    """Tell which of two clouds is the whole surface of a part, if the other may be a scan of one side of it.

    Returns:
        None where neither is: rooms, streets, two scans, two bodies; a scan that is larger than the body; a
        scan from within.
    """
    closed = closedness(src.points), closedness(dst.points)
    part, scan = (src, dst) if closed[0] > closed[1] else (dst, src)
    if min(closed) > MOST_OF_SCAN or max(closed) - min(closed) < LEAST_AHEAD:
        return None
    if _diameter(scan.points) > MOST_LARGER * _diameter(part.points) or _from_within(scan):
        return None
    return "src" if part is src else "dst"


def _diameter(points: Float[np.ndarray, "n 3"]) -> float:
    return float(np.ptp(points @ LINES.T, axis=0).max())


def _from_within(scan: Cloud) -> bool:
    """Tell whether the camera stood among the points."""
    eye = scan.viewpoint
    if eye is None:
        return False
    return bool(((eye > scan.points.min(axis=0)) & (eye < scan.points.max(axis=0))).all())
