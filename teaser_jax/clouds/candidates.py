"""Poses that may be right, from several sets of matches, in stages that end when one of them fits.

One width of cells and one way to match finds most poses, and each of them misses others. What fits best on
the clouds themselves is nearly always the best of them, whatever its matches say.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.features.fpfh import Descriptors
from teaser_jax.clouds.features.matching import Nearest, chosen, nearest_of
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.prepared import Prepared
from teaser_jax.clouds.several import several_poses
from teaser_jax.clouds.surface import Surface
from teaser_jax.clouds.trust.judge import CELLS, LIMITS
from teaser_jax.clouds.trust.pairing import lay, shares
from teaser_jax.clouds.trust.space import in_front
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.pose import Pose
from teaser_jax.register import Registration, register
from teaser_jax.settings import ExactClique, Settings

MOST_CELLS = 200_000  # of the larger one
MOST_MATCHES = 5000
FEWEST_MATCHES = 5
# Of the search for a clique, where a thousand prove it in nearly all pairs: a clock would give other bits on
# other days.
NODES = 100_000


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
# Of several answers: the cells that are asked how well they fit, and how many of the answers are aligned and
# compared at the width of the verdict. In both stages of 25 pairs of little overlap: 39 right poses of 50 if
# all are compared, 37 if six are, 35 if four. Matches place answers well enough to be asked at once: after a
# first alignment with a wide reach four gave 25. Of right answers a tenth of those cells fits at least.
COARSE_CELLS = 3000
ASKED, COMPARED, WORTH_A_LOOK = 400, 6, 0.08
ENOUGH = 0.30  # a fit that deserves a verdict at once


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that may be right.

    Attributes:
        pose: From the source to the target, in the frames as given.
        fit: Which part of the overlap fits at the width of the verdict [-].
        cells: How many cells fit.
        in_front: Which share of the cells lies in front of what the other sensor saw [-]; NaN: unknown.
        found_by: How it was found.
        registration: The answer of ``register`` to the matches, in the frames as given; None: it was found
            in another way.
    """

    pose: Pose
    fit: float
    cells: int
    in_front: float
    found_by: str
    registration: Registration | None

    @property
    def score(self) -> float:
        """What candidates are ranked by: the fit, if there are cells enough to tell, and free space."""
        fit = self.fit if self.cells >= LIMITS.cells else min(self.fit, 0.1)
        return fit if np.isnan(self.in_front) else fit * (1 - self.in_front) ** 2


@dataclass(frozen=True, eq=False)
class Search:
    """The search for candidates of one pair, with what was matched at each width of cells.

    Attributes:
        pair: The clouds.
        described: Descriptors for each point of the source and of the target; None: those of the shape.
        end: When the work has to end, on the clock of ``time.perf_counter``; None: never.
    """

    pair: Pair
    described: tuple[AnyArray, AnyArray] | None = None
    end: float | None = None
    _nearest: dict[int, Nearest] = field(default_factory=dict)

    @property
    def seconds_left(self) -> float:
        """The time that is left; infinite if there is no end."""
        return np.inf if self.end is None else max(0.0, self.end - time.perf_counter())

    def matches(self, stage: Stage) -> tuple[Float[np.ndarray, "m 3"], Float[np.ndarray, "m 3"]]:
        """Match points of both clouds, each about its middle, the clearest matches first."""
        pair = self.pair
        src, dst = pair.surfaces(stage.cells, MOST_CELLS)
        with pair.timed("descriptors"):
            a, b = self._descriptors(src, dst)
        with pair.timed("matching"):
            if stage.cells not in self._nearest:
                self._nearest[stage.cells] = nearest_of(a, b)
            valid = np.asarray(a.valid), np.asarray(b.valid)
            found = chosen(self._nearest[stage.cells], *valid, mutual=stage.mutual, most=MOST_MATCHES)
            return src.points[found.rows[:, 0]], dst.points[found.rows[:, 1]]

    def candidate(self, stage: Stage) -> Candidate | None:
        """Find the candidate of one stage; None: there are no matches to speak of."""
        src, dst = self.matches(stage)
        if len(src) < FEWEST_MATCHES:
            return None
        if stage.several:
            return self._best_of_several(stage, src, dst)
        pair = self.pair
        bound = stage.bound * pair.width(stage.cells, MOST_CELLS)
        settings = Settings(clique=ExactClique(nodes=NODES, seconds=max(0.01, self.seconds_left)))
        with pair.timed("register"):
            given = (src + pair.src.cloud.origin) / pair.scale, dst + pair.dst.cloud.origin
            found = register(*given, noise_bound=bound, scale=pair.scale, settings=settings)
        return self.compared(found.pose, str(stage), found)

    def _best_of_several(
        self, stage: Stage, src: Float[np.ndarray, "m 3"], dst: Float[np.ndarray, "m 3"]
    ) -> Candidate | None:
        """Find the answer to one set of matches that fits best; None: none is worth a look."""
        pair = self.pair
        with pair.timed("several answers"):
            poses = several_poses(src, dst, pair.width(stage.cells, MOST_CELLS), stage.bound, MOST_MATCHES)
        if len(poses) == 0:
            return None
        coarse = pair.surfaces(COARSE_CELLS, MOST_CELLS)
        with pair.timed("alignment"):
            rows = np.linspace(0, len(coarse[0]) - 1, ASKED).astype(np.int64)
            quick = shares(poses, *coarse, rows)
        best = None
        for k in np.argsort(-quick, kind="stable")[:COMPARED]:
            if quick[k] < WORTH_A_LOOK or (best is not None and best.score >= ENOUGH):
                break
            found = self.compared(pair.given(poses[k]), str(stage), None)
            best = found if best is None or found.score > best.score else best
        return best

    def compared(self, pose: Pose, found_by: str, registration: Registration | None) -> Candidate:
        """Align a pose at the width of the verdict, and tell how well the clouds fit there."""
        pair = self.pair
        src, dst = pair.surfaces(CELLS, MOST_CELLS)
        with pair.timed("alignment"):
            aligned = align(align(pair.centred(pose), src, dst, reach=3.0), src, dst)
        return self.weighed(aligned, found_by, registration)

    def weighed(
        self, aligned: Float[np.ndarray, "4 4"], found_by: str, registration: Registration | None
    ) -> Candidate:
        """Tell how well the clouds fit in a pose between their middles."""
        pair = self.pair
        src, dst = pair.surfaces(CELLS, MOST_CELLS)
        with pair.timed("alignment"):
            laid = lay(aligned, src, dst)
            looked_through = in_front(aligned, src, dst, pair.images)
        return Candidate(pair.given(aligned), laid.fit, laid.count, looked_through, found_by, registration)

    def _descriptors(self, src: Surface, dst: Surface) -> tuple[Descriptors, Descriptors]:
        if self.described is None:
            return src.descriptors, dst.descriptors
        clouds = self.pair.src, self.pair.dst
        a, b = (
            nearest_descriptors(cloud, surface, values)
            for cloud, surface, values in zip(clouds, (src, dst), self.described, strict=True)
        )
        return a, b


def nearest_descriptors(cloud: Prepared, surface: Surface, values: AnyArray) -> Descriptors:
    """Give each cell the descriptor of the point nearest to its mean, among those with finite numbers."""
    rows = cloud.tree.nearest(surface.points)[0]
    values = np.asarray(values, np.float32)[rows]
    valid = np.isfinite(values).all(axis=1)
    return Descriptors(np.where(valid[:, None], values, 0), valid)


def candidates(search: Search, show: Callable[[str], None]) -> Iterator[Candidate]:
    """Find candidates way by way, until nobody asks for more or the time is over.

    Args:
        search: The clouds, and what was found of them.
        show: A function that is told what is being done.
    """
    for stage in STAGES:
        show(f"matching {stage}")
        found = search.candidate(stage)
        if found is not None:
            yield found
        if search.seconds_left == 0:
            return
