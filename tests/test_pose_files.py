"""Files of poses: what is written is read back, in every format."""

from __future__ import annotations

import json

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.files import FileError, read_poses, write_pose, write_poses

RNG = np.random.default_rng(0)
POSES = [tj.Pose(tj.synthetic.draw_rotation(RNG), RNG.normal(size=3), np.asarray(1.0)) for _ in range(4)]
MATRICES = np.array([pose.matrix for pose in POSES])
SCALED = tj.Pose(POSES[0].rotation, POSES[0].translation, np.asarray(1.7))
SUFFIXES = {"matrix": ".txt", "json": ".json", "kitti": ".txt", "tum": ".tum"}


@pytest.mark.parametrize("format", SUFFIXES)
@pytest.mark.parametrize("count", [1, 4])
def test_what_is_written_is_read_back(tmp_path, format, count):
    path = tmp_path / f"poses{SUFFIXES[format]}"
    write_poses(path, POSES[:count], format=format)
    found = read_poses(str(path))
    assert len(found) == count
    np.testing.assert_allclose([pose.matrix for pose in found.poses], MATRICES[:count], rtol=0, atol=1e-14)
    assert (found.times is not None) == (format == "tum")


@pytest.mark.parametrize("format", ["matrix", "json", "kitti"])
def test_scales_are_kept(tmp_path, format):
    path = tmp_path / f"pose{SUFFIXES[format]}"
    write_pose(path, SCALED, format=format)
    np.testing.assert_allclose(read_poses(path).poses[0].matrix, SCALED.matrix, rtol=0, atol=1e-14)


def test_the_name_tells_json_and_nothing_else(tmp_path):
    for name in ("pose.txt", "pose", "pose.kitti"):
        write_pose(tmp_path / name, SCALED)
        np.testing.assert_array_equal(np.loadtxt(tmp_path / name), SCALED.matrix)
    write_pose(tmp_path / "pose.json", SCALED)
    held = json.loads((tmp_path / "pose.json").read_text())
    np.testing.assert_array_equal(held["T_dst_src"], SCALED.matrix)
    np.testing.assert_array_equal(held["quaternion_xyzw"], SCALED.quat)
    assert held["scale"] == 1.7
    write_poses(tmp_path / "poses.json", POSES)
    assert len(json.loads((tmp_path / "poses.json").read_text())["poses"]) == 4


def test_lines_of_kitti_and_of_tum(tmp_path):
    """As their own tools read them."""
    from scipy.spatial.transform import Rotation

    path = tmp_path / "poses.txt"
    write_poses(path, POSES, format="kitti")
    np.testing.assert_array_equal(np.loadtxt(path).reshape(-1, 3, 4), MATRICES[:, :3])
    write_poses(path, POSES, format="tum", times=[0.5, 1.5, 2.5, 1_700_000_000.123456])
    rows = np.loadtxt(path)
    np.testing.assert_array_equal(rows[:, 1:4], MATRICES[:, :3, 3])
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), MATRICES[:, :3, :3], atol=1e-14)
    np.testing.assert_array_equal(read_poses(path).times, [0.5, 1.5, 2.5, 1_700_000_000.123456])


def test_stacks_of_poses_are_written_as_well(tmp_path):
    path = tmp_path / "poses.txt"
    for stack in (MATRICES, tj.Pose.from_matrix(MATRICES)):
        write_poses(path, stack)
        np.testing.assert_allclose(np.loadtxt(path).reshape(-1, 4, 4), MATRICES, atol=1e-14)


def test_matrices_in_a_line(tmp_path):
    path = tmp_path / "poses.csv"
    np.savetxt(path, MATRICES.reshape(-1, 16), delimiter=",")
    np.testing.assert_allclose([p.matrix for p in read_poses(path).poses], MATRICES, atol=1e-14)


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda path: write_poses(path, [SCALED], format="tum"), "pose 0 has the scale 1.7"),
        (lambda path: write_poses(path, POSES, format="tum", times=[1.0]), "times has shape"),
        (lambda path: write_poses(path, POSES, times=np.arange(4)), "the format 'matrix' has none"),
        (lambda path: write_poses(path, [np.eye(4), np.ones((4, 4))]), "is not"),
        (lambda path: write_pose(path, MATRICES), "give them to write_poses"),
        (lambda path: write_pose(path, SCALED, format="g2o"), "expected 'matrix', 'json', 'kitti' or 'tum'"),
    ],
)
def test_what_cannot_be_written_changes_nothing(tmp_path, unchecked, write, message):
    path = tmp_path / "poses.txt"
    path.write_text("before")
    with pytest.raises(ValueError, match=message):
        write(path)
    assert path.read_text() == "before"


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("p.txt", "", "holds no pose"),
        ("p.txt", "1 2 3\n", "line 1 has 3 columns: expected 4 (matrices), 8 (TUM), 12 (KITTI) or 16"),
        ("p.txt", "1 0 0 0\n0 1 0 0\n0 0 1 0\n", "holds 3 rows of 4 numbers"),
        ("p.txt", "1 0 0 0 0\n", "holds 1 rows of 5 numbers"),
        ("p.txt", "1 1 1 0\n" * 3 + "0 0 0 1\n", "pose 1 is none"),
        ("p.txt", "0 0 0 0 0 0 0 1\n1 0 0 0 1 1 1 1\n", "pose 2 is none: its quaternion has the length 2"),
        ("p.txt", "0 nan 0 0 0 0 0 1\n", "pose 1 is none"),
        ("p.json", "{}", "holds no poses as JSON"),
        ("p.json", "[1, 2", "holds no poses as JSON"),
        ("p.json", '{"T_dst_src": [[1, 2]]}', "pose 1 is none"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_text(content)
    with pytest.raises(FileError) as caught:
        read_poses(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert message in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_no_file(tmp_path):
    for path, message in ((tmp_path, "is a folder"), (tmp_path / "p.txt", "no such file")):
        with pytest.raises(FileError, match=message):
            read_poses(path)
