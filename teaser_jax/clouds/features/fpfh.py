"""Fast point feature histograms: how the normals around a point stand to one another.

Three angles between two points and their normals do not change when the cloud moves. Their histograms over
the neighbours of a point describe the surface there; those of the neighbours are added, the nearer the more.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, UInt32

from teaser_jax.clouds.neighbours import Neighbours
from teaser_jax.ground.arrays import AnyArray, Number

BINS = 11  # of each angle
ROWS_AT_ONCE = 512  # points whose neighbours are held in memory side by side

Orientation: TypeAlias = Literal["local", "given"]
Vectors: TypeAlias = "tuple[Array, ...]"  # by component: what follows fuses into one pass


class Descriptors(NamedTuple):
    """What is known of the surroundings of each point.

    Attributes:
        values: A row of numbers for each point; near rows look alike.
        valid: Which points have surroundings at all.
    """

    values: Float[AnyArray, "n d"]
    valid: Bool[AnyArray, " n"]


@partial(jax.jit, static_argnames="orientation")
def fpfh(
    points: Float[Array, "n 3"],
    normals: Float[Array, "n 3"],
    neighbours: Neighbours,
    radius: Float[Array, ""] | Number,
    *,
    orientation: Orientation = "local",
) -> Descriptors:
    """Describe each point by the histograms of its neighbourhood, 33 numbers.

    A pure function: works under jit and vmap, on CPU and GPU. Padding has zero normals and no neighbours.

    Args:
        points: About their middle [length].
        normals: Unit vectors; a point whose normal is zero has no part in it.
        neighbours: Of each point, with all within the radius or at least a hundred.
        radius: How far the surroundings reach [length].
        orientation: "local": the side on which more of the neighbours lie is the inner one, whatever the
            sign of the normals. "given": normals point out of the surface, as those towards a viewpoint do.

    Returns:
        The histograms, a hundred for each angle and twice that together, and which points have any.

    Gradients: none, histograms are counts.

    References: Rusu, Blodow, Beetz, ICRA 2009.
    """
    points, normals = lax.stop_gradient((points, normals))
    near = neighbours.within(radius) & jnp.any(normals != 0, axis=1)[neighbours.rows]
    near &= jnp.any(normals != 0, axis=1)[:, None]
    blocks = partial(_in_blocks, rows=points.shape[0])
    one = lambda row: _simple(*row, points=points, normals=normals, orientation=orientation)
    own, counts = blocks(
        lambda rows: jax.vmap(lambda *row: one(row))(*rows), (points, normals, neighbours.rows, near)
    )
    valid = counts > 0
    near &= valid[neighbours.rows]
    weight = jnp.where(near, 1 / jnp.where(near, neighbours.squared, 1), 0).astype(points.dtype)
    shared = blocks(
        lambda here: jnp.einsum("nk,nkb->nb", here[0], own[here[1]], precision=lax.Precision.HIGHEST),
        (weight, neighbours.rows),
    )
    return Descriptors(jnp.where(valid[:, None], own + _in_hundreds(shared), 0), valid)


def _in_blocks(function: Any, arrays: tuple[Array, ...], rows: int) -> Any:
    """Call a function on some rows at a time: what it holds of their neighbours stays small."""
    at_once = min(rows, ROWS_AT_ONCE)
    padded = jax.tree.map(lambda x: jnp.pad(x, ((0, -rows % at_once), *((0, 0),) * (x.ndim - 1))), arrays)
    found = lax.map(function, jax.tree.map(lambda x: x.reshape(-1, at_once, *x.shape[1:]), padded))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:rows], found)


def _in_hundreds(histograms: Float[Array, "n 33"]) -> Float[Array, "n 33"]:
    """Let the bins of each angle sum to a hundred, or to nothing."""
    each = histograms.reshape(-1, 3, BINS)
    total = jnp.sum(each, axis=2, keepdims=True)
    return (each * (100 / jnp.where(total > 0, total, 1))).reshape(histograms.shape)


def _simple(
    point: Float[Array, "3"], normal: Float[Array, "3"], index: Array, near: Array, *,
    points: Float[Array, "n 3"], normals: Float[Array, "n 3"], orientation: Orientation,
) -> tuple[Float[Array, "33"], Array]:  # fmt: skip
    """Compute the histograms of a point and its neighbours alone, and count the neighbours."""
    there, across = points[index], normals[index]
    apart = tuple(there[:, i] - point[i] for i in range(3))
    own = tuple(jnp.broadcast_to(normal[i], near.shape) for i in range(3))
    other = tuple(across[:, i] for i in range(3))
    if orientation == "local":
        inwards = jnp.sum(jnp.where(near, _dot(apart, own), 0)) > 0
        own = tuple(jnp.where(inwards, -x, x) for x in own)
        opposed = _dot(own, other) < 0
        other = tuple(jnp.where(opposed, -x, x) for x in other)
    length = jnp.sqrt(_dot(apart, apart))
    line = tuple(x / jnp.where(length > 0, length, 1) for x in apart)
    # Of the two the one whose normal is nearer to the line between them is the first.
    along, along_other = _dot(own, line), _dot(other, line)
    swap = jnp.abs(along) < jnp.abs(along_other)
    u = tuple(jnp.where(swap, b, a) for a, b in zip(own, other, strict=True))
    second = tuple(jnp.where(swap, a, b) for a, b in zip(own, other, strict=True))
    line = tuple(jnp.where(swap, -x, x) for x in line)
    phi = jnp.where(swap, -along_other, along)
    v = _cross(line, u)
    size = jnp.sqrt(_dot(v, v))
    near &= size > 1e-6
    v = tuple(x / jnp.where(size > 0, size, 1) for x in v)
    alpha = _dot(v, second)
    theta = jnp.arctan2(_dot(_cross(u, v), second), _dot(u, second))
    count = jnp.sum(near, dtype=jnp.int32)
    scaled = jnp.stack([(theta + np.pi) / (2 * np.pi), (alpha + 1) / 2, (phi + 1) / 2])
    bins = jnp.clip((BINS * scaled).astype(jnp.uint32), 0, BINS - 1)
    counts = _counted(jnp.where(near, bins, BINS)).astype(point.dtype).reshape(3 * BINS)
    return counts * (100 / jnp.maximum(count, 1).astype(point.dtype)), count


def _counted(bins: UInt32[Array, "3 k"]) -> UInt32[Array, "3 11"]:
    """Count how often each bin occurs; the number of bins itself stands for none.

    Several counters share a word, so that a few sums do for eleven; and the bins are computed once, not
    anew for each sum that reads them.
    """
    bins = lax.optimization_barrier(bins)
    width = 8 if bins.shape[1] < 2**8 else 16  # of a counter, in bits
    a_word = 32 // width
    words = -(-(BINS + 1) // a_word)
    unit = jnp.left_shift(jnp.uint32(1), width * (bins % a_word))
    own = (bins // a_word)[:, None, :] == jnp.arange(words, dtype=jnp.uint32)[None, :, None]
    packed = jnp.sum(jnp.where(own, unit[:, None, :], 0), axis=2, dtype=jnp.uint32)
    counters = packed[:, :, None] >> jnp.arange(0, 32, width, dtype=jnp.uint32)[None, None]
    return (counters & (2**width - 1)).reshape(3, -1)[:, :BINS]


def _dot(a: Vectors, b: Vectors) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vectors, b: Vectors) -> Vectors:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])
