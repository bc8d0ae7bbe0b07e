"""The problems that benchmarks share: the protocol's cells, wrong matches of every kind, real pairs."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from teaser_jax import Pose, metrics, synthetic

DATA = Path(os.environ.get("TEASER_JAX_DATA", "../shared/data"))
# folder: noise bound [m], largest accepted rotation error [deg] and translation error [m]
REAL = {"kitti_fpfh": (0.6, 5.0, 0.6), "eth_tls": (0.1, 5.0, 0.5), "threedmatch": (0.05, 15.0, 0.3)}


@dataclass(frozen=True)
class Case:
    """One problem, and when an answer to it counts as right. ``truth`` None: no answer is right."""

    cell: str
    src: np.ndarray
    dst: np.ndarray
    noise_bound: float
    scale: float | None
    truth: Pose | None
    inliers: np.ndarray | None = None
    rotation_limit: float = 5.0  # [deg]
    translation_limit: float = float("inf")

    def is_right(self, pose: Pose) -> bool:
        """Whether a pose is an accepted answer."""
        if self.truth is None:
            return False
        return bool(
            np.degrees(metrics.rotation_error(pose, self.truth)) < self.rotation_limit
            and metrics.translation_error(pose, self.truth) < self.translation_limit
            and abs(pose.scale / self.truth.scale - 1) < 0.1
        )


def protocol(n: int, rate: float, trials: int, *, unknown: bool = False) -> Iterator[Case]:
    """One cell of the paper's protocol (section XI)."""
    cell = f"{'unknown' if unknown else 'known'} scale, N = {n}, {round(100 * rate)} % wrong"
    for trial in range(trials):
        seed = (n, round(1000 * rate), int(unknown), trial)
        p = synthetic.random_problem(seed, n=n, outlier_rate=rate, scale=(1.0, 5.0) if unknown else 1.0)
        scale = None if unknown else 1.0
        yield Case(cell, p.src, p.dst, p.noise_bound, scale, p.truth, p.inliers)


def without_correspondences(overlap: float, trials: int) -> Iterator[Case]:
    """All-to-all matches of 60 points (Fig. 7), bound 0.01."""
    for trial in range(trials):
        p = synthetic.all_to_all((60, round(100 * overlap), trial), n=60, overlap=overlap)
        cell = f"all to all, overlap {round(100 * overlap)} %"
        yield Case(cell, p.src, p.dst, p.noise_bound, 1.0, p.truth, p.inliers)


def all_wrong(trials: dict[int, int]) -> Iterator[Case]:
    """No right match at all: sizes, five densities, and three ways of being wrong.

    The density of chance agreements follows from the noise bound against the object of size 1.
    A tenth of the target attracts the wrong matches that are many to one, and six points at least:
    with the three of n = 30, bound 0.4 spans them all, and no match could be wrong.
    """
    for n, count in trials.items():
        for trial in range(count):
            bound = (0.02, 0.05, 0.1, 0.2, 0.4)[trial % 5]
            kind = ("uniform", "one to one", "many to one")[trial // 5 % 3]
            seed = (7, n, trial)
            known = dict(n=n, outlier_rate=1.0, sigma=bound / 5.54, noise_bound=bound)
            if kind == "uniform":
                p = synthetic.random_problem(seed, radius=1.0, **known)
            else:
                hubs = 1.0 if kind == "one to one" else max(0.1, 6 / n)
                p = synthetic.descriptor_problem(seed, hubs=hubs, **known)
            scale = None if n <= 300 and trial // 15 % 2 else 1.0
            cell = f"all wrong, n = {n}, {kind}"
            yield Case(cell, p.src, p.dst, bound, scale, None)


def real_pairs() -> Iterator[Case]:
    """Every real pair at the noise bound of its data set; says so where there is none."""
    if not any((DATA / folder).is_dir() for folder in REAL):
        warnings.warn(f"no real pairs in {DATA}: name their folder in TEASER_JAX_DATA", stacklevel=2)
    for folder, (bound, rotation, translation) in REAL.items():
        for path in sorted((DATA / folder).glob("*.npz")):
            z = np.load(path)
            truth = Pose.from_matrix(z["T_dst_src"])
            yield Case(
                f"real, {folder}/{path.stem}",
                z["src"],
                z["dst"],
                bound,
                1.0,
                truth,
                None,
                rotation,
                translation,
            )


def mismatched_real_pairs() -> Iterator[Case]:
    """Every real source with every other file's target, row by row: nothing there is right."""
    pairs = list(real_pairs())
    for a in pairs:
        for b in pairs:
            if a is not b:
                n = min(len(a.src), len(b.dst))
                yield Case("real, another file's target", a.src[:n], b.dst[:n], a.noise_bound, 1.0, None)
