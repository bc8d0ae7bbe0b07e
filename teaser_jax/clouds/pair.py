"""Two clouds side by side: cut into cells of one width, and the way between their frames and those given."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.prepared import Prepared
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.pairing import moved
from teaser_jax.clouds.trust.space import Images
from teaser_jax.clouds.voxel import POINTS_A_CELL, count_cells
from teaser_jax.pose import Pose

USUAL_CELLS = 6000  # of the smaller cloud, at the width that a user may give
MARGIN_CELLS, MARGIN_SHARE = 10, 0.1  # around a scan in a map, in cells and in extents of the scan
FEWEST_AROUND = 20


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds, each about its own middle, with what was found at each width of cells.

    Attributes:
        src, dst: The clouds; the source is as large as the target sees it.
        scale: By how much the source was made larger for that [-].
        voxel_size: The width of cells that the user gave; None: it is chosen.
        seconds: What the work took so far, by stage.
    """

    src: Prepared
    dst: Prepared
    scale: float = 1.0
    voxel_size: float | None = None
    seconds: dict[str, float] = field(default_factory=dict)

    def width(self, cells: int, most: int) -> float:
        """Choose the width of cells for both clouds [length].

        The cloud that needs finer cells gets about ``cells`` of them, three points each, so that a map costs
        a scan none of its details; neither gets more than ``most``, and none is finer than the sampling of
        either. A width that the user gave is that of 6000 cells.
        """
        clouds = self.src, self.dst
        if self.voxel_size is not None:
            width = self.voxel_size * (USUAL_CELLS / cells) ** 0.5
        else:
            width = min(x.width_for(min(cells, len(x) // POINTS_A_CELL)) for x in clouds)
            width = max(x.at_least_sampled(width) for x in clouds)
        for x in clouds:
            if len(x) > most and count_cells(x.cloud.points, width) > most:
                width = max(width, x.width_for(most))
        kept = next((x for x in (self.dst, self.src) if x.is_kept), None)
        return width if kept is None or self.voxel_size is not None else kept.next_step(width)

    def surfaces(self, cells: int, most: int) -> tuple[Surface, Surface]:
        """Cut both clouds into cells, about so many of the smaller one."""
        with self.timed("cells"):
            width = self.width(cells, most)
            return self.src.surface(width), self.dst.surface(width)

    def surfaces_near(
        self, pose: Float[np.ndarray, "4 4"], cells: int, most: int, *, quick: bool = False
    ) -> tuple[Surface, Surface]:
        """Cut both clouds into cells; of a map only what lies around the other cloud."""
        with self.timed("cells"):
            width = self.width(cells, most)
            near_dst = _around(self.dst, moved(pose, self.src.outline), width)
            there = self.dst.outline if near_dst is None else near_dst
            near_src = _around(self.src, moved(np.linalg.inv(pose), there), width)
            return tuple(  # type: ignore[return-value]
                x.surface(width, quick=quick) if part is None else x.cut(part, width, quick)
                for x, part in ((self.src, near_src), (self.dst, near_dst))
            )

    @property
    def images(self) -> Images:
        """What the sensor of each cloud saw; None: where it stood is not known."""
        return self.src.range_image, self.dst.range_image

    def centred(self, pose: Pose) -> Float[np.ndarray, "4 4"]:
        """Write a pose between the frames as given as one between the middles."""
        rotation, shift = np.asarray(pose.rotation, np.float64), np.asarray(pose.translation, np.float64)
        return _matrix(rotation, shift + rotation @ self.src.cloud.origin - self.dst.cloud.origin)

    def given(self, matrix: Float[np.ndarray, "4 4"]) -> Pose:
        """Write a pose between the middles as one between the frames as given."""
        rotation = matrix[:3, :3]
        shift = matrix[:3, 3] + self.dst.cloud.origin - rotation @ self.src.cloud.origin
        return Pose(rotation.copy(), shift, np.float64(self.scale))

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Count the time of a block to a stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def _matrix(rotation: Float[np.ndarray, "3 3"], shift: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4 4"]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, shift
    return matrix


def _around(cloud: Prepared, part: Float[np.ndarray, "m 3"], cell: float) -> Float[np.ndarray, "k 3"] | None:
    """Cut out of a map what lies around a part of it; None where that is more than half: leave it whole."""
    low, high = part.min(axis=0), part.max(axis=0)
    margin = MARGIN_CELLS * cell + MARGIN_SHARE * (high - low).max()
    inside = lambda points: ((points > low - margin) & (points < high + margin)).all(axis=1)
    if np.mean(inside(cloud.outline)) >= 0.5:
        return None
    points = cloud.cloud.points
    there = inside(points)
    return points[there] if np.count_nonzero(there) > FEWEST_AROUND else None
