"""Who lies near whom."""

from __future__ import annotations

from functools import cached_property
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
        held = small_gicp().PointCloud(self.points)
        self.held = held, small_gicp().KdTree(held, num_threads=threads)  # as the library takes them

    def nearest(
        self, asked: Float[np.ndarray, "m 3"], within: float = np.inf
    ) -> tuple[Int[np.ndarray, " m"], Float[np.ndarray, " m"]]:
        """Find the nearest point of each point asked about, and how far it is [length].

        Args:
            asked: The points.
            within: Points further than this from all others, which can be told by the box around these, need
                no answer: they get row 0, infinitely far. A tree takes longest over those [length].
        """
        asked = np.ascontiguousarray(asked, np.float64)
        near = self.in_reach(asked, within)
        rows, distance = np.zeros(len(asked), np.int32), np.full(len(asked), np.inf)
        if near.any():
            found = self.neighbours(asked[near], 1)
            rows[near], distance[near] = found.rows[:, 0], np.sqrt(found.squared[:, 0])
        return rows, distance

    def in_reach(self, asked: Float[np.ndarray, "m 3"], within: float) -> Bool[np.ndarray, " m"]:
        """Tell which points lie in the box around these, or not much outside."""
        low, high = self.box
        return np.all((asked >= low - within) & (asked <= high + within), axis=1)

    @cached_property
    def box(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """The lower and the upper corner of the box around the points [length]."""
        return self.points.min(axis=0), self.points.max(axis=0)

    def neighbours(self, asked: Float[np.ndarray, "m 3"], count: int) -> Neighbours:
        """Find the ``count`` nearest points of each point asked about; itself, too, if it is one of them."""
        asked = np.ascontiguousarray(asked, np.float64)
        most = min(count, len(self.points))
        index, squared = self.held[1].batch_knn_search(asked, most, num_threads=self.threads)
        found = np.asarray(index).astype(np.int64)  # none is -1
        none = (found < 0) | (found >= len(self.points))
        here = Neighbours(
            np.where(none, 0, found).astype(np.int32), np.where(none, np.inf, np.asarray(squared, np.float64))
        )
        if most == count:
            return here
        missing = ((0, 0), (0, count - most))
        return Neighbours(np.pad(here.rows, missing), np.pad(here.squared, missing, constant_values=np.inf))
