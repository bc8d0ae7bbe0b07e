"""Other libraries, each through a small adapter, as far as they can be imported."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.problems import Case
from teaser_jax import Pose


def _kiss_matcher() -> Callable[[Case], Pose]:
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

    return solve


def _teaserpp() -> Callable[[Case], Pose]:
    import teaserpp_python as teaserpp

    def solve(case: Case) -> Pose:
        params = teaserpp.RobustRegistrationSolver.Params()
        params.cbar2, params.noise_bound = 1.0, case.noise_bound
        params.estimate_scaling = case.scale is None
        solver = teaserpp.RobustRegistrationSolver(params)  # a used one keeps state
        solver.solve(case.src.T.astype(np.float64), case.dst.T.astype(np.float64))
        found = solver.getSolution()
        return Pose(np.asarray(found.rotation), np.asarray(found.translation), np.asarray(found.scale))

    return solve


def available() -> dict[str, Callable[[Case], Pose]]:
    """The peers of this environment by name."""
    peers = {}
    for name, make in (("kiss-matcher", _kiss_matcher), ("TEASER++", _teaserpp)):
        try:
            peers[name] = make()
        except ImportError:
            continue
    return peers


PEERS = available()
