"""What lies in front of what a sensor saw: it looked through there, so nothing can be there.

Overlaps of wrong poses often fit, as walls and ground lie on walls and ground; what else they carry along
then stands in the free space of the other cloud.
"""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Float, Int

from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.pairing import NEAR, moved
from teaser_jax.ground.arrays import AnyArray, namespace

SIDE = 45  # pixels, of two degrees, along each side of the cube around a sensor
PIXELS = 6 * SIDE**2
LEAST_ASKED = 0.1  # of the cells: a share of fewer says little


class RangeImage(NamedTuple):
    """How far a sensor saw in every direction: the picture on the six faces of a cube around it.

    Attributes:
        eye: Where it stands [length].
        depth: The distance of the nearest point in each pixel [length]; infinity: it saw nothing there.
    """

    eye: Float[AnyArray, "3"]
    depth: Float[AnyArray, "pixels"]


Images: TypeAlias = "tuple[RangeImage | None, RangeImage | None]"  # of the source and of the target


class Sight(NamedTuple):
    """What a sensor says of points of another cloud.

    Attributes:
        asked: Which share of the points lies where it saw something [-].
        in_front: Which share of these lies in front of that, where it looked through [-]; NaN: none does.
        hidden: Which share of these lies behind, where it could see nothing [-]; NaN: none does.
    """

    asked: Float[AnyArray, ""] | float
    in_front: Float[AnyArray, ""] | float
    hidden: Float[AnyArray, ""] | float


def range_image(points: Float[np.ndarray, "n 3"], eye: Float[np.ndarray, "3"]) -> RangeImage:
    """Make the picture of a cloud as its sensor took it.

    Args:
        points: All of the cloud: cells would leave holes between them [length].
        eye: Where the sensor stood, in the same frame [length].
    """
    away = points - eye
    depth = np.full(PIXELS, np.inf)
    np.minimum.at(depth, _pixels(away), np.linalg.norm(away, axis=1))
    return RangeImage(eye, depth)


def sight(
    image: RangeImage,
    points: Float[AnyArray, "n 3"],
    mask: AnyArray,
    margin: float | AnyArray,
) -> Sight:
    """Ask a sensor about points of another cloud. A pure function: works under jit and vmap.

    Args:
        image: What the sensor saw.
        points: In its frame [length].
        mask: Rows that hold a point.
        margin: So much nearer or further is in front or behind [length].
    """
    xp = namespace(points)
    away = points - image.eye[None]
    distance, depth = xp.sqrt(xp.sum(away**2, axis=1)), image.depth[_pixels(away)]
    there = xp.isfinite(depth)
    number = lambda kind: xp.sum(kind & mask, dtype=points.dtype)
    share = lambda kind, of: number(kind & there) / xp.where(of > 0, of, np.nan)
    every, asked = number(mask), number(there)
    # Of few points a share would say much: they count as a tenth of all.
    counted = xp.where(asked > 0, xp.maximum(asked, LEAST_ASKED * every), 0)
    return Sight(
        share(there, every),
        share(distance < depth - margin, counted),
        share(distance > depth + margin, asked),
    )


def in_front(
    pose: Float[np.ndarray, "4 4"],
    src: Surface,
    dst: Surface,
    images: Images,
) -> float:
    """Tell which share of the cells lies in front of what the other sensor saw, the larger one [-].

    NaN where no sensor saw anything in their directions, or none is known.

    Args:
        pose: From the source to the target frame, as both surfaces stand.
        src, dst: The surfaces.
        images: What the sensors of the source and of the target saw; None: not known.
    """
    found = []
    for image, way, surface in ((images[1], pose, src), (images[0], np.linalg.inv(pose), dst)):
        if image is not None:
            points = moved(way, surface.points)
            seen = sight(image, points, np.ones(len(points), bool), NEAR * dst.voxel_size)
            found.append(float(seen.in_front))
    return max((x for x in found if not np.isnan(x)), default=np.nan)


def _pixels(away: Float[AnyArray, "n 3"]) -> Int[AnyArray, " n"]:
    """Find the pixel in which each direction lies: the face of the cube, and the place on it by angles."""
    xp = namespace(away)
    face = xp.argmax(xp.abs(away), axis=1)
    component = lambda k: xp.take_along_axis(away, ((face + k) % 3)[:, None], axis=1)[:, 0]
    ahead = component(0)
    safe = xp.where(ahead == 0, 1, xp.abs(ahead))
    row, column = (
        xp.clip(
            ((xp.arctan(component(k) / safe) * (4 / np.pi) + 1) * (SIDE / 2)).astype(np.int32), 0, SIDE - 1
        )
        for k in (1, 2)
    )
    return ((2 * face + xp.where(ahead < 0, 1, 0)) * SIDE + row) * SIDE + column
