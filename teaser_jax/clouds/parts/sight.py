"""What of a cloud a camera sees, and where it may have stood when it saw nothing but one side."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.clouds.sizes import padded

PIXELS = 128  # a side; what lies beyond counts for the last one
PIXEL = 1.5  # cells: wider than points lie apart, or a camera looks through
BEHIND = 1.5  # pixels: so far behind the nearest point of its line may a point lie that is seen
# Where the camera is unknown.
DIRECTIONS = 256
AWAY = 2.0  # diagonals of the scan: depth cameras stand at one to three of a part that fills their view
AS_GOOD = 0.01  # of the cells hidden more than from the best place


@jax.jit
def visible(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], eye: Float[Array, "3"], pixel: Float[Array, ""]
) -> Bool[Array, " n"]:
    """Tell which points no other point hides from a camera.

    Args:
        points: [length].
        mask: Rows that hold a point.
        eye: Where the camera stands; it looks at the mean of the points.
        pixel: Width of its pixels there [length].
    """
    number = _pixels(points, mask, eye, pixel)
    distance = jnp.where(mask, jnp.sqrt(jnp.sum((points - eye[None]) ** 2, axis=1)), jnp.inf)
    nearest = jnp.full(PIXELS**2, jnp.inf, points.dtype).at[number].min(distance)
    return mask & (distance < nearest[number] + BEHIND * pixel)


def _pixels(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], eye: Float[Array, "3"], pixel: Float[Array, ""]
) -> Int[Array, " n"]:
    """Find the pixel in which a camera sees each point."""
    rows = mask.astype(points.dtype)
    ahead = jnp.sum(rows[:, None] * (points - eye[None]), axis=0) / jnp.sum(rows)
    away = jnp.maximum(jnp.sqrt(jnp.sum(ahead**2)), jnp.finfo(points.dtype).tiny)
    ahead = ahead / away
    aside = jnp.where(
        jnp.abs(ahead[0]) < 0.9, jnp.eye(3, dtype=points.dtype)[0], jnp.eye(3, dtype=points.dtype)[1]
    )
    right = jnp.cross(ahead, aside)
    right = right / jnp.sqrt(jnp.sum(right**2))
    along = points - eye[None]
    depth = jnp.maximum(jnp.sum(along * ahead[None], axis=1), 1e-3 * away)
    place = [
        jnp.floor(jnp.sum(along * axis[None], axis=1) / depth * (away / pixel)).astype(jnp.int32)
        + PIXELS // 2
        for axis in (right, jnp.cross(ahead, right))
    ]
    x, y = (jnp.clip(k, 0, PIXELS - 1) for k in place)
    return x * PIXELS + y


def likely_eyes(points: Float[np.ndarray, "n 3"], cell: float) -> Float[np.ndarray, "2 3"]:
    """Guess where the camera of a scan stood: on either side of it.

    From where it stood no point of the scan hides another. The same holds on the far side, as no scan has a
    back; so this tells a line of sight, and not which way.

    Args:
        points: Of the scan, one a cell [length].
        cell: Width of the cells [length].
    """
    low, high = points.min(axis=0), points.max(axis=0)
    middle, away = (low + high) / 2, AWAY * float(np.linalg.norm(high - low))
    directions = _even_directions(DIRECTIONS)
    rows, mask = padded(points - middle)
    count = np.asarray(
        _seen_from(rows, mask, (away * directions).astype(np.float32), np.float32(PIXEL * cell))
    )
    good = directions[count >= count.max() - AS_GOOD * len(points)]
    line = np.linalg.eigh(good.T @ good)[1][:, -1]
    return middle + away * np.stack([line, -line])


@jax.jit
def _seen_from(
    points: Float[Array, "n 3"], mask: Bool[Array, " n"], eyes: Float[Array, "k 3"], pixel: Float[Array, ""]
) -> Int[Array, " k"]:
    """Count the points that are visible from each of many places."""
    return lax.map(lambda eye: jnp.sum(visible(points, mask, eye, pixel), dtype=jnp.int32), eyes)


def _even_directions(count: int) -> Float[np.ndarray, "count 3"]:
    """Spread directions evenly: a Fibonacci spiral on the sphere."""
    height = 1 - 2 * (np.arange(count) + 0.5) / count
    angle, width = np.arange(count) * np.pi * (3 - np.sqrt(5)), np.sqrt(1 - height**2)
    return np.stack([width * np.cos(angle), width * np.sin(angle), height], axis=1)
