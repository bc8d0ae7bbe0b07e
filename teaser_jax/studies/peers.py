"""Other libraries, each through a small adapter, as far as they can be imported."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from teaser_jax.pose import Pose

CONFIDENCE = 0.99  # at which RANSAC stops, as in the paper
FIRST_ITERATIONS = 1000  # that tell how long an iteration takes
FAR = 1.0  # largest distance of ICP's closest points: the model's size


class Peer(NamedTuple):
    """Another library: its answer to (src, dst, noise_bound, scale), and whether it can find a scale."""

    solve: Callable[[np.ndarray, np.ndarray, float, float | None], Pose]
    finds_scale: bool = False


def _kiss_matcher() -> dict[str, Peer]:
    import kiss_matcher

    def solve(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Pose:
        # The bounds of pruning and solving are multiples of the voxel size: make both the noise bound.
        config = kiss_matcher.KISSMatcherConfig(
            bound, robin_noise_bound_gain=1.0, solver_noise_bound_gain=1.0, enable_noise_bound_clamping=False
        )
        matcher = kiss_matcher.KISSMatcher(config)
        found = matcher.prune_and_solve(src.astype(np.float32), dst.astype(np.float32))
        return _pose(found.rotation, found.translation)

    return {"kiss-matcher": Peer(solve)}


def _teaserpp() -> dict[str, Peer]:
    import teaserpp_python as teaserpp

    def solve(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Pose:
        params = teaserpp.RobustRegistrationSolver.Params()
        params.cbar2, params.noise_bound, params.estimate_scaling = 1.0, bound, scale is None
        solver = teaserpp.RobustRegistrationSolver(params)  # a used one keeps state
        solver.solve(src.T.astype(np.float64), dst.T.astype(np.float64))
        found = solver.getSolution()
        return _pose(found.rotation, found.translation, found.scale)

    return {"TEASER++": Peer(solve, finds_scale=True)}


def _open3d() -> dict[str, Peer]:
    import open3d  # noqa: F401

    return {
        "Open3D RANSAC-1k": Peer(partial(_ransac, iterations=1000), finds_scale=True),
        "Open3D RANSAC-10k": Peer(partial(_ransac, iterations=10_000), finds_scale=True),
        "Open3D RANSAC-60s": Peer(partial(_ransac_in, seconds=60.0), finds_scale=True),
        "Open3D FGR": Peer(_fast_global_registration, finds_scale=True),
        "Open3D ICP": Peer(_icp),
    }


def _ransac(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None, *, iterations: int) -> Pose:
    return Pose.from_matrix(_ransac_matrix(src, dst, bound, scale, iterations))


def _ransac_matrix(
    src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None, iterations: int
) -> np.ndarray:
    from open3d.pipelines import registration as r

    fit = r.TransformationEstimationPointToPoint(with_scaling=scale is None)
    found = r.registration_ransac_based_on_correspondence(
        _cloud(src), _cloud(dst), _row_with_row(len(src)), bound, fit, 3, [],
        r.RANSACConvergenceCriteria(iterations, CONFIDENCE),
    )  # fmt: skip
    return np.array(found.transformation)


def _ransac_in(
    src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None, *, seconds: float
) -> Pose:
    """RANSAC with a time-out, which Open3D does not have: as many iterations as fit into it."""
    start = time.perf_counter()
    # On matches that are all wrong, for it stops early on right ones and would seem too fast.
    _ransac_matrix(src, np.roll(dst, 1, axis=0), bound, scale, FIRST_ITERATIONS)
    rate = FIRST_ITERATIONS / (time.perf_counter() - start)
    return _ransac(src, dst, bound, scale, iterations=max(FIRST_ITERATIONS, int(rate * seconds)))


def _fast_global_registration(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Pose:
    """FGR; an unknown scale is Horn's, as in the paper: the ratio of the extents about the centroids."""
    from open3d.pipelines import registration as r

    if scale is None:
        extents = [np.sqrt(np.sum((x - x.mean(axis=0)) ** 2)) for x in (src, dst)]
        scale = float(extents[1] / extents[0])
    option = r.FastGlobalRegistrationOption(
        decrease_mu=True, use_absolute_scale=True, tuple_test=False, maximum_correspondence_distance=bound
    )
    found = r.registration_fgr_based_on_correspondence(
        _cloud(scale * src), _cloud(dst), _row_with_row(len(src)), option
    )
    turn = Pose.from_matrix(found.transformation)
    return _pose(turn.rotation, turn.translation, scale)


def _icp(src: np.ndarray, dst: np.ndarray, bound: float, scale: float | None) -> Pose:
    """ICP from where the clouds are; it does not see the matches."""
    from open3d.pipelines import registration as r

    clouds = [_cloud(np.unique(x, axis=0)) for x in (src, dst)]
    found = r.registration_icp(*clouds, FAR, np.eye(4), r.TransformationEstimationPointToPoint(False))
    return Pose.from_matrix(found.transformation)


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
    """The peers of this environment by name, and why each missing package is missing."""
    peers: dict[str, Peer] = {}
    missing: dict[str, str] = {}
    for package, make in MAKERS.items():
        try:
            peers |= make()
        except ImportError as error:  # also where a library of the system is missing
            missing[package] = str(error)
    return peers, missing
