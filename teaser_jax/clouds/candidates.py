"""Poses that may be right, from several sets of matches, in stages that end when one of them fits.

One width of cells and one way to match finds most poses, and each of them misses others. What fits best on
the clouds themselves is nearly always the best of them, whatever its matches say.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.features.matching import Nearest, chosen, nearest_of
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.judge import CELLS, FEWEST_CELLS
from teaser_jax.clouds.trust.pairing import both_ways
from teaser_jax.clouds.voxel import downsample, voxel_size_for_both
from teaser_jax.register import Registration, register
from teaser_jax.settings import ExactClique, Settings

MOST_CELLS = 200_000  # of the larger one
MOST_MATCHES = 5000
FEWEST_MATCHES = 5
ENOUGH = 0.30  # a fit at which nobody looks further
SECONDS = 2.0  # a clique may be searched


@dataclass(frozen=True)
class Stage:
    """A way to find matches: cells of the smaller cloud, whether mutual, and the bound in cells."""

    cells: int
    mutual: bool
    bound: float

    def __str__(self) -> str:
        return f"{self.cells} cells, {'mutual' if self.mutual else 'nearest'}"


STAGES = (
    Stage(6000, True, 1.0),
    Stage(6000, False, 1.0),
    Stage(3000, False, 1.5),
    Stage(12_000, True, 1.5),
)


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that may be right.

    Attributes:
        pose: From the source to the target, each about its middle, as its ``Cloud`` holds it.
        fit: Which part of the overlap fits at the width of the verdict [-].
        cells: How many cells fit.
        stage: How its matches were found.
        registration: The answer of ``register`` to them.
    """

    pose: Float[np.ndarray, "4 4"]
    fit: float
    cells: int
    stage: Stage
    registration: Registration

    @property
    def score(self) -> float:
        """What candidates are ranked by: the fit, if there are cells enough to tell."""
        return self.fit if self.cells >= FEWEST_CELLS else min(self.fit, 0.1)


@dataclass(frozen=True, eq=False)
class Pair:
    """Two clouds, with what was found at each width of cells, so that nothing is computed twice."""

    src: Cloud
    dst: Cloud
    threads: int = 1
    seconds: dict[str, float] = field(default_factory=dict)
    _surfaces: dict[int, tuple[Surface, Surface]] = field(default_factory=dict)
    _nearest: dict[int, Nearest] = field(default_factory=dict)

    def surfaces(self, cells: int) -> tuple[Surface, Surface]:
        """Cut both clouds into cells, about so many of the smaller one."""
        if cells not in self._surfaces:
            start = time.perf_counter()
            size = voxel_size_for_both(self.src.points, self.dst.points, cells, MOST_CELLS)
            self._surfaces[cells] = tuple(  # type: ignore[assignment]
                Surface(downsample(x.points, size), size, x.viewpoint, self.threads)
                for x in (self.src, self.dst)
            )
            self._spent("cells", start)
        return self._surfaces[cells]

    def matches(self, stage: Stage) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Match points of both surfaces, the clearest matches first."""
        src, dst = self.surfaces(stage.cells)
        start = time.perf_counter()
        described = src.descriptors, dst.descriptors
        self._spent("descriptors", start)
        start = time.perf_counter()
        if stage.cells not in self._nearest:
            self._nearest[stage.cells] = nearest_of(*described)
        valid = [np.asarray(x.valid) for x in described]
        found = chosen(self._nearest[stage.cells], *valid, mutual=stage.mutual, most=MOST_MATCHES)
        self._spent("matching", start)
        return src.points[found.rows[:, 0]], dst.points[found.rows[:, 1]]

    def candidate(self, stage: Stage) -> Candidate | None:
        """Find the candidate of one stage; None: there are no matches to speak of."""
        src, dst = self.matches(stage)
        if len(src) < FEWEST_MATCHES:
            return None
        start = time.perf_counter()
        size = self.surfaces(stage.cells)[1].voxel_size
        settings = Settings(clique=ExactClique(seconds=SECONDS))
        registration = register(src, dst, noise_bound=stage.bound * size, settings=settings)
        self._spent("register", start)
        start = time.perf_counter()
        found = self.compared(np.array(registration.pose.matrix, np.float64))
        self._spent("comparison", start)
        return Candidate(*found, stage, registration)

    def compared(self, pose: Float[np.ndarray, "4 4"]) -> tuple[Float[np.ndarray, "4 4"], float, int]:
        """Align a pose at the width of the verdict: the pose, its fit, and how many cells fit."""
        src, dst = self.surfaces(CELLS)
        pose = align(align(pose, src, dst, reach=3.0), src, dst)
        here, back = both_ways(pose, src, dst)
        return pose, min(here.fit, back.fit), min(here.count, back.count)

    def _spent(self, name: str, start: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def candidates(pair: Pair) -> Iterator[Candidate]:
    """Find candidates stage by stage; end after one that fits."""
    for stage in STAGES:
        found = pair.candidate(stage)
        if found is not None:
            yield found
            if found.score >= ENOUGH:
                return
