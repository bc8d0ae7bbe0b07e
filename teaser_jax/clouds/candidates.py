"""Poses that may be right, from several sets of matches, in stages that end when one of them fits.

One width of cells and one way to match finds most poses, and each of them misses others. What fits best on
the clouds themselves is nearly always the best of them, whatever its matches say. Where structure repeats or
little overlaps, more matches agree on a wrong pose than on the right one: the last stages take several poses
from one set of matches, and let the clouds choose.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.features.matching import Nearest, chosen, nearest_of
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.judge import CELLS, FEWEST_CELLS
from teaser_jax.clouds.trust.pairing import both_ways, shares
from teaser_jax.clouds.voxel import downsample, voxel_size_for_both
from teaser_jax.register import Registration, register
from teaser_jax.settings import ExactClique, Settings
from teaser_jax.stages.rivals.search import RivalSearch, find_rivals

MOST_CELLS = 200_000  # of the larger one
MOST_MATCHES = 5000
FEWEST_MATCHES = 5
ENOUGH = 0.30  # a fit at which nobody looks further
SECONDS = 2.0  # a clique may be searched


@dataclass(frozen=True)
class Stage:
    """A way to find matches, and what to make of them.

    Attributes:
        cells: Of the smaller cloud, about.
        mutual: Whether each is the other's nearest.
        bound: How far right matches lie apart at most, in cells.
        several: Whether to take several answers to the matches, and of these the one that fits.
    """

    cells: int
    mutual: bool
    bound: float
    several: bool = False

    def __str__(self) -> str:
        several = ", several answers" if self.several else ""
        return f"{self.cells} cells, {'mutual' if self.mutual else 'nearest'}{several}"


STAGES = (
    Stage(6000, True, 1.0),
    Stage(6000, False, 1.0),
    Stage(3000, False, 1.5),
    Stage(12_000, True, 1.5),
    Stage(6000, False, 1.0, several=True),
    Stage(12_000, True, 1.0, several=True),
)
# Of several answers: how many, the matches that they start from, the cells to move them to where the surfaces
# lie and how far these may be apart, the cells that are asked how well they fit there, and how many of the
# answers are compared at the width of the verdict.
SEVERAL = RivalSearch(answers=12, rows=2048)
COARSE_CELLS, COARSE_REACH = 3000, 4.0
ASKED, COMPARED = 400, 4


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that may be right.

    Attributes:
        pose: From the source to the target, each about its middle, as its ``Cloud`` holds it.
        fit: Which part of the overlap fits at the width of the verdict [-].
        cells: How many cells fit.
        stage: How its matches were found.
        registration: The answer of ``register`` to them; None: it is one of several answers.
    """

    pose: Float[np.ndarray, "4 4"]
    fit: float
    cells: int
    stage: Stage
    registration: Registration | None

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
        if stage.several:
            return self._best_of_several(stage, src, dst)
        start = time.perf_counter()
        size = self.surfaces(stage.cells)[1].voxel_size
        settings = Settings(clique=ExactClique(seconds=SECONDS))
        registration = register(src, dst, noise_bound=stage.bound * size, settings=settings)
        self._spent("register", start)
        start = time.perf_counter()
        found = self.compared(np.array(registration.pose.matrix, np.float64))
        self._spent("comparison", start)
        return Candidate(*found, stage, registration)

    def _best_of_several(
        self, stage: Stage, src: Float[np.ndarray, "m 3"], dst: Float[np.ndarray, "m 3"]
    ) -> Candidate | None:
        """Find the answer to one set of matches that fits best; None: there is no answer."""
        start = time.perf_counter()
        poses = several_poses(src, dst, self.surfaces(stage.cells)[1].voxel_size, stage.bound)
        self._spent("several answers", start)
        if len(poses) == 0:
            return None
        start = time.perf_counter()
        coarse = self.surfaces(COARSE_CELLS)
        poses = np.stack([align(pose, *coarse, reach=COARSE_REACH) for pose in poses])
        rows = np.linspace(0, len(coarse[0]) - 1, ASKED).astype(np.int64)
        quick = shares(poses, *coarse, rows)
        chosen = poses[np.argsort(-quick, kind="stable")[:COMPARED]]
        found = [Candidate(*self.compared(pose), stage, None) for pose in chosen]
        self._spent("comparison", start)
        return max(found, key=lambda candidate: candidate.score)

    def compared(self, pose: Float[np.ndarray, "4 4"]) -> tuple[Float[np.ndarray, "4 4"], float, int]:
        """Align a pose at the width of the verdict: the pose, its fit, and how many cells fit."""
        src, dst = self.surfaces(CELLS)
        pose = align(align(pose, src, dst, reach=3.0), src, dst)
        here, back = both_ways(pose, src, dst)
        return pose, min(here.fit, back.fit), min(here.count, back.count)

    def _spent(self, name: str, start: float) -> None:
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def several_poses(
    src: Float[np.ndarray, "m 3"], dst: Float[np.ndarray, "m 3"], voxel_size: float, bound: float
) -> Float[np.ndarray, "k 4 4"]:
    """Find poses that several sets of matches agree on, best first.

    Args:
        src, dst: Matches, the clearest first, about the middles of their clouds [length].
        voxel_size: Width of a cell [length].
        bound: How far right matches lie apart at most, in cells.
    """
    missing = MOST_MATCHES - len(src)  # one program for all
    a, b = (
        jnp.asarray(np.pad((x / voxel_size).astype(np.float32), ((0, missing), (0, 0)))) for x in (src, dst)
    )
    mask = jnp.asarray(np.arange(MOST_MATCHES) < len(src))
    bounds = jnp.full(MOST_MATCHES, bound, jnp.float32)
    found = jax.device_get(find_rivals(a, b, bounds, mask, scale=jnp.float32(1), search=SEVERAL))
    poses = np.asarray(found.pose.matrix, np.float64)[found.valid]
    poses[:, :3, 3] *= voxel_size
    return poses


def candidates(pair: Pair) -> Iterator[Candidate]:
    """Find candidates stage by stage; end after one that fits."""
    for stage in STAGES:
        found = pair.candidate(stage)
        if found is not None:
            yield found
            if found.score >= ENOUGH:
                return
