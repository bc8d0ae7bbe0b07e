"""Other libraries, each through a small adapter, as far as they can be imported."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from benchmarks.problems import Case
from teaser_jax import Pose


class Peer(NamedTuple):
    """Another library's answer to a case, and the cases that it can be asked."""

    solve: Callable[[Case], Pose]
    suits: Callable[[Case], bool]


def _kiss_matcher() -> Peer:
    import kiss_matcher

    def solve(case: Case) -> Pose:
        # The bounds of pruning and solving are multiples of the voxel size: make both the noise bound.
        config = kiss_matcher.KISSMatcherConfig(
            case.noise_bound, robin_noise_bound_gain=1.0, solver_noise_bound_gain=1.0,
            enable_noise_bound_clamping=False,
        )  # fmt: skip
        matcher = kiss_matcher.KISSMatcher(config)
        found = matcher.prune_and_solve(case.src.astype(np.float32), case.dst.astype(np.float32))
        return Pose(np.asarray(found.rotation), np.asarray(found.translation).ravel(), np.asarray(1.0))

    return Peer(solve, lambda case: case.scale is not None)


def _teaserpp() -> Peer:
    import teaserpp_python as teaserpp

    def solve(case: Case) -> Pose:
        params = teaserpp.RobustRegistrationSolver.Params()
        params.cbar2, params.noise_bound = 1.0, case.noise_bound
        params.estimate_scaling = case.scale is None
        solver = teaserpp.RobustRegistrationSolver(params)  # a used one keeps state
        solver.solve(case.src.T.astype(np.float64), case.dst.T.astype(np.float64))
        found = solver.getSolution()
        return Pose(np.asarray(found.rotation), np.asarray(found.translation), np.asarray(found.scale))

    return Peer(solve, lambda case: True)


def _open3d(solve_pair: Callable[..., np.ndarray], most: int) -> Peer:
    import open3d as o3d

    def solve(case: Case) -> Pose:
        clouds = [o3d.geometry.PointCloud() for _ in range(2)]
        for cloud, points in zip(clouds, (case.src, case.dst), strict=True):
            cloud.points = o3d.utility.Vector3dVector(np.asarray(points, np.float64))
        rows = np.repeat(np.arange(len(case.src), dtype=np.int32)[:, None], 2, axis=1)
        matrix = solve_pair(*clouds, o3d.utility.Vector2iVector(rows), case.noise_bound)
        return Pose(matrix[:3, :3], matrix[:3, 3], np.asarray(1.0))

    return Peer(solve, lambda case: case.scale is not None and len(case.src) <= most)


def _fast_global_registration() -> Peer:
    from open3d.pipelines import registration as r

    def solve_pair(a, b, rows, bound: float) -> np.ndarray:
        option = r.FastGlobalRegistrationOption(
            decrease_mu=True, use_absolute_scale=True, tuple_test=False, maximum_correspondence_distance=bound
        )
        return np.array(r.registration_fgr_based_on_correspondence(a, b, rows, option).transformation)

    return _open3d(solve_pair, most=10_000)


def _ransac() -> Peer:
    from open3d.pipelines import registration as r

    def solve_pair(a, b, rows, bound: float) -> np.ndarray:
        rigid, stop = r.TransformationEstimationPointToPoint(False), r.RANSACConvergenceCriteria(10_000, 0.99)
        return np.array(
            r.registration_ransac_based_on_correspondence(
                a, b, rows, bound, rigid, 3, [], stop
            ).transformation
        )

    return _open3d(solve_pair, most=1000)


MAKERS: dict[str, Callable[[], Peer]] = {
    "TEASER++": _teaserpp,
    "kiss-matcher": _kiss_matcher,
    "Open3D FGR": _fast_global_registration,
    "Open3D RANSAC-10k": _ransac,
}


def _available() -> dict[str, Peer]:
    peers = {}
    for name, make in MAKERS.items():
        try:
            peers[name] = make()
        except ImportError:  # also where a library of the system is missing
            continue
    return peers


PEERS = _available()


def peers_for(case: Case) -> dict[str, Callable[[Case], Pose]]:
    """The peers of this environment that can be asked about a case."""
    return {name: peer.solve for name, peer in PEERS.items() if peer.suits(case)}
