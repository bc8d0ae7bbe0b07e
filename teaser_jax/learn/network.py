"""A small network that describes the points of a scan, the same however the scan is turned.

First, what pairs of neighbours say without any frame: the angles of two normals with the line between
them and with each other, and the distance, as soft histograms over three neighbourhoods. No derivative
is needed there. Then a graph network: each point hears the mean of its neighbours in three rings.
Rings are matrices and means are products of matrices, which any device does well.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray, Real

from teaser_jax.ground.arrays import AnyArray, Number, at_least_float32, squared_distances
from teaser_jax.ground.checks import check_positive
from teaser_jax.ground.forks import check_fork
from teaser_jax.ground.masked import about_mean, mask_or_all

BINS = 5
PREFERENCE = 0.01  # for the direction to the sensor as a normal, against a spread of the radius squared
LEVELS = (0.25, 0.5, 1.0)  # neighbourhoods and rings, as shares of the reach
FEATURES = len(LEVELS) * 4 * BINS
Parameters: TypeAlias = dict[str, Any]


class Scan(NamedTuple):
    """A ``Scan`` holds points as the network takes them, with what their neighbourhoods say.

    Attributes:
        points: The points of the scan, in its own frame [length].
        features: What each neighbourhood says, the same in every frame [-].
        mask: Points that exist; padding is False.
        reach: The largest distance of a neighbour [length].
    """

    points: Float[Array, "*batch n 3"]
    features: Float[Array, "*batch n f"]
    mask: Bool[Array, "*batch n"]
    reach: Float[Array, "*batch"]


def read_scan(
    points: Real[AnyArray, "n 3"],
    viewpoint: Real[AnyArray, "3"],
    mask: Bool[AnyArray, " n"] | None = None,
    *,
    reach: Number | Float[AnyArray, ""] = 0.32,
) -> Scan:
    """Read the geometry around every point of a scan: normals towards the sensor, and histograms of pairs.

    Args:
        points: A scan [length].
        viewpoint: Where the sensor stood, in the frame of the scan [length]; it tells outside from inside.
        mask: Points that exist; None: all. Points that are not finite, and those without a neighbour within
            reach, of which nothing can be said, are masked.
        reach: How far a neighbour can be [length]: a third of an object.

    Raises:
        ValueError: On shapes that do not fit (``jax.vmap`` takes batches), or a reach that is not above 0.

    Gradients: none; the scan is data.

    References: Drost et al., CVPR 2010 (pairs of oriented points); Rusu et al., ICRA 2009 (histograms).
    """
    points, viewpoint = at_least_float32(points), at_least_float32(viewpoint)
    if points.ndim != 2 or points.shape[1] != 3 or viewpoint.shape != (3,):
        raise ValueError(
            f"points have shape {points.shape} and the viewpoint {viewpoint.shape}: expected (n, 3) and "
            "(3,); use jax.vmap for batches."
        )
    check_positive(reach=reach)
    return _read_scan(
        points, viewpoint, mask_or_all(mask, points.shape[:1]), jnp.asarray(reach, points.dtype)
    )


@jax.jit
def _read_scan(points: Array, viewpoint: Array, mask: Array, reach: Array) -> Scan:
    points, viewpoint = lax.stop_gradient((points, viewpoint))
    mask &= jnp.all(jnp.isfinite(points), axis=1)  # one NaN would reach every mean
    points = jnp.where(mask[:, None], points, 0)
    difference = points[None] - points[:, None]
    distance = jnp.sqrt(jnp.sum(difference**2, axis=2))
    pairs = mask[:, None] & mask[None] & ~jnp.eye(len(points), dtype=bool)
    mask &= jnp.any(pairs & (distance < reach), axis=1)
    radius = LEVELS[0] * reach
    normals = _normals(points, viewpoint, mask, pairs & (distance < radius), radius)
    angles = _angles(difference, distance, normals)
    features = []
    for level in LEVELS:
        near = (pairs & (distance < level * reach)).astype(points.dtype)
        near = near / jnp.maximum(jnp.sum(near, axis=1, keepdims=True), 1)
        lengths = _soft_bins(distance / (level * reach), 0.0, 1.0)
        features += [jnp.einsum("ij,ijm->im", near, x) for x in (angles, lengths)]
    return Scan(points, jnp.concatenate(features, axis=1), mask, reach)


def init_network(
    key: PRNGKeyArray, *, width: int = 64, messages: int = 24, layers: int = 3, size: int = 24
) -> Parameters:
    """Draw random weights for ``describe``, as a pytree.

    Args:
        key: Decides the weights.
        width: Numbers that the network keeps of a point, from layer to layer.
        messages: Numbers that a point sends to its neighbours in each layer.
        layers: How often points hear one another; with 0 each knows its own neighbourhood only.
        size: Numbers in a descriptor.

    Raises:
        ValueError: If one of these numbers is below 1 (``layers``: below 0).
    """
    check_fork()
    if min(width, messages, size) < 1 or layers < 0:
        raise ValueError(
            f"width = {width}, messages = {messages}, size = {size}, layers = {layers}: expected 1 or more, "
            "layers 0 or more."
        )
    keys = iter(jax.random.split(key, 3 + 3 * layers))
    heard = width + messages * len(LEVELS)
    return {
        "enter": [_dense(next(keys), FEATURES, width), _dense(next(keys), width, width)],
        "layers": [
            {
                "send": _dense(next(keys), width, messages),
                "think": [_dense(next(keys), heard, width), _dense(next(keys), width, width)],
            }
            for _ in range(layers)
        ],
        "leave": _dense(next(keys), width * (layers + 1), size),
    }


def describe(parameters: Parameters, scan: Scan) -> Float[Array, "n d"]:
    """Describe every point of one scan by a vector of length 1 (to 1e-6), the same in every frame.

    Descriptors of masked points mean nothing.

    Args:
        parameters: From ``init_network`` or ``train``.
        scan: One scan from ``read_scan``; ``jax.vmap`` takes stacks.

    Gradients: exact in the parameters; none in the scan.
    """
    rings = _rings(scan)
    state = _normalise(_perceptron(parameters["enter"], _normalise(scan.features)))
    states = [state]
    for layer in parameters["layers"]:
        message = jax.nn.relu(_apply(layer["send"], state))
        heard = [state] + [(ring @ message) * share for ring, share in rings]
        state = state + _normalise(_perceptron(layer["think"], jnp.concatenate(heard, axis=1)))
        states.append(state)
    found = _apply(parameters["leave"], jnp.concatenate(states, axis=1))
    # A point that hears nothing has no direction: its length stays 0, and its slope bounded.
    return found * lax.rsqrt(jnp.sum(found * found, axis=1, keepdims=True) + 1e-6)


def _dense(key: PRNGKeyArray, inputs: int, outputs: int) -> dict[str, Array]:
    weights = jax.random.normal(key, (inputs, outputs)) * math.sqrt(2 / inputs)
    return {"weights": weights, "bias": jnp.zeros(outputs)}


def _apply(layer: dict[str, Array], x: Array) -> Array:
    return x @ layer["weights"] + layer["bias"][None]


def _perceptron(layers: list[dict[str, Array]], x: Array) -> Array:
    return _apply(layers[1], jax.nn.relu(_apply(layers[0], x)))


def _normalise(x: Array) -> Array:
    x = x - jnp.mean(x, axis=-1, keepdims=True)
    return x * lax.rsqrt(jnp.mean(x * x, axis=-1, keepdims=True) + 1e-5)


def _rings(scan: Scan) -> list[tuple[Array, Array]]:
    """Tell who is in which ring of whom, as 0 and 1, and one over how many: factors that make a mean."""
    near_origin = about_mean(lax.stop_gradient(scan.points), scan.mask)
    distance2 = squared_distances(near_origin, near_origin)
    found, inner = [], jnp.asarray(-jnp.inf, distance2.dtype)
    for level in LEVELS:
        outer = (level * scan.reach) ** 2
        ring = ((distance2 >= inner) & (distance2 < outer) & scan.mask[None]).astype(distance2.dtype)
        found.append((ring, 1 / jnp.maximum(jnp.sum(ring, axis=1, keepdims=True), 1)))
        inner = outer
    return found


def _normals(
    points: Array, viewpoint: Array, mask: Array, near: Bool[Array, "n n"], radius: Array | float
) -> Float[Array, "n 3"]:
    """Find the direction in which each neighbourhood spreads least, on the side of the sensor.

    Two or three neighbours leave that open: where they do, the direction to the sensor is preferred.
    """
    weight = (near | jnp.eye(len(points), dtype=bool)).astype(points.dtype)
    count = jnp.sum(weight, axis=1, keepdims=True)
    near_origin = about_mean(points, mask)  # so that squares do not cancel
    product = partial(jnp.matmul, precision=lax.Precision.HIGHEST)
    mean = product(weight, near_origin) / count
    outer = (near_origin[:, :, None] * near_origin[:, None, :]).reshape(len(points), 9)
    spread = (product(weight, outer) / count).reshape(-1, 3, 3) - mean[:, :, None] * mean[:, None, :]
    sight = viewpoint[None] - points
    sight = sight * lax.rsqrt(jnp.maximum(jnp.sum(sight**2, axis=1, keepdims=True), 1e-12))
    preferred = PREFERENCE * radius**2 * sight[:, :, None] * sight[:, None, :]
    normals = jnp.linalg.eigh(spread - preferred)[1][:, :, 0]
    outwards = jnp.sum(normals * sight, axis=1, keepdims=True)
    return jnp.where(outwards < 0, -normals, normals)


def _angles(difference: Array, distance: Array, normals: Array) -> Float[Array, "n n m"]:
    """Bin the angles of the two normals of a pair with the line between them, and with each other."""
    direction = difference / jnp.where(distance > 0, distance, 1)[..., None]
    cosines = (
        jnp.einsum("ijk,ik->ij", direction, normals),
        jnp.einsum("ijk,jk->ij", direction, normals),
        normals @ normals.T,
    )
    return jnp.concatenate([_soft_bins(c, -1.0, 1.0) for c in cosines], axis=2)


def _soft_bins(x: Array, low: float, high: float) -> Array:
    """Say how close numbers are to each of a few places, by Gaussian bumps that overlap."""
    places, step = jnp.linspace(low, high, BINS, dtype=x.dtype), (high - low) / (BINS - 1)
    return jnp.exp(-0.75 * ((x[..., None] - places[None, None]) / step) ** 2)
