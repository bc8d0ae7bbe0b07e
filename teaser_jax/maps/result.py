"""A map of many clouds: where each lies, what that rests on, and which pairs were refused."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax.clouds.voxel import downsample
from teaser_jax.maps.graph import Engine
from teaser_jax.maps.pair import MapPair
from teaser_jax.maps.placing import Placing
from teaser_jax.maps.shelf import Shelf
from teaser_jax.maps.words import fate, report, summary
from teaser_jax.pose import Pose


@dataclass(frozen=True, eq=False, repr=False)
class CloudMap:
    """The answer of ``register_many``: host values in float64.

    The frame of the map is that of the first cloud of the largest connected part, as given.

    Attributes:
        names: What the clouds are called.
        pairs: All answers to two clouds, also those that were not ok.
        placing: What the map rests on, by rows of ``pairs``.
        engine: What optimised the poses.
        asked: How many pairs there were to ask.
        seconds: What it took, by stage [s].
    """

    names: tuple[str, ...]
    pairs: tuple[MapPair, ...]
    placing: Placing
    engine: Engine
    asked: int
    seconds: dict[str, float]
    _shelf: Shelf

    def __len__(self) -> int:
        return len(self.names)

    @property
    def ok(self) -> bool:
        """Whether all clouds are placed, all pairs were asked, and no contradiction is left open.

        What no cycle holds is as sure as single pairs are: see ``confirmed``.
        """
        return bool(self.placed.all()) and self.asked == len(self.pairs) and not self.doubts

    def __bool__(self) -> bool:
        return self.ok

    @property
    def poses(self) -> Float[np.ndarray, "n 4 4"]:
        """``T_map_cloud`` of each cloud; NaN where it is not placed."""
        return self.placing.poses

    @property
    def placed(self) -> Bool[np.ndarray, " n"]:
        """Which clouds belong to the map: those of the largest connected part."""
        return self.placing.placed

    @property
    def confirmed(self) -> Bool[np.ndarray, " n"]:
        """Which clouds are held by a cycle of pairs that closes; others rest on single pairs alone."""
        return self.placing.confirmed

    @property
    def component(self) -> Int[np.ndarray, " n"]:
        """Which clouds are connected with one another: a number for each, 0 for the largest part."""
        return self.placing.component

    @property
    def kept(self) -> list[MapPair]:
        """The pairs that the map rests on."""
        return [self.pairs[k] for k in self.placing.kept]

    @property
    def refused(self) -> list[tuple[MapPair, str]]:
        """Pairs whose clouds alone trust their pose and which the map refuses, and why."""
        p = self.placing
        return [(self.pairs[k], fate(self, k)) for k in sorted({*p.refused, *p.strained, *p.withheld})]

    @property
    def doubts(self) -> list[str]:
        """Contradictions of which no one can tell which side is right, in sentences."""
        open_ = [k for k, refusal in self.placing.refused.items() if not refusal.is_clear]
        return [fate(self, k) for k in open_]

    def why(self, i: int, j: int) -> str:
        """Say in words what became of a pair. Raises ValueError for one that was not asked."""
        for k, pair in enumerate(self.pairs):
            if {pair.i, pair.j} == {i, j}:
                return fate(self, k)
        raise ValueError(f"({i}, {j}) is no pair that was asked.")

    def points(self) -> Iterator[tuple[int, Float[np.ndarray, "m 3"]]]:
        """Give the number of each placed cloud and its points in the frame of the map [length].

        They are those that were used; clouds of files are read once more.
        """
        for k in map(int, np.flatnonzero(self.placed)):
            cloud = self._shelf[k].cloud
            yield k, Pose.from_matrix(self.poses[k]).apply(cloud.points + cloud.origin)

    def rows_used(self, k: int) -> Int[np.ndarray, " m"]:
        """Give the rows of a cloud, as given, that are used; a cloud of a file is read once more."""
        return self._shelf[k].cloud.rows

    def merged(self, voxel_size: float | None = None) -> Float[np.ndarray, "m 3"]:
        """Lay all placed clouds together in the frame of the map [length].

        Args:
            voxel_size: Width of cells of which each gets one point, the mean; None: all points [length].
        """
        found = [points for _, points in self.points()]
        if not found:
            return np.zeros((0, 3))
        together = np.concatenate(found)
        if voxel_size is None:
            return together
        middle = np.median(together, axis=0)
        return downsample(together - middle, voxel_size) + middle

    def report(self) -> str:
        """Tell of each pair what became of it, a line for each, after the summary."""
        return report(self)

    def __repr__(self) -> str:
        return summary(self)
