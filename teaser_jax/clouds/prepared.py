"""A cloud that is used more than once: what was found of it at each width of cells is kept."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.cloud import Cloud, as_cloud
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.space import RangeImage, range_image
from teaser_jax.clouds.voxel import LEAST_SPACINGS, POINTS_A_CELL, downsample, spacing, voxel_size_for
from teaser_jax.ground.checks import whole_number
from teaser_jax.ground.flags import as_on_the_host

STEPS = 4  # widths of cells that a kept cloud is cut into, between one and twice as wide
THINNED, ROUGHLY = 40_000, 20_000  # points that tell how far they lie apart; how wide cells are, about
FINER = 4.0  # times finer are cells whose means stand for the points, where cells are counted
LADDER_CELLS = 6000  # of the step that all others are counted from


@dataclass(frozen=True, eq=False)
class Prepared:
    """A cloud with what was found of it, so that nothing is computed twice.

    Attributes:
        cloud: Its points.
        threads: How many threads to ask neighbours with.
        is_kept: Whether it meets other clouds, too: then it is cut at few widths of cells, and all are kept.
    """

    cloud: Cloud
    threads: int = 1
    is_kept: bool = False
    _widths: dict[int, float] = field(default_factory=dict)
    _surfaces: dict[tuple[float, bool], Surface] = field(default_factory=dict)

    def __repr__(self) -> str:
        return f"Prepared({self.cloud!r})"

    def __len__(self) -> int:
        return len(self.cloud)

    @cached_property
    def tree(self) -> Tree:
        """The points, to ask for the nearest."""
        return Tree(self.cloud.points, self.threads)

    @cached_property
    def spacing(self) -> float:
        """The usual distance between neighbouring points [length]."""
        return spacing(self.tree)

    def width_for(self, cells: int) -> float:
        """Find the width of cells that leaves about so many [length]."""
        if cells not in self._widths:
            few, finest = self._thinned
            width = voxel_size_for(few, cells)
            self._widths[cells] = width if width >= finest else voxel_size_for(self.cloud.points, cells)
        return self._widths[cells]

    def at_least_sampled(self, width: float) -> float:
        """Widen cells to one and a half distances between neighbouring points [length].

        Some of the points lie further apart than all: where even they lie near enough, no more is asked.
        """
        if LEAST_SPACINGS * self._spacing_of_some <= width:
            return width
        return max(width, LEAST_SPACINGS * self.spacing)

    @cached_property
    def _spacing_of_some(self) -> float:
        points = self.cloud.points
        return spacing(Tree(points[:: max(1, len(points) // THINNED)], self.threads))

    @cached_property
    def _thinned(self) -> tuple[Float[np.ndarray, "n 3"], float]:
        """Fewer points that fill as many cells, and the finest cells of which that is true [length]."""
        points = self.cloud.points
        if len(points) < 2 * THINNED:
            return points, 0.0
        some = points[:: len(points) // ROUGHLY]
        fine = voxel_size_for(some, LADDER_CELLS) / FINER
        few = downsample(points, fine)
        return (few, 2 * fine) if len(few) < len(points) / 2 else (points, 0.0)

    @cached_property
    def outline(self) -> Float[np.ndarray, "n 3"]:
        """Some of the points, which tell where the cloud is [length]."""
        points = self.cloud.points
        return points[:: max(1, len(points) // ROUGHLY)]

    @cached_property
    def range_image(self) -> RangeImage | None:
        """How far its sensor saw in every direction; None: where that stood is not known."""
        eye = self.cloud.viewpoint
        return None if eye is None else range_image(self.cloud.points, eye)

    def next_step(self, width: float) -> float:
        """Find the next width, not below this one, that a kept cloud is cut at [length]."""
        first = self.width_for(min(LADDER_CELLS, len(self) // POINTS_A_CELL))
        return float(first * 2 ** (np.ceil(STEPS * np.log2(width / first) - 1e-9) / STEPS))

    def surface(self, width: float, *, quick: bool = False) -> Surface:
        """Cut the cloud into cells of a width; a quick surface has rougher normals."""
        if (width, quick) not in self._surfaces:
            self._surfaces[width, quick] = self.cut(self.cloud.points, width, quick)
        return self._surfaces[width, quick]

    def cut(self, points: Float[np.ndarray, "n 3"], width: float, quick: bool) -> Surface:
        """Cut some points of the cloud into cells."""
        return Surface(downsample(points, width), width, self.cloud.viewpoint, self.threads, quick)

    def scaled(self, scale: float) -> Prepared:
        """Make the cloud larger by a factor; 1 leaves it as it is, with all that is known of it."""
        if scale == 1:
            return self
        c = self.cloud
        eye = None if c.viewpoint is None else scale * c.viewpoint
        larger = replace(c, points=scale * c.points, origin=scale * c.origin, viewpoint=eye)
        return Prepared(larger, self.threads, self.is_kept)


def prepare(
    cloud: Any,
    *,
    viewpoint: Any = None,
    crop: Any = None,
    max_range: float | None = None,
    threads: int | None = None,
    name: str = "cloud",
) -> Prepared:
    """Read a cloud once, to register it with many others: a map with each scan that comes.

    What is found of it, as its normals and descriptors, is kept and taken again. So that this can be, it is
    cut into cells of few widths; answers differ from those of an unprepared cloud within their accuracy.

    Args:
        cloud: (n, 3) points: an array, a structured one with fields x, y, z, a cloud of Open3D, or the path
            of a file. What cannot be used (NaN, zeros, strays, repetitions) is left out and counted.
        viewpoint: Where the sensor stood, (3,), in the frame of the cloud [length].
        crop: The lower and the upper corner of a box, (2, 3); points outside are left out [length].
        max_range: Points further away from the viewpoint are left out; from the origin if there is none
            [length].
        threads: How many threads to work with; None: as many as there are cores. They change no answer.
        name: What to call the cloud in errors.

    Returns:
        A ``Prepared``, which ``register_clouds`` takes in the place of either cloud.

    Raises:
        ValueError: If it cannot be read, or has fewer than 100 points that can be used.
        ImportError: Without the extra ``clouds``.
    """
    with as_on_the_host(x64=False):
        read = as_cloud(cloud, name, viewpoint=viewpoint, crop=crop, max_range=max_range)
    return Prepared(read, threads_or_all(threads), is_kept=True)


def as_prepared(cloud: Any, name: str, threads: int, **options: Any) -> Prepared:
    """Read a cloud, or take one that was prepared."""
    if not isinstance(cloud, Prepared):
        return Prepared(as_cloud(cloud, name, **options), threads)
    given = [option for option, value in options.items() if value is not None]
    if given:
        raise ValueError(f"{name} was prepared already: give {' and '.join(given)} to prepare.")
    return cloud


def threads_or_all(threads: int | None) -> int:
    """Read a number of threads; None: as many as there are cores for this process."""
    if threads is not None:
        return whole_number("threads", threads, 1, what="how many threads to work with")
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
