"""Which pairs are asked: all of few clouds; of many, neighbours in time and clouds that look alike."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from teaser_jax.ground.checks import shown
from teaser_jax.maps.shelf import Shelf

ALL = 30  # clouds of which all pairs are asked
NEXT = 3  # clouds that follow, each of which is asked
ALIKE = 5  # clouds that look alike, beyond those
# The look of a cloud: cells that it is described with, and kinds of surroundings that are told apart.
CELLS, KINDS, ROUNDS = 3000, 32, 10
ASKED = 20_000  # descriptors, of all clouds together, that tell which kinds there are


def pairs_to_ask(shelf: Shelf, pairs: str | Iterable[Any] | None) -> list[tuple[int, int]]:
    """Choose pairs (i, j), i < j, near ones in time first.

    Args:
        shelf: The clouds.
        pairs: "all"; "some": neighbours in time and those that look alike; None: all of up to thirty clouds,
            some of more; or the pairs themselves.

    Raises:
        ValueError: If a pair is none.
    """
    count = len(shelf)
    if pairs is None:
        pairs = "all" if count <= ALL else "some"
    if isinstance(pairs, str):
        if pairs not in ("all", "some"):
            raise ValueError(f"pairs is {pairs!r}: expected 'all', 'some', or a list of pairs of numbers.")
        if pairs == "some":
            return _some(shelf)
        return sorted(((i, j) for j in range(count) for i in range(j)), key=lambda p: (p[1] - p[0], p))
    return [*dict.fromkeys(_checked(pair, count) for pair in pairs)]


def _checked(pair: Any, count: int) -> tuple[int, int]:
    try:
        i, j = sorted(pair)
    except (TypeError, ValueError):
        raise ValueError(f"pairs: {shown(pair)} is none: give two numbers of clouds each.") from None
    whole = isinstance(i, Integral) and isinstance(j, Integral)
    if not (whole and 0 <= int(i) < int(j) < count):
        raise ValueError(f"pairs: {shown(pair)} is none of {count} clouds, which are counted from 0.")
    return int(i), int(j)


def _some(shelf: Shelf) -> list[tuple[int, int]]:
    count = len(shelf)
    near = [(i, j) for i in range(count) for j in range(i + 1, min(i + 1 + NEXT, count))]
    alike = looks(shelf)
    alike = alike @ alike.T
    rows = np.arange(count)
    alike[np.abs(rows[:, None] - rows) <= NEXT] = -np.inf
    loops = set()
    for i in range(count):
        best = np.argsort(-alike[i], kind="stable")[:ALIKE]
        loops |= {(min(i, int(j)), max(i, int(j))) for j in best if np.isfinite(alike[i, j])}
    return near + sorted(loops)


def looks(shelf: Shelf) -> Float[np.ndarray, "n d"]:
    """Describe each cloud as a whole by a unit vector; clouds of one place have near ones.

    What lies around the points of a cloud is told in kinds, and what is left of each kind is added up (a
    vector of locally aggregated descriptors, of FPFH). It does not change when the cloud is moved.

    References: Jegou, Douze, Schmid, Perez, CVPR 2010.
    """
    width = float(np.median([shelf[k].width_for(CELLS) for k in range(len(shelf))]))
    described = [_described(shelf, k, width) for k in range(len(shelf))]
    together = np.concatenate(described)
    kinds = _kinds(together[:: max(1, len(together) // ASKED)])
    found = np.stack([_aggregated(values, kinds) for values in described])
    found -= found.mean(axis=0)  # what all clouds share tells none from another
    return found / np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)


def _described(shelf: Shelf, k: int, width: float) -> Float[np.ndarray, "n 33"]:
    """Describe the points of a cloud; roots, as histograms are compared best by them."""
    cloud = shelf[k]
    found = cloud.surface(cloud.at_least_sampled(width)).descriptors
    return np.sqrt(np.asarray(found.values, np.float64)[np.asarray(found.valid)])


def _kinds(values: Float[np.ndarray, "n d"]) -> Float[np.ndarray, "k d"]:
    """Find kinds among descriptors: their means (k-means), begun with evenly spread rows."""
    order = np.argsort(values @ np.linalg.svd(values - values.mean(axis=0), full_matrices=False)[2][0])
    kinds = values[order[np.linspace(0, len(values) - 1, KINDS).astype(int)]]
    for _ in range(ROUNDS):
        nearest = _nearest(values, kinds)
        counts = np.bincount(nearest, minlength=KINDS)
        sums = _summed(values, nearest)
        kinds = np.where(counts[:, None] > 0, sums / np.maximum(counts, 1)[:, None], kinds)
    return kinds


def _aggregated(values: Float[np.ndarray, "n d"], kinds: Float[np.ndarray, "k d"]) -> Float[np.ndarray, " m"]:
    nearest = _nearest(values, kinds)
    found = _summed(values - kinds[nearest], nearest)
    found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
    return found.ravel()


def _summed(values: Float[np.ndarray, "n d"], kind: Int[np.ndarray, " n"]) -> Float[np.ndarray, "k d"]:
    return np.stack([np.bincount(kind, column, KINDS) for column in values.T], axis=1)


def _nearest(values: Float[np.ndarray, "n d"], kinds: Float[np.ndarray, "k d"]) -> Int[np.ndarray, " n"]:
    return np.argmin(np.sum(kinds**2, axis=1) - 2 * values @ kinds.T, axis=1)
