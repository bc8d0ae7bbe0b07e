"""``teaser-jax register A B``: two files of clouds in, a pose, pictures and words out."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from cloud_scenes import plane, terrain
from oracles import random_pose

import teaser_jax as tj
from teaser_jax import cli
from teaser_jax.files import read_cloud, read_poses, write_cloud, write_pose

pytest.importorskip("small_gicp", reason="needs the extra clouds")

POSE = random_pose(np.random.default_rng(2))
SRC, DST = terrain(0, 18_000, 0, 20), terrain(1, 18_000, 8, 28)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("clouds")
    grey = np.full((len(SRC), 3), 120, np.uint8)
    write_cloud(folder / "a.ply", POSE.inverse().apply(SRC), colours=grey)
    write_cloud(folder / "b.ply", DST, colours=grey)
    np.save(folder / "other.npy", plane(0, 5000))
    np.savetxt(folder / "m.txt", np.hstack([SRC[:50], SRC[:50]]))
    near = tj.Pose(POSE.rotation, POSE.translation + [0.2, 0.1, 0], 1.0)
    write_pose(folder / "near.txt", near)
    return folder


def test_two_clouds_give_a_pose_a_picture_a_page_and_a_merged_cloud(files: Path, tmp_path: Path, capsys):
    places = {name: tmp_path / name for name in ("T.txt", "v.png", "v.html", "m.ply")}
    code = cli.main(
        ["register", str(files / "a.ply"), str(files / "b.ply"), "-o", str(places["T.txt"]), "--plot",
         str(places["v.png"]), "--html", str(places["v.html"]), "--merged", str(places["m.ply"])]
    )  # fmt: skip
    out, err = capsys.readouterr()
    assert (code, err) == (0, "")
    assert out.startswith("ok: OK")
    pose = read_poses(places["T.txt"]).poses[0]
    assert np.linalg.norm(pose.apply(POSE.inverse().apply(SRC)) - SRC, axis=1).max() < 1.0
    assert places["v.png"].read_bytes().startswith(b"\x89PNG")
    assert "a.ply in the frame of b.ply" in places["v.html"].read_text()
    merged = read_cloud(places["m.ply"])
    assert len(merged) == len(SRC) + len(DST)
    assert (merged.colours == 120).all()


@pytest.mark.long
def test_the_demo_registers_two_scans(tmp_path: Path, capsys):
    path = tmp_path / "demo.png"
    assert cli.main(["demo", "--plot", str(path)]) == 0
    out, err = capsys.readouterr()
    for part in ("scanned from two sides", "ok: OK", "Error against the truth", "descriptors", "Picture: "):
        assert part in out
    assert err == ""
    assert path.read_bytes().startswith(b"\x89PNG")


def test_json_holds_what_the_answer_rests_on_and_an_initial_pose_is_read(files: Path, capsys):
    arguments = ["register", files / "a.ply", files / "b.ply", "--initial", files / "near.txt", "--json"]
    assert cli.main([*map(str, arguments), "--initial-error", "1", "--align", "gicp"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["ok"]
    assert report["candidates"][0]["found_by"] == "the initial pose"
    assert 0 < report["displacement"] < report["voxel_size"]
    assert np.shape(report["covariance"]) == (6, 6)
    assert report["evidence"]["fit"] > 0.3
    assert report["points"]["src"]["used"] == len(SRC)


def test_without_an_answer_an_older_pose_goes(files: Path, tmp_path: Path, capsys):
    old, merged = tmp_path / "T.txt", tmp_path / "m.ply"
    old.write_text("1")
    merged.write_text("1")
    arguments = ["register", files / "a.ply", files / "other.npy", "--seconds", "0.001", "-o", old]
    assert cli.main([*map(str, arguments), "--merged", str(merged), "--json"]) == 1
    out, err = capsys.readouterr()
    assert not json.loads(out)["ok"]
    assert "older file removed" in err
    assert not old.exists()
    assert not merged.exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["a.ply"], "name a second one after it"),
        (["a.ply", "none.ply"], "no such file"),
        (["a.ply", "b.ply", "--noise-bound", "1"], "--noise-bound belongs to a file of matches"),
        (["a.ply", "b.ply", "--certify"], "--certify belongs to a file of matches"),
        (["m.txt", "--voxel-size", "1"], "--voxel-size belongs to two clouds"),
        (["a.ply", "b.ply", "--no-refine"], "--no-refine belongs to a file of matches"),
        (["m.txt", "--html", "x.html"], "--html belongs to two clouds"),
        (["a.ply", "b.ply", "--scale", "estimate"], "give the known scale"),
        (["a.ply", "b.ply", "--voxel-size", "0"], "voxel_size is 0"),
        (["a.ply", "b.ply", "--html", "x.txt"], "end the name of a page in .html"),
        (["a.ply", "b.ply", "-o", "a.ply"], "is a file that is read"),
        (["a.ply", "b.ply", "-o", "x.ply", "--merged", "x.ply"], "name two files"),
        (["a.ply", "b.ply", "--initial", "m.txt"], "expected 4 (matrices)"),
    ],
)
def test_what_makes_no_sense_is_said_in_one_line(files: Path, monkeypatch, capsys, arguments, said: str):
    monkeypatch.chdir(files)
    before = sorted(files.iterdir())
    assert cli.main(["register", *arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert err.count("\n") == 1
    assert sorted(files.iterdir()) == before
