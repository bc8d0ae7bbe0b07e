"""A training loop for descriptors that needs no pose labels: the solver makes them as training goes.

Each step matches a batch of scan pairs with the network as it is, lets the teacher solve them, and
pulls descriptors of the same place together, under the poses that the teacher trusts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, PRNGKeyArray

from teaser_jax.ground.arrays import AnyArray, Number
from teaser_jax.ground.checks import check_positive
from teaser_jax.ground.forks import check_fork
from teaser_jax.ground.masked import masked_mean
from teaser_jax.learn.losses import matching_loss, rotation_loss
from teaser_jax.learn.matching import match
from teaser_jax.learn.network import Parameters, Scan, describe, read_scan
from teaser_jax.learn.teacher import Labels, teacher
from teaser_jax.pose import Pose


class Pairs(NamedTuple):
    """``Pairs`` hold the scans of a data set, stacked along the first axis.

    Attributes:
        src, dst: Both scans of each pair, each in its own frame.
        truth: ``T_dst_src``, for ``truth_labels`` and for statistics; None: not known, and not needed.
    """

    src: Scan
    dst: Scan
    truth: Pose | None = None


class History(NamedTuple):
    """A ``History`` tells what training did, step by step.

    Attributes:
        loss: The loss of the trusted pairs [nat].
        trusted: Which pairs of the batch the teacher trusted.
        angle: The angle between the teacher's rotation and the true one [rad]; NaN where that is not known.
    """

    loss: Float[Array, " steps"]
    trusted: Bool[Array, "steps batch"]
    angle: Float[Array, "steps batch"]


LEAST_POINTS = 5  # right matches: the least that a status can call OK
Teach: TypeAlias = Callable[[Parameters, Pairs, Any], Labels]  # network, a batch, noise bound


def read_pairs(pairs: Iterable[Any], *, reach: Number = 0.32) -> Pairs:
    """Read pairs of scans for training, all of one size.

    Args:
        pairs: ``synthetic.ScanPair`` or anything with its fields.
        reach: How far a neighbour can be [length], as in ``read_scan``.

    Returns:
        The pairs in float32, one after the other along the first axis.

    Raises:
        ValueError: If there are none, or they differ in size.
    """
    pairs = list(pairs)
    if not pairs:
        raise ValueError("read_pairs received no pair.")
    sizes = {np.shape(points) for p in pairs for points in (p.src, p.dst)}
    if len({np.shape(p.src) for p in pairs}) > 1 or len({np.shape(p.dst) for p in pairs}) > 1:
        raise ValueError(
            f"scans have shapes {sorted(sizes)}: expected one for all, so that they can be stacked."
        )

    def read(points: list, viewpoints: list) -> Scan:
        both = jnp.asarray(np.stack(points), jnp.float32), jnp.asarray(np.stack(viewpoints), jnp.float32)
        # One after another: every pair of points of a scan is looked at.
        return lax.map(lambda x: read_scan(*x, reach=reach), both)

    truth = jax.tree.map(lambda *x: jnp.asarray(np.stack(x), jnp.float32), *[p.truth for p in pairs])
    return Pairs(
        read([p.src for p in pairs], [p.src_viewpoint for p in pairs]),
        read([p.dst for p in pairs], [p.dst_viewpoint for p in pairs]),
        truth,
    )


def match_scans(
    parameters: Parameters, pairs: Pairs
) -> tuple[Float[Array, "batch n 3"], Float[Array, "batch n 3"], Bool[Array, "batch n"]]:
    """Match the scans of every pair with a network.

    Every point has its most similar counterpart. Asking that pairs choose each other would make the share of
    right matches higher and their number lower, and the poses less accurate.

    Args:
        parameters: From ``init_network`` or ``train``.
        pairs: From ``read_pairs``.

    Returns:
        Points of the source and their counterparts in the target [length], and which matches to use.

    Gradients: none; counterparts are choices.
    """

    def one(src: Scan, dst: Scan) -> tuple[Array, Array, Array]:
        found = match(
            describe(parameters, src), describe(parameters, dst),
            mutual=False, src_mask=src.mask, dst_mask=dst.mask,
        )  # fmt: skip
        return src.points, dst.points[found.counterpart], found.mask

    return jax.vmap(one)(pairs.src, pairs.dst)


def solver_labels(parameters: Parameters, pairs: Pairs, noise_bound: Number | Float[AnyArray, ""]) -> Labels:
    """Let the solver label a batch, from matches of the network as it is.

    Args:
        parameters: The network.
        pairs: The batch.
        noise_bound: Largest error of a right match [length].

    Gradients: none, as ``teacher``.
    """
    src, dst, mask = match_scans(parameters, pairs)
    return teacher(src, dst, noise_bound=noise_bound, mask=mask)


def truth_labels(
    parameters: Parameters | None, pairs: Pairs, noise_bound: Number | Float[AnyArray, ""]
) -> Labels:
    """Label a batch with its true poses, all of them trusted: ordinary supervision.

    Args:
        parameters, noise_bound: Not used; every way to label takes them.
        pairs: The batch.

    Raises:
        ValueError: If the pairs have no true poses.
    """
    if pairs.truth is None:
        raise ValueError(
            "these pairs have no true poses to learn from: give Pairs.truth, or use solver_labels."
        )
    batch, n = pairs.src.mask.shape
    nothing = jnp.zeros((batch, n), bool)
    return Labels(pairs.truth, nothing, jnp.ones(batch, bool), jnp.zeros(batch, jnp.int32))


def train(
    parameters: Parameters,
    pairs: Pairs,
    key: PRNGKeyArray,
    *,
    optimizer: Any,
    steps: int,
    batch: int = 8,
    points: int = 256,
    noise_bound: Number | Float[AnyArray, ""] = 0.05,
    radius: Number | Float[AnyArray, ""] = 0.04,
    temperature: Number | Float[AnyArray, ""] = 0.05,
    labels: Teach = solver_labels,
) -> tuple[Parameters, History]:
    """Train a network on scan pairs; without pose labels unless ``labels=truth_labels``.

    All steps are one ``lax.scan``: the solver, the network and the optimizer compile once.

    Args:
        parameters: From ``init_network`` (or from a checkpoint).
        pairs: From ``read_pairs``.
        key: Decides batches and points.
        optimizer: An optax optimizer.
        steps, batch: Steps, and pairs in each.
        points: Points of each scan that a step looks at, drawn anew each time.
        noise_bound: What the teacher takes for the largest error of a right match [length].
        radius, temperature: As in ``matching_loss`` [length], [-].
        labels: Who labels a batch.

    Returns:
        The trained parameters, and what happened.

    Raises:
        ValueError: If sources and targets differ in number, nothing would be drawn, so few points that no
            pose could be trusted, or a bound, radius or temperature outside jit that is not above 0.
    """
    check_fork()
    check_positive(noise_bound=noise_bound, radius=radius, temperature=temperature)
    _check_sizes(pairs, batch, points, steps)
    return _train(
        parameters, pairs, key, noise_bound, radius, temperature,
        optimizer=optimizer, steps=steps, batch=batch, points=points, labels=labels,
    )  # fmt: skip


def _check_sizes(pairs: Pairs, batch: int, points: int, steps: int) -> None:
    """Raise ValueError unless there are pairs to draw from, and enough points to trust a pose."""
    if not isinstance(pairs, Pairs) or pairs.src.mask.ndim != 2:
        raise ValueError("pairs are not a stack of scans: make them with read_pairs.")
    count, targets = pairs.src.mask.shape[0], pairs.dst.mask.shape[0]
    if targets != count:
        raise ValueError(f"{count} sources and {targets} targets: pairs need one of each.")
    if min(count, batch, steps) < 1 or points < LEAST_POINTS:
        raise ValueError(
            f"received {count} pairs, points = {points}, batch = {batch}, steps = {steps}: expected 1 or "
            f"more, and {LEAST_POINTS} points, the least that can be trusted."
        )


@partial(jax.jit, static_argnames=("optimizer", "steps", "batch", "points", "labels"))
def _train(
    parameters: Parameters, pairs: Pairs, key: Array, noise_bound: Array, radius: Array, temperature: Array,
    *, optimizer: Any, steps: int, batch: int, points: int, labels: Teach,
) -> tuple[Parameters, History]:  # fmt: skip
    def loss(parameters: Parameters, drawn: Pairs, taught: Labels) -> Array:
        def one(src: Scan, dst: Scan, pose: Pose) -> Array:
            return matching_loss(
                describe(parameters, src), describe(parameters, dst), src.points, dst.points, pose,
                radius=radius, temperature=temperature, src_mask=src.mask, dst_mask=dst.mask,
            )  # fmt: skip

        return masked_mean(jax.vmap(one)(drawn.src, drawn.dst, taught.pose), taught.trusted)

    def step(state: tuple, key: Array) -> tuple[tuple, History]:
        parameters, memory = state
        drawn = _drawn(pairs, key, batch, points)
        taught = lax.stop_gradient(labels(parameters, drawn, noise_bound))
        value, slope = jax.value_and_grad(loss)(parameters, drawn, taught)
        # An optimizer is somebody else's code, and may mix kinds of numbers.
        with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
            change, memory = optimizer.update(slope, memory, parameters)
        parameters = jax.tree.map(jnp.add, parameters, change)
        truth = drawn.truth
        angle = jnp.full(batch, jnp.nan) if truth is None else rotation_loss(taught.pose, truth)
        return (parameters, memory), History(value, taught.trusted, angle)

    start = parameters, optimizer.init(parameters)
    (parameters, _), history = lax.scan(step, start, jax.random.split(key, steps))
    return parameters, history


def _drawn(pairs: Pairs, key: Array, batch: int, points: int) -> Pairs:
    """Draw a batch of pairs, and of each scan some points, or all where it has fewer."""
    which, of_src, of_dst = jax.random.split(key, 3)
    drawn = jax.tree.map(lambda x: x[jax.random.randint(which, (batch,), 0, len(pairs.src.mask))], pairs)
    return drawn._replace(src=_thinned(drawn.src, of_src, points), dst=_thinned(drawn.dst, of_dst, points))


def _thinned(scan: Scan, key: Array, points: int) -> Scan:
    rows = jax.random.permutation(key, scan.mask.shape[1])[:points]
    return scan._replace(
        points=scan.points[:, rows], features=scan.features[:, rows], mask=scan.mask[:, rows]
    )
