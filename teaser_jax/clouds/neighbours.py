"""Who lies near whom."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.clouds.extra import small_gicp
from teaser_jax.ground.arrays import AnyArray


class Neighbours(NamedTuple):
    """The nearest points of each point, nearest first; a place without a neighbour is infinitely far.

    Attributes:
        rows: Which points they are.
        squared: Their squared distances [length^2].
    """

    rows: Int[AnyArray, "n k"]
    squared: Float[AnyArray, "n k"]

    def within(self, radius: AnyArray) -> Bool[AnyArray, "n k"]:
        """Tell which neighbours lie within a radius, and not in the same place."""
        return (self.squared <= radius**2) & (self.squared > 0)


class Tree:
    """Points that are asked for their nearest ones again and again.

    Args:
        points: (n, 3), at least one [length].
        threads: How many threads to ask with: they change no answer.
    """

    def __init__(self, points: Float[np.ndarray, "n 3"], threads: int = 1) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        self.threads = threads
        self._tree = small_gicp().KdTree(self.points, num_threads=threads)

    def nearest(
        self, asked: Float[np.ndarray, "m 3"]
    ) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Find the nearest point of each point asked about, and how far it is [length]."""
        found = self.neighbours(asked, 1)
        return found.rows[:, 0], np.sqrt(found.squared[:, 0])

    def neighbours(self, asked: Float[np.ndarray, "m 3"], count: int) -> Neighbours:
        """Find the ``count`` nearest points of each point asked about; itself, too, if it is one of them."""
        asked = np.ascontiguousarray(asked, np.float64)
        most = min(count, len(self.points))
        index, squared = self._tree.batch_knn_search(asked, most, num_threads=self.threads)
        found = np.asarray(index).astype(np.int64)  # none is -1
        none = (found < 0) | (found >= len(self.points))
        here = Neighbours(
            np.where(none, 0, found).astype(np.int32), np.where(none, np.inf, np.asarray(squared, np.float64))
        )
        if most == count:
            return here
        missing = ((0, 0), (0, count - most))
        return Neighbours(np.pad(here.rows, missing), np.pad(here.squared, missing, constant_values=np.inf))
