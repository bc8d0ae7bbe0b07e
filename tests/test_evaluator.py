"""The evaluator of public sets, on small folders of their formats with known answers."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import teaser_jax as tj
from benchmarks.clouds import __main__ as command
from benchmarks.clouds import evaluate
from benchmarks.clouds.lists import ListedPair, lidar, threedmatch
from benchmarks.clouds.methods import Answer
from teaser_jax.files import FileError, write_cloud

T_01 = tj.Pose(Rotation.from_euler("z", 30, degrees=True).as_matrix(), np.array([1.0, 2, 3]), 1.0)
T_02 = tj.Pose(Rotation.from_euler("x", -40, degrees=True).as_matrix(), np.array([0.0, -1, 0]), 1.0)
CLOUD = np.random.default_rng(0).uniform(-1, 1, (400, 3))


def rows_of(matrix, digits: int = 8) -> str:
    return "\n".join("\t".join(f"{x:.{digits}e}" for x in row) for row in np.asarray(matrix))


def log_of(pairs: dict[tuple[int, int], np.ndarray]) -> str:
    return "\n".join(f"{i}\t{j}\t3\n{rows_of(matrix)}" for (i, j), matrix in pairs.items()) + "\n"


def information(points: np.ndarray) -> np.ndarray:
    """Of a shift and the vector of a quaternion: twice its cross product is the motion of a point."""
    rows = [np.hstack([np.eye(3), -2 * np.cross(np.eye(3), x).T]) for x in points]
    return sum(row.T @ row for row in rows)


@pytest.fixture
def indoors(tmp_path: Path) -> Path:
    """Two scenes as 3DMatch lays them: fragments, and lists beside."""
    for scene in ("kitchen", "hotel"):
        for k in range(3):
            folder = tmp_path / "fragments" / scene
            folder.mkdir(parents=True, exist_ok=True)
            write_cloud(folder / f"cloud_bin_{k}.ply", CLOUD)
        beside = tmp_path / "fragments" / f"{scene}-evaluation"
        beside.mkdir()
        pairs = {(0, 1): T_01.matrix, (0, 2): T_02.matrix}
        (beside / "gt.log").write_text(log_of(pairs))
        (beside / "gt.info").write_text(log_of({key: information(CLOUD) for key in pairs}))
    return tmp_path


@pytest.fixture
def outdoors(tmp_path: Path) -> Path:
    """Three scans of KITTI, and a list with the columns of each of the two benchmarks."""
    scans = tmp_path / "sequences" / "08" / "velodyne"
    scans.mkdir(parents=True)
    for k in (0, 7, 12):
        np.hstack([CLOUD, np.ones((400, 1))]).astype("<f4").tofile(scans / f"{k:06d}.bin")
    flat = " ".join(f"{x:.6f}" for x in np.ravel(T_01.matrix))
    names = " ".join(f"mot{k}" for k in range(1, 16))  # one name too few, as published
    (tmp_path / "test_0_10.txt").write_text(f"seq i seq_db j {names}\n8 0 8 7 {flat}\n8 0 8 12 {flat} 0.75\n")
    (tmp_path / "test.txt").write_text(f"session_ind i j mot0 mot1\n8 7 12 {flat} 0.1 0.2 0.3\n")
    return tmp_path


def truth(pair) -> Answer:
    return Answer(pair.truths[0], True, "OK", (), 0.1, {}, 1.0, 2.0)


def off_by(degrees: float, shift: float):
    """A method that errs by so much about the z of the source and along it."""
    turn = tj.Pose(Rotation.from_euler("z", degrees, degrees=True).as_matrix(), np.array([0, 0, shift]), 1.0)
    return lambda pair: Answer(pair.truths[0] @ turn, False, "?", (), 0.1, {}, 1.0, 2.0)


def fails(pair) -> Answer:
    raise RuntimeError("no keypoints")


def test_the_pairs_of_3dmatch_lay_the_second_fragment_on_the_first(indoors):
    found = threedmatch(indoors)
    assert [(x.scene, x.name, x.is_next) for x in found] == [
        ("hotel", "0 1", True), ("hotel", "0 2", False), ("kitchen", "0 1", True), ("kitchen", "0 2", False),
    ]  # fmt: skip
    assert [found[0].dst.name, found[0].src.name] == ["cloud_bin_0.ply", "cloud_bin_1.ply"]
    np.testing.assert_allclose(found[0].truth.matrix, T_01.matrix, atol=1e-7)
    np.testing.assert_allclose(found[1].information, information(CLOUD), rtol=1e-7)


def test_the_lists_of_lidar_scans_lay_the_first_scan_on_the_second(outdoors):
    found = lidar(outdoors, [outdoors / "test_0_10.txt", outdoors / "test.txt"])
    assert [(x.scene, x.src.name, x.dst.name) for x in found] == [
        ("test_0_10 08", "000000.bin", "000007.bin"),
        ("test_0_10 08", "000000.bin", "000012.bin"),
        ("test 08", "000007.bin", "000012.bin"),
    ]
    for one in found:
        np.testing.assert_allclose(one.truth.matrix, T_01.matrix, atol=1e-5)


@pytest.mark.parametrize(
    ("turn", "name"),
    [("data_3d_raw/2013_05_28_drive_0009_sync/velodyne_points/data/0000000003.bin", "9 3"),
     ("TestData/ColumbiaPark/2018-10-11/pcds/3.pcd", "26 3")],
)  # fmt: skip
def test_other_sets_of_scans_are_found_where_they_keep_them(tmp_path, turn, name):
    path = tmp_path / turn
    path.parent.mkdir(parents=True)
    path.write_bytes(b"scan")
    seq, k = name.split()
    flat = " ".join(str(x) for x in np.eye(4).ravel())
    (tmp_path / "list.txt").write_text(f"seq i seq_db j\n{seq} {k} {seq} {k} {flat}\n")
    assert lidar(tmp_path, [tmp_path / "list.txt"])[0].src == path


def test_the_fit_is_the_root_mean_square_of_the_overlap():
    one = ListedPair("", "", Path(), Path(), T_01, information(CLOUD))
    for turn, shift in ((1.0, 0.0), (0.0, 0.15), (-2.0, 0.1)):
        pose = off_by(turn, shift)(type("Pair", (), {"truths": (T_01,)})).pose
        moved = np.linalg.norm(pose.apply(CLOUD) - T_01.apply(CLOUD), axis=1)
        assert evaluate.fit_error(pose, one) == pytest.approx(np.sqrt(np.mean(moved**2)), rel=1e-3)


def test_recall_by_scene_at_each_criterion(indoors, tmp_path):
    methods = {"right": truth, "12 deg": off_by(12, 0.0), "0.4 m": off_by(0, 0.4), "fails": fails}
    rows = evaluate.evaluate(threedmatch(indoors), evaluate.KINDS["3dmatch"], methods, tmp_path / "out")
    table = {(row["method"], row["scene"]): row for row in rows}
    assert set(table) == {(name, scene) for name in methods for scene in ("hotel", "kitchen", "all")}
    for name, known in {
        "right": (1, 1, 1),
        "12 deg": (1, 0, 1),
        "0.4 m": (0, 0, 0),
        "fails": (0, 0, 0),
    }.items():
        row = table[name, "all"]
        got = (row["recall 15 deg 0.3 m"], row["recall 10 deg 0.3 m"], row["recall 0.2 m rms"])
        assert got == known, name
    assert (table["right", "hotel"]["pairs"], table["right", "hotel"]["not neighbours"]) == (2, 1)
    assert table["right", "all"]["ok"] == 4
    assert table["12 deg", "all"]["rotation [deg]"] == pytest.approx(12, abs=1e-3)
    assert table["right", "all"]["cpu [s]"] == 2.0
    with (tmp_path / "out" / "table.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)


def test_a_run_that_was_killed_goes_on_where_it_was(indoors, tmp_path):
    calls = []

    def counted(pair) -> Answer:
        calls.append(pair.name)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return truth(pair)

    listed, kind = threedmatch(indoors), evaluate.KINDS["3dmatch"]
    with pytest.raises(KeyboardInterrupt):
        evaluate.evaluate(listed, kind, {"ours": counted}, tmp_path / "out")
    kept = tmp_path / "out" / "answers.jsonl"
    kept.write_text(kept.read_text() + '["kitchen", "0 1", "ours", {"T_d')  # as a kill leaves it
    rows = evaluate.evaluate(listed, kind, {"ours": counted}, tmp_path / "out")
    assert calls == ["0 1", "0 2", "0 1", "0 1", "0 2"]
    assert rows[-1]["recall 15 deg 0.3 m"] == 1
    assert len(kept.read_text().splitlines()) == 5
    with pytest.raises(FileError, match=r"answers other pairs.*name another folder"):
        evaluate.evaluate(listed[:1], kind, {"ours": counted}, tmp_path / "out")


def test_one_command_writes_the_table(outdoors, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(command, "find_methods", lambda: ({"ours": truth}, {"open3d": "not here"}))
    out = tmp_path / "out"
    lists = [str(outdoors / "test_0_10.txt"), str(outdoors / "test.txt")]
    arguments = ["evaluate", "--format", "lidar", str(outdoors), "-o", str(out), "--lists", *lists]
    assert command.main([*arguments, "--most", "1"]) == 0
    said = capsys.readouterr()
    assert "left out: open3d (not here)" in said.err
    assert "recall 5 deg 0.6 m" in said.out
    with (out / "table.csv").open() as file:
        table = list(csv.DictReader(file))
    assert [(row["scene"], row["pairs"]) for row in table] == [
        ("test_0_10 08", "1"),
        ("test 08", "1"),
        ("all", "2"),
    ]
    assert len(json.loads((out / "answers.jsonl").read_text().splitlines()[1])) == 4


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "holds no pair"),
        ("0 1\n", "line 1: the last pair is cut off"),
        ("0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "line 1: expected the numbers i j n, found '0 1'"),
        ("0 1 3\n1 0 0 0\n0 1 0 0\n0 0 1\n0 0 0 1\n", "line 4: expected 4 numbers, found '0 0 1'"),
        ("0 1 3\n1 0 0 0\n0 1 0 x\n0 0 1 0\n0 0 0 1\n", "line 3 holds something else than numbers"),
        ("0 1 3\n1 0 0 0\n0 1 0 0\n0 0 1 0\n", "line 1: the last pair is cut off"),
        ("0 1 3\n1 0 0 0\n0 1 0 0\n0 0 -1 0\n0 0 0 1\n", "pair 0 1: is no pose"),
        ("0 1 3\n1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "pair 0 1: is no pose"),
        ("0 1 3\n2 0 0 0\n0 2 0 0\n0 0 2 0\n0 0 0 1\n", "pair 0 1: has scale 2"),
        ("0 9 3\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "cloud_bin_9.ply, and there is no such file"),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_log_is_said_in_one_line(indoors, capsys, text, words):
    (indoors / "fragments" / "hotel-evaluation" / "gt.log").write_text(text)
    assert command.main(["evaluate", "--format", "3dmatch", str(indoors), "-o", str(indoors / "out")]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("left out")]
    assert len(said) == 1
    assert words in said[0]
    assert not (indoors / "out").exists()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("8 0 8 7 1 0 0 0\n", "line 1: names no columns seq (or session_ind), i and j"),
        ("seq i j\n\n", "holds no pair"),
        ("seq i j\n8 0 7 1 0 0 0\n", "line 2: expected 3 indices and 16 numbers, found 7"),
        ("seq i j\n8 0 x " + "1 " * 16, "line 2: expected 3 indices, found '8 0 x'"),
        ("seq i j\n8 0 7 " + "1 " * 16, "line 2: is no pose"),
        ("seq i j\n8 0 9 " + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1", "000009.bin, and there is no such file"),
        ("\x00\xff", "is no text"),
    ],
)
def test_what_is_wrong_with_a_list_is_said_in_one_line(outdoors, text, words):
    path = outdoors / "broken.txt"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(FileError) as raised:
        lidar(outdoors, [path])
    assert words in str(raised.value)
    assert str(raised.value).startswith(str(path))
    assert "\n" not in str(raised.value)


def test_folders_that_are_none_are_told(tmp_path, indoors):
    for find, words in (
        (lambda: threedmatch(tmp_path / "none"), "no such folder"),
        (lambda: threedmatch(indoors / "fragments" / "hotel"), "holds no gt.log"),
        (
            lambda: threedmatch(indoors / "fragments" / "kitchen-evaluation"),
            "no folder kitchen holds fragments",
        ),
        (lambda: lidar(indoors, [tmp_path / "x"]), "holds no sequences, data_3d_raw or TestData"),
        (lambda: lidar(indoors, []), "name the lists"),
    ):
        with pytest.raises(FileError, match=words):
            find()
    again = indoors / "lists" / "hotel"
    again.mkdir(parents=True)
    (again / "gt.log").write_text(log_of({(0, 1): T_01.matrix}))
    with pytest.raises(FileError, match="a second list of hotel"):
        threedmatch(indoors)
    assert len(threedmatch(indoors, indoors / "lists")) == 1
