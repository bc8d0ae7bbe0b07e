"""Poses to files and from them: matrices in text, JSON, and the lines of KITTI and of TUM."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np
from jaxtyping import Float

from teaser_jax import so3
from teaser_jax.files.tables import Layout, read_table
from teaser_jax.ground.checks import shown
from teaser_jax.ground.io import FileError, or_file_error, os_errors_named, replacing
from teaser_jax.pose import Pose, as_pose

Format: TypeAlias = Literal["matrix", "json", "kitti", "tum"]

ROWS = Layout("pose", "4, 8, 12 or 16 numbers", "4 (matrices), 8 (TUM), 12 (KITTI) or 16", 4, 16)
SAME_SCALE = 1e-6  # what TUM may lose


@dataclass(frozen=True, eq=False)
class PoseFile:
    """A ``PoseFile`` holds the poses of a file.

    Attributes:
        poses: One after the other, as they stand in the file.
        times: (n,) the time of each, of TUM [s]; None: the file has none.
    """

    poses: list[Pose]
    times: Float[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.poses)


def write_pose(path: str | PathLike[str], pose: Pose | Any, *, format: Format | None = None) -> None:
    """Write ``T_dst_src``, which is read back exactly; by default as four lines of four numbers.

    The file appears whole or not at all.

    Args:
        path: Where to.
        pose: A ``Pose``, an answer that has one, or a matrix.
        format: As in ``write_poses``; None: "json" if the name ends in .json, "matrix" otherwise.

    Raises:
        OSError: If it cannot be written.
        ValueError: If it is no pose; then no file changes.
    """
    _write(path, [as_pose(pose)], format)


def write_poses(
    path: str | PathLike[str],
    poses: Pose | Iterable[Pose | Any],
    *,
    format: Format | None = None,
    times: Any = None,
    names: Sequence[str] | None = None,
) -> None:
    """Write several poses, one after the other. The file appears whole or not at all.

    Args:
        path: Where to.
        poses: Each a ``Pose``, an answer that has one, or a matrix; or one ``Pose`` with a leading axis.
        format: "matrix": four lines of four numbers for each, which ``numpy.loadtxt`` reads back exactly;
            "json": a list under "poses", each with its matrix, rotation, translation and scale; "kitti": the
            twelve numbers of [s R, t] in a line; "tum": time tx ty tz qx qy qz qw in a line, without a scale.
            None: "json" if the name ends in .json, "matrix" otherwise.
        times: (n,) for TUM [s]; None: 0, 1, 2 and so on.
        names: What each is called, for JSON; None: nothing.

    Raises:
        OSError: If it cannot be written.
        ValueError: If one is no pose, or has a scale and the format has none; then no file changes.
    """
    each = as_pose(poses).matrix if isinstance(poses, Pose) else poses
    _write(path, [as_pose(pose) for pose in each], format, times, names)


def _write(
    path: str | PathLike[str],
    poses: list[Pose],
    format: str | None,
    times: Any = None,
    names: Sequence[str] | None = None,
) -> None:
    path = Path(path)
    format = format or ("json" if path.suffix.lower() == ".json" else "matrix")
    if format not in ("matrix", "json", "kitti", "tum"):
        raise ValueError(f"format is {shown(format)}: expected 'matrix', 'json', 'kitti' or 'tum'.")
    if times is not None and format != "tum":
        raise ValueError(f"times are given, and the format '{format}' has none: 'tum' has.")
    if any(np.ndim(pose.matrix) != 2 for pose in poses):
        raise ValueError("received a batch of poses for one: give them to write_poses.")
    if names is not None and (format != "json" or len(names) != len(poses)):
        raise ValueError(
            f"{len(names)} names are given: 'json' has them, one for each of {len(poses)} pose(s)."
        )
    if format == "json":
        listed = [_described(pose) for pose in poses]
        if names is not None:
            listed = [{"name": name, **one} for name, one in zip(names, listed, strict=True)]
        text = json.dumps(listed[0] if len(listed) == 1 else {"poses": listed}, indent=1) + "\n"
        with replacing(path) as partial:
            partial.write_text(text)
        return
    matrices = np.array([pose.matrix for pose in poses], np.float64).reshape(-1, 4, 4)
    if format == "kitti":
        rows = matrices[:, :3].reshape(-1, 12)
    elif format == "tum":
        rows = _rows_of_tum(poses, times)
    else:
        rows = matrices.reshape(-1, 4)
    with replacing(path) as partial:
        np.savetxt(partial, rows, fmt="%.17g")


def _described(pose: Pose) -> dict[str, Any]:
    return {
        "T_dst_src": np.asarray(pose.matrix, np.float64).tolist(),
        "quaternion_xyzw": np.asarray(pose.quat, np.float64).tolist(),
        "translation": np.asarray(pose.translation, np.float64).tolist(),
        "scale": float(pose.scale),
    }


def _rows_of_tum(poses: list[Pose], times: Any) -> Float[np.ndarray, "n 8"]:
    at = np.arange(len(poses), dtype=np.float64) if times is None else np.asarray(times, np.float64)
    if at.shape != (len(poses),):
        raise ValueError(f"times has shape {at.shape}: expected one for each of {len(poses)} pose(s).")
    for k, pose in enumerate(poses):
        if abs(float(pose.scale) - 1) > SAME_SCALE:
            raise ValueError(f"pose {k} has the scale {float(pose.scale):g}, which TUM cannot hold.")
    rows = [np.hstack([t, pose.translation, pose.quat]) for t, pose in zip(at, poses, strict=True)]
    return np.array(rows, np.float64).reshape(-1, 8)


def read_poses(path: str | PathLike[str]) -> PoseFile:
    """Read poses: JSON as ``write_poses`` writes it, or text, whose columns tell what they are.

    Four columns are matrices, four lines each; eight are TUM's, twelve KITTI's, and sixteen are matrices in
    a line.

    Raises:
        FileError: If there is no such file, or it is broken, or holds something else.
    """
    path = Path(path)
    with os_errors_named(path, "cannot be read"):
        if path.is_dir():
            raise FileError(f"{path}: is a folder: name a file of poses in it.")
        if not path.exists():
            raise FileError(f"{path}: no such file: check the name.")
        if path.suffix.lower() == ".json":
            return or_file_error(path, "holds no poses as JSON", lambda: _from_json(path))
        rows = read_table(path, ROWS).rows
    width = rows.shape[1]
    if width == 8:
        return PoseFile([_of_tum(path, row, k) for k, row in enumerate(rows, 1)], rows[:, 0])
    shapes = {4: (-1, 4, 4), 12: (-1, 3, 4), 16: (-1, 4, 4)}
    if width not in shapes or (width == 4 and len(rows) % 4):
        raise FileError(f"{path}: holds {len(rows)} rows of {width} numbers: expected {ROWS.columns} a row.")
    return PoseFile([_pose(path, matrix, k) for k, matrix in enumerate(rows.reshape(shapes[width]), 1)])


def _pose(path: Path, matrix: Any, k: int) -> Pose:
    return or_file_error(path, f"pose {k} is none", lambda: as_pose(matrix))


def _of_tum(path: Path, row: Float[np.ndarray, "8"], k: int) -> Pose:
    length = np.linalg.norm(row[4:])
    if not abs(length - 1) < 1e-3 or not np.isfinite(row).all():
        raise FileError(f"{path}: pose {k} is none: its quaternion has the length {length:g}, and not 1.")
    rotation = np.asarray(so3.rotation_from_quat(row[4:] / length))
    return Pose(rotation, row[1:4], np.asarray(1.0))


def _from_json(path: Path) -> PoseFile:
    held = json.loads(path.read_text(encoding="utf-8"))
    listed = held.get("poses", [held])
    return PoseFile(
        [_pose(path, np.array(one["T_dst_src"], np.float64), k) for k, one in enumerate(listed, 1)]
    )
