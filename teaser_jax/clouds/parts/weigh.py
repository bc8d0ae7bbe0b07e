"""How a part and a scan cover one another: all of the scan, and what the camera could see of the part."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.parts.field import Field, distances
from teaser_jax.clouds.parts.sight import PIXEL, visible
from teaser_jax.clouds.sizes import padded
from teaser_jax.clouds.trust.pairing import moved
from teaser_jax.ground.arrays import AnyArray

# In cells: how far a point of the scan and one of the part may lie from the other cloud and be covered by it
# (the scan has holes where it saw nothing), and the distance beyond which points are not further away.
SCAN_NEAR, PART_NEAR, FAR = 1.5, 2.0, 2.0


class Cover(NamedTuple):
    """How well two clouds cover one another.

    Attributes:
        scan: Which part of the scan lies on the part [-].
        part: Which part of what the camera could see of the part has the scan on it [-].
        scan_distance: Mean distance of the scan from the part, at most two cells each [length].
        part_distance: Of what the camera could see from the scan, likewise [length].
    """

    scan: AnyArray
    part: AnyArray
    scan_distance: AnyArray
    part_distance: AnyArray

    @property
    def distance(self) -> AnyArray:
        """What poses are ranked by: both distances, the smaller the better [length]."""
        return self.scan_distance + self.part_distance


class Cells(NamedTuple):
    """The cells of a cloud in the rows that a program is compiled for."""

    points: Float[AnyArray, "r 3"]
    mask: Bool[AnyArray, " r"]


@partial(jax.jit, static_argnames="at_once")
def quick_covers(
    part_field: Field,
    scan_field: Field,
    part: Cells,
    scan: Cells,
    eyes: Float[Array, "e 3"],
    cell: Float[Array, ""],
    rotations: Float[Array, "k 3 3"],
    shifts: Float[Array, "k 3"],
    *,
    at_once: int | None,
) -> Cover:
    """Weigh many poses by look-ups in the fields of both clouds.

    Args:
        part_field, scan_field: Of the clouds.
        part, scan: Their cells [length].
        eyes: Where the camera may have stood, in the frame of the scan: each pose takes the best [length].
        cell: Width of the cells [length].
        rotations, shifts: From the scan to the part.
        at_once: How many poses to weigh side by side; None: one after the other.
    """

    def one(pose: tuple[Array, Array]) -> Cover:
        rotation, shift = pose
        here = distances(part_field, so3.rotate(rotation, scan.points) + shift[None])
        back = distances(scan_field, so3.rotate(rotation.T, part.points - shift[None]))
        near, mean = _covered(here, scan.mask, SCAN_NEAR, cell)
        seen_from = so3.rotate(rotation, eyes) + shift[None]
        seen = jax.vmap(lambda eye: visible(part.points, part.mask, eye, PIXEL * cell))(seen_from)
        covers = jax.vmap(lambda mask: _covered(back, mask, PART_NEAR, cell))(seen)
        best = jnp.argmin(covers[1])
        return Cover(near, covers[0][best], mean, covers[1][best])

    return lax.map(one, (rotations, shifts), batch_size=at_once)


def _covered(
    distance: Float[Array, " n"], mask: Bool[Array, " n"], near: float, cell: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Compute which share of some cells is covered, and their mean distance."""
    weight = mask.astype(distance.dtype)
    weight = weight / jnp.maximum(jnp.sum(weight), 1)
    share = jnp.sum(jnp.where(distance < near * cell, weight, 0))
    return share, jnp.sum(weight * jnp.minimum(distance, FAR * cell))


class FinePart(NamedTuple):
    """All points of a part, its cells, and the width of these [length]."""

    tree: Tree
    cells: Float[np.ndarray, "n 3"]
    width: float


class FineScan(NamedTuple):
    """All points of a scan, and its cells [length]."""

    tree: Tree
    cells: Float[np.ndarray, "m 3"]


def cover(
    pose: Float[np.ndarray, "4 4"],
    part: FinePart,
    scan: FineScan,
    eyes: Float[np.ndarray, "e 3"],
    cell: float,
) -> Cover:
    """Weigh one pose by the points themselves.

    Args:
        pose: From the part to the scan.
        part, scan: The clouds.
        eyes: Where the camera may have stood, in the frame of the scan: the best counts [length].
        cell: Width that distances are measured by [length].
    """
    back = np.linalg.inv(pose)
    here = part.tree.nearest(moved(back, scan.cells))[1]
    there = scan.tree.nearest(moved(pose, part.cells))[1]
    rows, mask = padded(part.cells)
    found = []
    for eye in moved(back, eyes):
        seen = np.asarray(visible(rows, mask, eye.astype(np.float32), np.float32(PIXEL * part.width)))
        far = there[seen[: len(there)]]
        found.append((float(np.minimum(far, FAR * cell).mean()), float(np.mean(far < PART_NEAR * cell))))
    part_distance, covered = min(found)
    scan_distance = float(np.minimum(here, FAR * cell).mean())
    return Cover(float(np.mean(here < SCAN_NEAR * cell)), covered, scan_distance, part_distance)
