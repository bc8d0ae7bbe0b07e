"""Other libraries, each through a small adapter, as far as they can be imported.

An adapter puts a problem into the library's own terms first, and only then is the library called: whoever
takes the time of ``Question.solve`` takes that of the library alone, as its own users would call it.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from teaser_jax.pose import Pose

CONFIDENCE = 0.99  # at which RANSAC stops, as in the paper
FIRST_ITERATIONS = 10_000  # that tell how long an iteration takes
ALIKE = 0.9  # least ratio of two lengths that RANSAC takes for equal, as in Open3D's tutorial
FAR = 1.0  # largest distance of ICP's closest points: the model's size


class Question(NamedTuple):
    """A problem as another library takes it.

    Attributes:
        solve: The library's call on arrays, clouds and settings that are made; may be repeated. Returns what
            the library returns.
        pose: Reads the pose off what ``solve`` returns.
    """

    solve: Callable[[], Any]
    pose: Callable[[Any], Pose]

    def answer(self) -> Pose:
        """Return the pose, where nobody looks at the clock."""
        return self.pose(self.solve())


class Peer(NamedTuple):
    """Another library: its question of (src, dst, noise_bound, scale), and whether it can find a scale."""

    ask: Callable[[np.ndarray, np.ndarray, float, float | None], Question]
    finds_scale: bool = False


def _kiss_matcher() -> dict[str, Peer]:
    import kiss_matcher

    @functools.cache
    def matcher(bound: float) -> Any:
        # The bounds of pruning and solving are multiples of the voxel size: make both the noise bound.
        config = kiss_matcher.KISSMatcherConfig(
            bound, robin_noise_bound_gain=1.0, solver_noise_bound_gain=1.0, enable_noise_bound_clamping=False
        )
        return kiss_matcher.KISSMatcher(config)  # a used one answers as a new one does: it resets itself

    def ask(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Question:
        # It takes sequences of points: from a list it reads them faster than from an array.
        rows = [list(np.ascontiguousarray(x, np.float32)) for x in (src, dst)]
        return Question(
            partial(matcher(bound).prune_and_solve, *rows),
            lambda found: _pose(found.rotation, found.translation),
        )

    return {"kiss-matcher": Peer(ask)}


def _teaserpp() -> dict[str, Peer]:
    import teaserpp_python as teaserpp

    def ask(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Question:
        params = teaserpp.RobustRegistrationSolver.Params()
        params.cbar2, params.noise_bound, params.estimate_scaling = 1.0, bound, scale is None
        columns = [np.asfortranarray(x.T, np.float64) for x in (src, dst)]

        def solve() -> Any:
            solver = teaserpp.RobustRegistrationSolver(params)  # a used one keeps state
            solver.solve(*columns)
            return solver.getSolution()

        return Question(solve, lambda found: _pose(found.rotation, found.translation, found.scale))

    return {"TEASER++": Peer(ask, finds_scale=True)}


def _open3d() -> dict[str, Peer]:
    import open3d  # noqa: F401

    return {
        "Open3D RANSAC-1k": Peer(partial(_ransac, iterations=1000), finds_scale=True),
        "Open3D RANSAC-10k": Peer(partial(_ransac, iterations=10_000), finds_scale=True),
        "Open3D RANSAC-60s": Peer(partial(_ransac_in, seconds=60.0), finds_scale=True),
        "Open3D FGR": Peer(_fast_global_registration, finds_scale=True),
        "Open3D ICP": Peer(_icp),
    }


def _ransac(
    src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None, *, iterations: int
) -> Question:
    from open3d.pipelines import registration as r

    # Open3D's own tutorial rejects samples by these two before it counts who agrees with them, which is four
    # to a hundred times faster and as often right. A scale changes lengths.
    checks = [] if scale is None else [r.CorrespondenceCheckerBasedOnEdgeLength(ALIKE)]
    solve = partial(
        r.registration_ransac_based_on_correspondence,
        _cloud(src), _cloud(dst), _row_with_row(len(src)), bound,
        r.TransformationEstimationPointToPoint(with_scaling=scale is None), 3,
        [*checks, r.CorrespondenceCheckerBasedOnDistance(bound)],
        r.RANSACConvergenceCriteria(iterations, CONFIDENCE),
    )  # fmt: skip
    return Question(solve, _transformation)


def _ransac_in(
    src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None, *, seconds: float
) -> Question:
    """Make a question for RANSAC with a time-out, which Open3D lacks: as many iterations as fit into it."""
    # On matches that are all wrong, for it stops early on right ones and would seem too fast.
    trial = _ransac(src, np.roll(dst, 1, axis=0), bound, scale, iterations=FIRST_ITERATIONS)
    start = time.perf_counter()
    trial.solve()
    rate = FIRST_ITERATIONS / (time.perf_counter() - start)
    return _ransac(src, dst, bound, scale, iterations=max(FIRST_ITERATIONS, int(rate * seconds)))


def _fast_global_registration(
    src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None
) -> Question:
    """Make a question for FGR.

    An unknown scale is Horn's, as in the paper: the ratio of the extents about the centroids.
    """
    from open3d.pipelines import registration as r

    target, rows = _cloud(dst), _row_with_row(len(src))
    option = r.FastGlobalRegistrationOption(
        decrease_mu=True, use_absolute_scale=True, tuple_test=False, maximum_correspondence_distance=bound
    )

    def at(scale: float, source: Any) -> tuple[float, Any]:
        return scale, r.registration_fgr_based_on_correspondence(source, target, rows, option)

    def with_scale() -> tuple[float, Any]:  # finding one is a part of the work
        extents = [np.sqrt(np.sum((x - x.mean(axis=0)) ** 2)) for x in (src, dst)]
        found = float(extents[1] / extents[0])
        return at(found, _cloud(found * src))

    def pose(found: tuple[float, Any]) -> Pose:
        turn = _transformation(found[1])
        return _pose(turn.rotation, turn.translation, found[0])

    return Question(with_scale if scale is None else partial(at, scale, _cloud(scale * src)), pose)


def _icp(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Question:
    """Make a question for ICP, which starts from where the clouds are and does not see the matches."""
    from open3d.pipelines import registration as r

    clouds = [_cloud(np.unique(x, axis=0)) for x in (src, dst)]
    fit = r.TransformationEstimationPointToPoint(False)
    return Question(partial(r.registration_icp, *clouds, FAR, np.eye(4), fit), _transformation)


def _transformation(found: Any) -> Pose:
    return Pose.from_matrix(np.array(found.transformation))


def _cloud(points: np.ndarray) -> Any:
    import open3d as o3d

    return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.ascontiguousarray(points, np.float64)))


def _row_with_row(n: int) -> Any:
    import open3d as o3d

    return o3d.utility.Vector2iVector(np.repeat(np.arange(n, dtype=np.int32)[:, None], 2, axis=1))


def _pose(rotation: Any, translation: Any, scale: Any = 1.0) -> Pose:
    return Pose(
        np.asarray(rotation, np.float64),
        np.asarray(translation, np.float64).ravel(),
        np.asarray(scale, float),
    )


MAKERS = {"teaserpp_python": _teaserpp, "kiss-matcher": _kiss_matcher, "open3d": _open3d}


@functools.cache
def find_peers() -> tuple[dict[str, Peer], dict[str, str]]:
    """Find the peers of this environment by name, and why each missing package is missing."""
    peers: dict[str, Peer] = {}
    missing: dict[str, str] = {}
    for package, make in MAKERS.items():
        try:
            peers |= make()
        except ImportError as error:  # also where a library of the system is missing
            missing[package] = str(error)
    return peers, missing
