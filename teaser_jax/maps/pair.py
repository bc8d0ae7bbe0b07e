"""What a map keeps of two clouds: the answer of ``register_clouds``, in numbers that a file can hold."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.clouds.trust.judge import SURELY
from teaser_jax.maps.motions import right_covariance
from teaser_jax.solution import Status

# Of a cell: what points of the overlap are taken to be off by at least. Where surfaces are without noise,
# the residual alone would promise more than cells of that width can hold.
LEAST_DISPLACEMENT = 0.1


@dataclass(frozen=True, eq=False)
class MapPair:
    """An answer to two clouds of a map, i and j.

    Attributes:
        i, j: Which clouds; i is the target and j the source.
        status: What happened.
        doubt: Which question the pose failed, in a word; None: none.
        T: ``T_i_j``, between the frames as given.
        covariance: Of a shift of ``centroid`` and a turn about it, as that of ``CloudRegistration``; infinite
            on the diagonal where the answer is not ok [length, rad].
        centroid: The middle of the overlap, in the frame of cloud i [length].
        displacement: How far points of the overlap are expected to be off [length].
        voxel_size: Width of the cells that the verdict rests on [length].
        overlap: Which part of either cloud lies in the overlap, the smaller one [-].
        seconds: What the work took [s].
    """

    i: int
    j: int
    status: Status
    doubt: str | None
    T: Float[np.ndarray, "4 4"]
    covariance: Float[np.ndarray, "6 6"]
    centroid: Float[np.ndarray, "3"]
    displacement: float
    voxel_size: float
    overlap: float
    seconds: float

    @property
    def ok(self) -> bool:
        """Whether the two clouds alone trust the pose; the map may refuse it all the same."""
        return self.status == Status.OK

    @property
    def information(self) -> Float[np.ndarray, "6 6"]:
        """The inverse covariance of a small motion (w, v) to the right of ``T``, as GTSAM's ``Pose3``.

        Rotation first, in the axes of cloud j: T' = T Exp(w, v) [1 / rad, 1 / length]. Deviations are taken
        three times as large as expected, so large as bent clouds have them. Zero where the pair is not ok.
        """
        if not self.ok:
            return np.zeros((6, 6))
        return np.linalg.inv(widened(self, self.T, self.centroid))


def widened(
    pair: MapPair, T: Float[np.ndarray, "4 4"], centroid: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "6 6"]:
    """Compute the covariance to the right of a pose, as wide as errors surely are.

    Args:
        pair: The answer.
        T: Its pose, maybe between other frames.
        centroid: The middle of the overlap in the target frame of ``T`` [length].
    """
    least = max(1.0, LEAST_DISPLACEMENT * pair.voxel_size / max(pair.displacement, 1e-300))
    return right_covariance(T, (SURELY * least) ** 2 * pair.covariance, centroid)


def pair_of(i: int, j: int, answer: CloudRegistration) -> MapPair:
    """Keep of an answer to two clouds what a map needs."""
    e = answer.evidence
    return MapPair(
        i=i, j=j, status=Status(answer.status), doubt=answer.doubt, T=answer.T_dst_src,
        covariance=answer.covariance, centroid=answer.centroid, displacement=answer.displacement,
        voxel_size=answer.voxel_size, overlap=0.0 if e is None else float(e.overlap),
        seconds=sum(answer.seconds.values()),
    )  # fmt: skip


def as_plain(pair: MapPair) -> dict[str, Any]:
    """Turn a pair into what JSON can hold, without the numbers of the clouds, which may change."""
    return {
        "status": pair.status.name,
        "doubt": pair.doubt,
        "T": pair.T.tolist(),
        "covariance": pair.covariance.tolist() if pair.ok else None,
        "centroid": pair.centroid.tolist() if np.isfinite(pair.centroid).all() else None,
        **{
            name: value if np.isfinite(value := float(getattr(pair, name))) else None
            for name in ("displacement", "voxel_size", "overlap", "seconds")
        },
    }


def from_plain(i: int, j: int, held: dict[str, Any]) -> MapPair:
    """Read a pair back; whatever is missing or odd raises KeyError, TypeError or ValueError."""
    status = Status[held["status"]]
    missing = {"displacement": np.inf, "voxel_size": np.nan}
    numbers = {
        name: float(missing[name] if held[name] is None and name in missing else held[name])
        for name in ("displacement", "voxel_size", "overlap", "seconds")
    }
    wide = np.where(np.eye(6, dtype=bool), np.inf, 0.0)
    covariance = np.array(held["covariance"], np.float64) if status == Status.OK else wide
    centroid = np.full(3, np.nan) if held["centroid"] is None else np.array(held["centroid"], np.float64)
    T = np.array(held["T"], np.float64)
    if T.shape != (4, 4) or covariance.shape != (6, 6) or centroid.shape != (3,):
        raise ValueError("a pose or a covariance has another shape")
    return MapPair(i, j, status, held["doubt"], T, covariance, centroid, **numbers)
