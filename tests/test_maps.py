"""Many clouds to one map: what is asked, what is kept, what goes on after a kill, what is said."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from cloud_scenes import plane, terrain
from map_scenes import loop_of_poses, measured
from oracles import random_pose

import teaser_jax as tj
from teaser_jax import cli
from teaser_jax.files import read_cloud, read_poses, write_cloud
from teaser_jax.maps import work
from teaser_jax.maps.chosen import ALIKE, ALL, NEXT, looks, pairs_to_ask
from teaser_jax.maps.pair import as_plain, from_plain
from teaser_jax.maps.register import register_many
from teaser_jax.maps.shelf import Reading, Shelf

pytest.importorskip("small_gicp", reason="needs the extra clouds")

POINTS = 5000
LOWS = (0, 4, 8, 12)
POSES = [random_pose(np.random.default_rng(k)) for k in range(4)]
# A strip of one landscape in four pieces, each in a frame of its own.
STRIPS = [
    pose.inverse().apply(terrain(k, POINTS, low, low + 20))
    for k, (pose, low) in enumerate(zip(POSES, LOWS, strict=True))
]


def truth(i: int, j: int) -> np.ndarray:
    return (POSES[i].inverse() @ POSES[j]).matrix


def shelf_of(clouds) -> Shelf:
    return Shelf(clouds, [str(k) for k in range(len(clouds))], Reading())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Four clouds, coloured, in the natural order of their names, beside a table of times."""
    folder = tmp_path_factory.mktemp("scans")
    for k, cloud in enumerate(STRIPS):
        name = ("scan2", "scan10", "scan11", "scan100")[k]
        write_cloud(folder / f"{name}.ply", cloud, colours=np.full((len(cloud), 3), 50 * k, np.uint8))
    (folder / "times.txt").write_text("0 1 2\n")
    return folder


@pytest.fixture(scope="module")
def found(folder: Path, tmp_path_factory) -> tuple[tj.CloudMap, Path]:
    store = tmp_path_factory.mktemp("pairs")
    return register_many(sorted(folder.glob("*.ply"), key=lambda p: int(p.stem[4:])), folder=store), store


def test_clouds_are_laid_together(found):
    result, _ = found
    assert result.ok
    assert result
    assert result.placed.all()
    assert result.confirmed.all()
    np.testing.assert_array_equal(result.poses[0], np.eye(4))
    for k in range(4):
        off = tj.Pose.from_matrix(result.poses[k]).apply(STRIPS[k]) - tj.Pose.from_matrix(truth(0, k)).apply(
            STRIPS[k]
        )
        assert np.linalg.norm(off, axis=1).mean() < 0.1
    assert len(result.pairs) == 6
    assert result.names == ("scan2.ply", "scan10.ply", "scan11.ply", "scan100.ply")
    text = result.report()
    assert text.startswith("ok: 4 of 4 clouds placed")
    assert "scan10.ply to scan2.ply: kept" in text
    assert result.why(1, 0) == result.why(0, 1)
    with pytest.raises(ValueError, match="no pair that was asked"):
        result.why(0, 0)
    merged = result.merged()
    assert len(merged) == sum(len(points) for _, points in result.points()) == 4 * POINTS
    assert len(result.merged(1.0)) < 2000
    spread = np.linalg.svd((merged - merged.mean(axis=0)), compute_uv=False)
    assert spread[2] < spread[1] / 3  # one landscape, and not four


def test_what_is_done_is_not_done_again(found, folder: Path, monkeypatch):
    result, store = found
    monkeypatch.setattr(work, "register_clouds", lambda *a, **k: pytest.fail("asked again"))
    paths = [folder / name for name in result.names]
    again = register_many(paths, folder=store)
    np.testing.assert_array_equal(again.poses, result.poses)
    # Names and order do not matter: answers belong to clouds.
    fewer = register_many([read_cloud(paths[0]).points, *paths[2:]], folder=store, names=["a", "b", "c"])
    np.testing.assert_array_equal(fewer.pairs[0].T, result.pairs[1].T)


@pytest.mark.long
def test_files_that_something_broke_are_asked_anew(found, folder: Path, monkeypatch, tmp_path: Path):
    result, store = found
    files = sorted(store.glob("pair_*.json"))
    assert len(files) == 6
    for k, file in enumerate(files):
        text = file.read_text()
        broken = ["", text[: len(text) // 2], "[]", "null", text.replace('"T"', '"t"'), text][k]
        (tmp_path / file.name).write_text(broken)
    asked = []
    real = work.register_clouds
    monkeypatch.setattr(work, "register_clouds", lambda *a, **k: asked.append(a) or real(*a, **k))
    again = register_many([folder / name for name in result.names], folder=tmp_path)
    assert len(asked) == 5
    np.testing.assert_allclose(again.poses, result.poses, atol=1e-12)
    assert sorted(x.name for x in tmp_path.iterdir()) == [x.name for x in files]


def test_other_options_are_other_answers(found, folder: Path):
    result, store = found
    paths = [folder / name for name in result.names[:2]]
    register_many(paths, folder=store, voxel_size=0.6)
    assert len(list(store.glob("pair_*.json"))) == 7


def test_pairs_are_kept_exactly():
    rng = np.random.default_rng(0)
    pair = measured(loop_of_poses(4), 1, 2, rng)
    back = from_plain(1, 2, json.loads(json.dumps(as_plain(pair))))
    np.testing.assert_array_equal(back.T, pair.T)
    np.testing.assert_array_equal(back.covariance, pair.covariance)
    assert (back.status, back.displacement, back.i, back.j) == (pair.status, pair.displacement, 1, 2)


@pytest.mark.slow
def test_workers_share_the_pairs_and_change_no_answer(found, folder: Path, tmp_path: Path):
    result, _ = found
    paths = [folder / name for name in result.names]
    shared = register_many(paths, folder=tmp_path, workers=2, pairs=[(0, 1), (1, 2), (0, 2)])
    assert len(list(tmp_path.glob("pair_*.json"))) == 3
    for pair in shared.pairs:
        alone = next(x for x in result.pairs if (x.i, x.j) == (pair.i, pair.j))
        np.testing.assert_array_equal(pair.T, alone.T)


KILLED = """
import sys, teaser_jax as tj
if __name__ == "__main__":
    tj.register_many(sys.argv[2:], folder=sys.argv[1])
"""


@pytest.mark.slow
def test_the_work_goes_on_after_a_kill(found, folder: Path, tmp_path: Path, monkeypatch):
    result, _ = found
    paths = [folder / name for name in result.names]
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path), *map(str, paths)])
    end = time.monotonic() + 240
    while not list(tmp_path.glob("pair_*.json")) and time.monotonic() < end:
        time.sleep(0.05)
    os.kill(process.pid, signal.SIGKILL)
    process.wait()
    done = len(list(tmp_path.glob("pair_*.json")))
    assert 0 < done <= 6
    asked = []
    real = work.register_clouds
    monkeypatch.setattr(work, "register_clouds", lambda *a, **k: asked.append(a) or real(*a, **k))
    again = register_many(paths, folder=tmp_path)
    assert len(asked) == 6 - done
    np.testing.assert_allclose(again.poses, result.poses, atol=1e-9)


def test_a_budget_ends_the_work_and_is_said(folder: Path, monkeypatch):
    monkeypatch.setattr(work, "register_clouds", lambda *a, **k: pytest.fail("begun after the end"))
    result = register_many(STRIPS[:3], seconds=1e-9)
    assert not result.ok
    assert not result.placed.any()
    assert np.isnan(result.poses).all()
    assert "3 pairs were not asked" in str(result)
    assert result.merged().shape == (0, 3)


@pytest.mark.long
def test_clouds_that_nothing_holds_are_not_placed():
    result = register_many([*STRIPS[:2], plane(0, 5000)], names=["a", "b", "flat"])
    assert not result.ok
    assert result.placed.tolist() == [True, True, False]
    assert not result.confirmed.any() or result.confirmed.sum() == 1
    text = str(result)
    assert "not placed   flat" in text
    assert "as sure as that pair" in text


@pytest.mark.long
def test_all_pairs_of_few_clouds_and_some_of_many():
    few = pairs_to_ask(shelf_of([None] * ALL), None)
    assert len(few) == ALL * (ALL - 1) // 2
    assert few[: ALL - 1] == [(k, k + 1) for k in range(ALL - 1)]
    # Places that come again: cloud k + 16 shows what cloud k did, from elsewhere and with other points.
    many = pairs_to_ask(shelf_of([place_of(k % 16, k) for k in range(32)]), None)
    assert len(set(many)) == len(many) < 32 * (NEXT + ALIKE)
    assert {(k, k + 1) for k in range(31)} <= set(many)
    assert np.mean([(k, k + 16) in many for k in range(16)]) > 0.8


def place_of(place: int, seed: int) -> np.ndarray:
    """A cloud of one of many places, drawn anew with each seed and turned about."""
    shape, rng = np.random.default_rng(100 + place), np.random.default_rng(seed)
    boxes, sizes = shape.uniform(-5, 5, (25, 3)), shape.uniform(0.2, 1.5, (25, 3))
    box, face = rng.integers(0, 25, POINTS), rng.integers(0, 3, POINTS)
    on = rng.uniform(-1, 1, (POINTS, 3))
    on[np.arange(POINTS), face] = np.sign(on[np.arange(POINTS), face])
    return random_pose(rng).apply(boxes[box] + sizes[box] * on)


def test_clouds_of_one_place_look_alike_wherever_they_are():
    clouds = [place_of(k % 6, k) for k in range(12)]
    alike = looks(shelf_of(clouds))
    np.testing.assert_allclose(np.linalg.norm(alike, axis=1), 1)
    best = np.argsort(-(alike @ alike.T), axis=1)
    assert [row[row != k][0] for k, row in enumerate(best)] == [(k + 6) % 12 for k in range(12)]


@pytest.mark.parametrize(
    ("clouds", "options", "words"),
    [
        ([STRIPS[0]], {}, "two or more"),
        ("a.ply", {}, "a list of clouds"),
        (STRIPS[:2], {"workers": 0}, "workers is 0"),
        (STRIPS[:2], {"pairs": "most"}, "expected 'all', 'some'"),
        (STRIPS[:2], {"pairs": [(0, 2)]}, "none of 2 clouds"),
        (STRIPS[:2], {"pairs": [(0, 0)]}, "none of 2 clouds"),
        (STRIPS[:2], {"pairs": [3]}, "give two numbers"),
        (STRIPS[:2], {"names": ["a"]}, "1 entries for 2 clouds"),
        (STRIPS[:2], {"seconds": -1.0}, "seconds is -1.0"),
        ([STRIPS[0], STRIPS[1][:50]], {"names": ["a", "b"]}, "b has 50 points"),
        ([STRIPS[0], "missing.ply"], {}, "missing.ply: no such file"),
        ([tj.prepare(STRIPS[0]), STRIPS[1]], {"max_range": 5.0}, "prepared already"),
    ],
)
def test_what_makes_no_sense_is_said(clouds, options, words):
    with pytest.raises(ValueError, match=words):
        register_many(clouds, **options)


def test_prepared_clouds_are_welcome():
    ready = [tj.prepare(cloud) for cloud in STRIPS[:2]]
    told = []
    result = register_many(ready, progress=told.append)
    assert result.pairs[0].ok
    assert told[-1] == "registering pairs: 1 of 1"


@pytest.mark.long
def test_the_command_makes_a_map(folder: Path, tmp_path: Path, capsys):
    out, merged = tmp_path / "poses.json", tmp_path / "map.ply"
    command = ["map", str(folder), "-o", str(out), "--merged", str(merged)]
    assert cli.main(command) == 0
    text, err = capsys.readouterr()
    assert text.startswith("ok: 4 of 4 clouds placed")
    assert err == ""
    assert [x["name"] for x in json.loads(out.read_text())["poses"]][:2] == ["scan2.ply", "scan10.ply"]
    poses = read_poses(out).poses
    for k in range(4):
        np.testing.assert_allclose(
            poses[k].apply(STRIPS[k][:10]), tj.Pose.from_matrix(truth(0, k)).apply(STRIPS[k][:10]), atol=0.3
        )
    cloud = read_cloud(merged)
    assert len(cloud) == 4 * POINTS
    assert set(cloud.colours[:, 0].tolist()) == {0, 50, 100, 150}
    assert len(list((tmp_path / "poses.json.pairs").iterdir())) == 6
    # Once more, as JSON and as TUM, in no time.
    start = time.process_time()
    assert (
        cli.main(["map", str(folder), "--work", f"{out}.pairs", "-o", str(tmp_path / "p.tum"), "--json"]) == 0
    )
    assert time.process_time() - start < 20
    report = json.loads(capsys.readouterr().out)
    assert report["ok"]
    assert [x["kept"] for x in report["pairs"]] == [True] * 6
    assert read_poses(tmp_path / "p.tum").times.tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f / "nothing", "no such folder"),
        (lambda f: f / "a.ply", "is no folder"),
        (lambda f: f, "a map needs two or more"),
        (lambda f: (f / "b.ply").write_text("ply\nnonsense") and f, "b.ply"),
    ],
)
def test_the_command_says_what_is_wrong_in_one_line(tmp_path: Path, capsys, change, words):
    write_cloud(tmp_path / "a.ply", STRIPS[0])
    assert cli.main(["map", str(change(tmp_path))]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert words in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("options", [["--merged", "b.ply"], ["-o", "b.ply"], ["--merged", "new.ply"]])
def test_nothing_is_written_among_the_scans(tmp_path: Path, capsys, options):
    for name in ("a", "b", "c"):
        write_cloud(tmp_path / f"{name}.ply", STRIPS[0])
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert cli.main(["map", str(tmp_path), options[0], str(tmp_path / options[1])]) == 2
    assert "lies among the scans" in capsys.readouterr().err
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
