"""Ours and the peers, each asked about a pair of clouds as its own documentation does, with time by stage.

The peers are given a width of cells, which ours finds by itself. What cannot be imported is left out.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

import teaser_jax as tj
from benchmarks.clouds.cases import CloudPair
from teaser_jax import Pose
from teaser_jax.clouds.candidates import MOST_CELLS
from teaser_jax.clouds.pair import USUAL_CELLS, Pair

OURS, KISS, KISS_CELLS = "teaser_jax", "KISS-Matcher", "KISS-Matcher, our cells"
RANSAC, FGR = "Open3D RANSAC", "Open3D FGR"
SILENT = (RANSAC, FGR)  # they never say whether to trust a pose
FEWEST_INLIERS = 5  # below which the examples of KISS-Matcher say that it might have failed
FINEST, COARSER = 0.01, 0.1  # [m]: KISS-Matcher refuses cells below 5 mm, so smaller clouds are made larger
ITERATIONS, CONFIDENCE = 100_000, 0.999  # of RANSAC: ten times as many were right on the same pairs
ALIKE = 0.9  # least ratio of two lengths that RANSAC takes for equal, as there
Prepared = tuple[Any, Any]


class Answer(NamedTuple):
    """What a method says.

    Attributes:
        pose: ``T_dst_src``; None: it found none, or raised an error.
        ok: Whether it says that the pose is to be trusted; None: it never says.
        status: How it says so, in a word.
        others: Further poses that it takes for equally good.
        voxel: The width of cells [length].
        seconds: What each stage took [s].
        wall, cpu: What all took by the clock, and on all cores together [s].
    """

    pose: Pose | None
    ok: bool | None
    status: str
    others: tuple[Pose, ...]
    voxel: float
    seconds: dict[str, float]
    wall: float
    cpu: float

    def as_row(self) -> dict[str, Any]:
        """What JSON can hold."""
        pose, *others = (None if x is None else _parts(x) for x in (self.pose, *self.others))
        return {**self._asdict(), "pose": pose, "others": others}

    @classmethod
    def of_row(cls, row: dict[str, Any]) -> Answer:
        """The answer again."""
        pose, *others = (x and Pose(*(np.array(y) for y in x)) for x in (row["pose"], *row["others"]))
        return cls(**{**row, "pose": pose, "others": tuple(others)})


def _parts(pose: Pose) -> list[Any]:
    return [np.asarray(x, np.float64).tolist() for x in (pose.rotation, pose.translation, pose.scale)]


class Clock:
    """What a block takes, by the clock and on all cores together [s]."""

    wall = cpu = np.nan

    def __enter__(self) -> Clock:
        self.start = time.perf_counter(), time.process_time()
        return self

    def __exit__(self, *error: object) -> None:
        self.wall, self.cpu = time.perf_counter() - self.start[0], time.process_time() - self.start[1]


Method = Callable[[CloudPair], Answer]
Told = Callable[[str], None]  # that a stage begins


def ours(pair: CloudPair, tell: Told | bool = False) -> Answer:
    """Ask ours: no parameter."""
    with Clock() as clock:
        found = tj.register_clouds(pair.src, pair.dst, progress=tell)
    status, seconds = found.status.name, dict(found.seconds)
    return Answer(
        found.pose, found.ok, status, found.equivalent, found.voxel_size, seconds, clock.wall, clock.cpu
    )


def our_cells(pair: CloudPair) -> float:
    """Find the width of cells that ours takes first [length]."""
    src, dst = (tj.prepare(x) for x in (pair.src, pair.dst))
    return Pair(src, dst).width(USUAL_CELLS, MOST_CELLS)


def kiss_matcher(pair: CloudPair, voxel: Callable[[CloudPair], float]) -> Answer:
    """Ask KISS-Matcher; it is trusted where it says so and has as many inliers as its examples want."""
    import kiss_matcher

    width = voxel(pair)
    larger = COARSER / width if width < FINEST else 1.0
    clouds = [list(np.float32(larger * x)) for x in _finite(pair)]  # it reads lists faster than arrays
    matcher = kiss_matcher.KISSMatcher(kiss_matcher.KISSMatcherConfig(larger * width))
    with Clock() as clock:
        found = matcher.estimate(*clouds)
    pose = Pose(np.array(found.rotation), np.ravel(found.translation) / larger, np.float64(1))
    inliers = matcher.get_num_final_inliers()
    seconds = {
        "cells": matcher.get_processing_time(), "descriptors": matcher.get_extraction_time(),
        "matching": matcher.get_matching_time() + matcher.get_rejection_time(),
        "solving": matcher.get_solver_time(),
    }  # fmt: skip
    ok = bool(found.valid) and inliers >= FEWEST_INLIERS
    status = "valid" if found.valid else "not valid"
    return Answer(pose, ok, status, (), width, seconds, clock.wall, clock.cpu)


def open3d_ransac(pair: CloudPair) -> Answer:
    """Ask Open3D for RANSAC on FPFH, then ICP, as in its tutorial."""
    from open3d.pipelines import registration as r

    def found(src: Prepared, dst: Prepared) -> Any:
        far = 1.5 * pair.voxel
        return r.registration_ransac_based_on_feature_matching(
            src[0], dst[0], src[1], dst[1], True, far, r.TransformationEstimationPointToPoint(False), 3,
            [
                r.CorrespondenceCheckerBasedOnEdgeLength(ALIKE),
                r.CorrespondenceCheckerBasedOnDistance(far),
            ],
            r.RANSACConvergenceCriteria(ITERATIONS, CONFIDENCE),
        )  # fmt: skip

    return _open3d(pair, found)


def open3d_fgr(pair: CloudPair) -> Answer:
    """Ask Open3D for Fast Global Registration on FPFH, then ICP, as in its tutorial."""
    from open3d.pipelines import registration as r

    option = r.FastGlobalRegistrationOption(maximum_correspondence_distance=0.5 * pair.voxel)
    return _open3d(
        pair,
        lambda src, dst: r.registration_fgr_based_on_feature_matching(src[0], dst[0], src[1], dst[1], option),
    )


def _open3d(pair: CloudPair, solve: Callable[[Prepared, Prepared], Any]) -> Answer:
    import open3d
    from open3d.pipelines import registration as r

    open3d.utility.random.seed(0)
    given = [open3d.geometry.PointCloud(open3d.utility.Vector3dVector(x)) for x in _finite(pair)]
    plane = r.TransformationEstimationPointToPlane()
    with Clock() as clock:
        with Clock() as cells:
            clouds = [cloud.voxel_down_sample(pair.voxel) for cloud in given]
        with Clock() as descriptors:
            described = [_described(cloud, pair) for cloud in clouds]
        with Clock() as solving:
            rough = solve(*described)
        with Clock() as refining:
            fine = r.registration_icp(*clouds, 0.4 * pair.voxel, rough.transformation, plane)
    stages = {"cells": cells, "descriptors": descriptors, "solving": solving, "refining": refining}
    seconds = {name: stage.wall for name, stage in stages.items()}
    pose = Pose.from_matrix(np.array(fine.transformation))
    return Answer(pose, None, "", (), pair.voxel, seconds, clock.wall, clock.cpu)


def _described(cloud: Any, pair: CloudPair) -> Prepared:
    """Find normals, towards the sensor where it is known, and FPFH."""
    from open3d.geometry import KDTreeSearchParamHybrid as Near
    from open3d.pipelines import registration as r

    cloud.estimate_normals(Near(2 * pair.voxel, 30))
    if pair.seen_from_origin:
        cloud.orient_normals_towards_camera_location(np.zeros(3))
    return cloud, r.compute_fpfh_feature(cloud, Near(5 * pair.voxel, 100))


def _finite(pair: CloudPair) -> list[np.ndarray]:
    return [x[np.isfinite(x).all(axis=1)] for x in (pair.src, pair.dst)]


def _kiss() -> dict[str, Method]:
    import kiss_matcher as _  # noqa: F401

    return {
        KISS: partial(kiss_matcher, voxel=lambda pair: pair.voxel),
        KISS_CELLS: partial(kiss_matcher, voxel=our_cells),
    }


def _of_open3d() -> dict[str, Method]:
    import open3d  # noqa: F401

    return {RANSAC: open3d_ransac, FGR: open3d_fgr}


def find_methods() -> tuple[dict[str, Method], dict[str, str]]:
    """Find ours and the peers that can be imported, and why others cannot."""
    methods: dict[str, Method] = {OURS: ours}
    missing: dict[str, str] = {}
    for package, make in (("kiss-matcher", _kiss), ("open3d", _of_open3d)):
        try:
            methods |= make()
        except ImportError as error:  # also where a library of the system is missing
            missing[package] = str(error)
    return methods, missing


def asked(method: Method, pair: CloudPair) -> Answer:
    """Ask, and take an error for no answer."""
    try:
        return method(pair)
    except (RuntimeError, ValueError) as error:
        return Answer(None, False, type(error).__name__, (), np.nan, {}, np.nan, np.nan)
