"""Lists of pairs with known poses: those of 3DMatch and 3DLoMatch, and those of the LiDAR benchmarks.

3DMatch keeps for each scene the fragments ``cloud_bin_K.ply``, and beside them ``gt.log``: for each pair a
line ``i j n`` and four lines of T, which lays fragment j on fragment i; and ``gt.info``: the same line and
six of the information of the overlap. LiDAR lists are tables with a line of names: the sequence, the scan i,
in some the sequence of the other scan, the scan j, then 16 numbers of T, which lays scan i on scan j; columns
that follow are ignored. They name scans of KITTI, KITTI-360 and Apollo-SouthBay.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from teaser_jax.files import FileError
from teaser_jax.ground.io import or_file_error, os_errors_named, visible
from teaser_jax.pose import Pose

SEQUENCE, FIRST, OTHER_SEQUENCE, SECOND = ("seq", "session_ind"), ("i",), ("seq_db",), ("j",)
APOLLO = {
    20: "HighWay237/2018-10-12",
    21: "SunnyvaleBigloop/2018-10-03",
    22: "MathildaAVE/2018-10-12",
    23: "SanJoseDowntown/2018-10-11/2",
    24: "SanJoseDowntown/2018-10-11/1",
    25: "BaylandsToSeafood/2018-10-12",
    26: "ColumbiaPark/2018-10-11",
}


class ListedPair(NamedTuple):
    """A pair of files, and the pose between them.

    Attributes:
        scene: The line of the table that it counts for.
        name: Which pair of the scene it is.
        src, dst: The files.
        truth: ``T_dst_src``.
        information: (6, 6) of the overlap, of a shift and the vector of a quaternion; None: not known.
        is_next: Whether the two follow one another, so that 3DMatch's own count leaves them out.
    """

    scene: str
    name: str
    src: Path
    dst: Path
    truth: Pose
    information: np.ndarray | None = None
    is_next: bool = False


def threedmatch(folder: Path, lists: Path | None = None) -> list[ListedPair]:
    """Find the pairs of 3DMatch or 3DLoMatch.

    Args:
        folder: Where the folders of the scenes are, or folders that hold these.
        lists: Where ``SCENE-evaluation/gt.log`` or ``SCENE/gt.log`` are; None: in the folder, too.

    Raises:
        FileError: If there is no list, one is broken, or a fragment is missing.
    """
    place = lists or folder
    logs = sorted(_existing(place).rglob("gt.log"))
    if not logs:
        raise FileError(f"{place}: holds no gt.log: name the folder of the scenes' lists.")
    found: list[ListedPair] = []
    seen: dict[str, Path] = {}
    for log in logs:
        scene = log.parent.name.removesuffix("-evaluation")
        if scene in seen:
            raise FileError(f"{log}: a second list of {scene}, after {seen[scene]}: name one set as lists.")
        seen[scene] = log
        found += _scene(scene, log, _clouds_of(scene, _existing(folder)))
    return found


def _scene(scene: str, log: Path, clouds: Path) -> Iterator[ListedPair]:
    path = log.with_name("gt.info")
    information = dict(_blocks(path, 6)) if path.exists() else {}
    for key, matrix in _blocks(log, 4):
        i, j, _ = key
        dst, src = (_file(clouds / f"cloud_bin_{k}.ply", log) for k in (i, j))
        truth = _pose(log, matrix, f"pair {i} {j}")
        yield ListedPair(scene, f"{i} {j}", src, dst, truth, information.get(key), j == i + 1)


def _blocks(path: Path, size: int) -> Iterator[tuple[tuple[int, int, int], np.ndarray]]:
    """Read three whole numbers and a matrix, again and again."""
    lines = [(k, line.split()) for k, line in enumerate(_lines(path), 1) if line.strip()]
    if not lines:
        raise FileError(f"{path}: holds no pair.")
    for start in range(0, len(lines), size + 1):
        block = lines[start : start + size + 1]
        if len(block) <= size:
            raise FileError(f"{path}: line {block[0][0]}: the last pair is cut off.")
        (at, head), rows = block[0], block[1:]
        if len(head) != 3 or not all(word.isdecimal() for word in head):
            raise FileError(f"{path}: line {at}: expected the numbers i j n, found '{_shown(head)}'.")
        for at, words in rows:
            if len(words) != size:
                raise FileError(f"{path}: line {at}: expected {size} numbers, found '{_shown(words)}'.")
        i, j, n = (int(word) for word in head)
        yield (i, j, n), np.array([_numbers(path, at, words) for at, words in rows])


def _clouds_of(scene: str, folder: Path) -> Path:
    """Find the folder of the fragments of a scene."""
    found = [x for x in sorted(folder.rglob(scene)) if x.is_dir() and any(x.glob("cloud_bin_*.ply"))]
    if len(found) != 1:
        several = f"{len(found)} folders {scene} hold" if found else f"no folder {scene} holds"
        raise FileError(f"{folder}: {several} fragments cloud_bin_K.ply: name the folder of one set.")
    return found[0]


def lidar(folder: Path, lists: list[Path]) -> list[ListedPair]:
    """Find the pairs of lists of LiDAR scans.

    Args:
        folder: Of KITTI (with ``sequences``), of KITTI-360 (``data_3d_raw``, whose scans are taken as they
            were recorded, bent by the motion), or of Apollo-SouthBay (``TestData``).
        lists: The tables; the scenes are called by their names and the sequence.

    Raises:
        FileError: If the folder is none of these, a list is broken, or a scan is missing.
    """
    if not lists:
        raise FileError(f"{folder}: name the lists of pairs of its scans.")
    where = _layout(_existing(folder))
    return [pair for path in lists for pair in _table(path, where)]


def _table(path: Path, where: Callable[[int, int, Path], Path]) -> Iterator[ListedPair]:
    lines = [(k, line.split()) for k, line in enumerate(_lines(path), 1) if line.strip()]
    if not lines:
        raise FileError(f"{path}: is empty.")
    names = [word.lower() for word in lines[0][1]]
    columns = [_column(names, wanted) for wanted in (SEQUENCE, FIRST, OTHER_SEQUENCE, SECOND)]
    sequence, first, other, second = columns
    if sequence is None or first is None or second is None:
        raise FileError(
            f"{path}: line 1: names no columns seq (or session_ind), i and j: it is no such list."
        )
    if len(lines) == 1:
        raise FileError(f"{path}: holds no pair.")
    start = max(k for k in columns if k is not None) + 1
    for at, words in lines[1:]:
        if len(words) < start + 16:
            raise FileError(
                f"{path}: line {at}: expected {start} indices and 16 numbers, found {len(words)}."
            )
        if not all(word.isdecimal() for word in words[:start]):
            raise FileError(f"{path}: line {at}: expected {start} indices, found '{_shown(words[:start])}'.")
        numbers = [int(word) for word in words[:start]]
        a, b = numbers[sequence], numbers[sequence if other is None else other]
        i, j = numbers[first], numbers[second]
        matrix = np.reshape(_numbers(path, at, words[start : start + 16]), (4, 4))
        truth = _pose(path, matrix, f"line {at}")
        yield ListedPair(
            f"{path.stem} {a:02d}", f"{a}:{i} {b}:{j}", where(a, i, path), where(b, j, path), truth
        )


def _column(names: list[str], wanted: tuple[str, ...]) -> int | None:
    return next((names.index(name) for name in wanted if name in names), None)


def _layout(folder: Path) -> Callable[[int, int, Path], Path]:
    """Tell where a folder has the scan of a sequence."""
    if (folder / "sequences").is_dir():
        find = lambda seq, k: folder / f"sequences/{seq:02d}/velodyne/{k:06d}.bin"
    elif (folder / "data_3d_raw").is_dir():
        drive = "data_3d_raw/2013_05_28_drive_{:04d}_sync/velodyne_points/data/{:010d}.bin"
        find = lambda seq, k: folder / drive.format(seq, k)
    elif (folder / "TestData").is_dir():
        find = lambda seq, k: folder / "TestData" / APOLLO.get(seq, f"session {seq}") / f"pcds/{k}.pcd"
    else:
        raise FileError(f"{folder}: holds no sequences, data_3d_raw or TestData: name the folder above them.")
    return lambda seq, k, path: _file(find(seq, k), path)


def _file(path: Path, listed_in: Path) -> Path:
    if not path.is_file():
        raise FileError(f"{listed_in}: lists {path}, and there is no such file.")
    return path


def _existing(folder: Path) -> Path:
    if not folder.is_dir():
        raise FileError(f"{folder}: no such folder: check the name.")
    return folder


def _lines(path: Path) -> list[str]:
    with os_errors_named(path, "cannot be read"):
        return or_file_error(path, "is no text", lambda: path.read_text().splitlines())


def _numbers(path: Path, at: int, words: list[str]) -> list[float]:
    return or_file_error(path, f"line {at} holds something else than numbers", lambda: [*map(float, words)])


def _pose(path: Path, matrix: np.ndarray, which: str) -> Pose:
    pose = or_file_error(path, f"{which}: is no pose", lambda: Pose.from_matrix(matrix))
    if abs(float(pose.scale) - 1) > 1e-3:
        raise FileError(f"{path}: {which}: has scale {float(pose.scale):g}: expected a rotation.")
    return pose


def _shown(words: list[str]) -> str:
    return visible(" ".join(words))
