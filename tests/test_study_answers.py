"""Answers of another program: scored as those of all methods, or refused with what is wrong."""

from __future__ import annotations

import json

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.cli import main
from teaser_jax.files import FileError
from teaser_jax.studies import (
    Model,
    StudyError,
    draw_trials,
    read_answers,
    read_results,
    read_trials,
    run_study,
    save_trials,
    studies,
)
from teaser_jax.studies.trials import TEAPOT

COPIED = ("study", "seed", "model", "model_crc32", "protocol", "value", "trial")
LIMIT = "least squares on the true inliers"
NAME = "three points at a time"


def fit(src, dst):
    """Find the rotation and translation of least squares (Horn, Kabsch)."""
    a, b = src.mean(axis=0), dst.mean(axis=0)
    u, _, v = np.linalg.svd((dst - b).T @ (src - a))
    rotation = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return rotation, b - rotation @ a


def solve(src, dst, bound):
    """Fit triples of matches and return the pose that most matches agree with: a user's small method."""
    rng, most, best = np.random.default_rng(0), -1, None
    for _ in range(200):
        rows = rng.choice(len(src), 3, replace=False)
        rotation, translation = fit(src[rows], dst[rows])
        near = np.linalg.norm(dst - src @ rotation.T - translation, axis=1) < 3 * bound
        if near.sum() > most:
            most, best = near.sum(), fit(src[near], dst[near]) if near.sum() > 3 else (rotation, translation)
    return best


def answered(shard):
    """Make what a user saves: poses, and whose they are."""
    poses = [solve(*one) for one in zip(shard["src"], shard["dst"], shard["noise_bound"], strict=True)]
    rotation, translation = (np.array(each) for each in zip(*poses, strict=True))
    return {"method": NAME, "rotation": rotation, "translation": translation} | {k: shard[k] for k in COPIED}


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    """The six problems of a quick study of two runs."""
    folder = tmp_path_factory.mktemp("problems")
    assert main(["study", "known-scale", "--quick", "--runs", "2", "--export", str(folder)]) == 0
    return folder / "known-scale-00000.npz"


@pytest.fixture
def answers(shard):
    return answered(np.load(shard))


def read(path, study="known-scale", runs=2, seed=0, model=TEAPOT):
    asked = studies()[study]
    return read_answers([path], asked, asked.origin(seed, model), asked.cells(runs, quick=True))


@pytest.mark.long
def test_a_user_exports_solves_and_scores(shard, answers, tmp_path, capsys):
    answers["rotation"][3] = answers["translation"][3] = np.nan  # of 0.5: no answer
    answers["seconds"] = np.where(np.arange(6) < 5, 0.25, np.nan)
    np.savez(tmp_path / "mine.npz", **answers)
    command = ["study", "known-scale", "--quick", "--runs", "2", "--method", LIMIT, "--folder", str(tmp_path)]
    assert main([*command, "--score", str(tmp_path / "mine.npz")]) == 0
    place = tmp_path / "known-scale"
    results = read_results(place)
    assert results.methods == [LIMIT, NAME]
    assert len(results.rows) == 12
    assert NAME in (place / "figure.html").read_text()
    assert results.success(NAME, 0.0) == 1
    assert results.success(NAME, 0.5) == 0.5  # NaN is a failure
    for k, trial in enumerate(read_trials(shard)):
        (row,) = [r for r in results.of(NAME, trial.value) if r["trial"] == trial.number]
        assert row.get("seconds") == (0.25 if k < 5 else None)
        if k != 3:
            pose = tj.Pose(answers["rotation"][k], answers["translation"][k], np.asarray(1.0))
            error = tj.metrics.errors(pose, trial.problem.truth)
            assert row["rotation_deg"] == pytest.approx(float(error.rotation_deg), rel=1e-6)
            assert row["translation"] == pytest.approx(float(error.translation), rel=1e-6)
    # Again: nothing changes. Other answers under the same name are refused, and both ways out work.
    before = (place / "table.csv").read_text()
    run_study("known-scale", tmp_path, quick=True, runs=2, methods=[LIMIT], score=tmp_path / "mine.npz")
    assert (place / "table.csv").read_text() == before
    np.savez(tmp_path / "other.npz", **answers | {"seconds": np.ones(6)})
    capsys.readouterr()
    assert main([*command, "--score", str(tmp_path / "other.npz")]) == 2
    assert (
        "holds other answers of 'three points at a time': give the method another name"
        in capsys.readouterr().err
    )
    assert (place / "table.csv").read_text() == before
    np.savez(tmp_path / "renamed.npz", **answers | {"seconds": np.ones(6), "method": "mine, slower"})
    assert main([*command, "--score", str(tmp_path / "renamed.npz")]) == 0
    assert read_results(place).methods == [LIMIT, "mine, slower", NAME]
    rows = (place / "table.csv").read_text().splitlines(keepends=True)
    (place / "table.csv").write_text("".join(row for row in rows if NAME not in row))
    assert main([*command, "--score", str(tmp_path / "other.npz")]) == 0
    assert json.loads((place / "about.json").read_text())["seed"] == 0


def test_answers_may_come_in_any_order_and_in_several_files(answers, tmp_path):
    order = np.array([4, 0, 5, 2, 1, 3])
    rows = {k: x for k, x in answers.items() if np.ndim(x)}
    parts = []
    for k, some in enumerate((order[:2], order[2:])):
        parts.append(tmp_path / f"{k}.npz")
        np.savez(parts[-1], **answers | {name: x[some] for name, x in rows.items()})
    study = studies()["known-scale"]
    cells, origin = study.cells(2, quick=True), study.origin(0, TEAPOT)
    np.savez(tmp_path / "one.npz", **answers)
    (split,), (whole,) = (read_answers(p, study, origin, cells) for p in (parts, [tmp_path / "one.npz"]))
    trials = list(draw_trials(study, runs=2, quick=True))
    assert split.run(trials, None) == whole.run(trials, None)
    with pytest.raises(FileError, match="answers outlier_rate 0, trial 0 twice"):
        read_answers([tmp_path / "one.npz"] * 2, study, origin, cells)
    with pytest.raises(
        FileError, match=r"6 problems are asked; it lacks 4 of them, first outlier_rate 0, trial 1"
    ):
        read_answers(parts[:1], study, origin, cells)


@pytest.mark.long
def test_only_what_a_study_measures_must_be_answered(tmp_path):
    for name, part, true in (("scale", "scale", 1.0), ("translation", "translation", 1.0)):
        (path,) = save_trials(tmp_path, draw_trials(studies()[name], runs=2, quick=True), name=name)
        shard = np.load(path)
        np.savez(
            tmp_path / "a.npz", method="truth", **{part: true * shard[part]}, **{k: shard[k] for k in COPIED}
        )
        (method,) = read(tmp_path / "a.npz", study=name)
        rows = method.run(list(read_trials(path)), None)
        assert all(studies()[name].right(row) for row in rows)
        np.savez(tmp_path / "a.npz", method="truth", **{k: shard[k] for k in COPIED})
        with pytest.raises(
            FileError, match=f"it lacks {part}. Write method and {part}, and copy study, seed"
        ):
            read(tmp_path / "a.npz", study=name)
    with pytest.raises(StudyError, match="clique measures no poses"):
        read(tmp_path / "a.npz", study="clique")


def bad(name, row, value):
    """Spoil one row of an array."""

    def spoil(answers):
        answers[name] = np.array(answers[name], float)
        answers[name][row] = value

    return spoil


def lost(name):
    return lambda answers: answers.pop(name)


def put(name, value):
    return lambda answers: answers.update({name: value})


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lost("translation"), "is no file of answers to known-scale: it lacks translation. Write method and"),
        (lost("seed"), "it lacks seed. .* copy study, seed, model, model_crc32, protocol, value, trial"),
        (lost("method"), "it lacks method"),
        (put("method", ""), "method is no name: give one text"),
        (put("method", np.ones(2)), "method is no name"),
        (put("method", "teaser_jax"), "'teaser_jax' is a method of the studies: give yours another name"),
        (put("method", "TEASER++"), "'TEASER..' is a method of the studies"),
        (put("rotation", np.zeros((6, 3))), r"rotation has shape .6, 3.: expected .6, 3, 3., as trial has 6"),
        (put("rotation", np.zeros((5, 3, 3))), r"rotation has shape .5, 3, 3.: expected .6, 3, 3."),
        (put("translation", np.zeros((6, 3), complex)), "translation holds complex128: expected real"),
        (put("translation", np.full((6, 3), "x")), "translation holds <U1: expected real numbers"),
        (put("seconds", np.ones(5)), r"seconds has shape .5,.: expected .6,."),
        (put("value", np.zeros(5)), r"value has shape .5,.: expected .6,."),
        (bad("trial", 0, 0.5), "value or trial names no problem: copy both from the shard"),
        (bad("value", 0, np.nan), "value or trial names no problem"),
        (bad("trial", 0, 1), "the answer to outlier_rate 0, trial 1 is there twice"),
        (bad("trial", 1, 2), "problems are asked; it lacks 1 of them, first outlier_rate 0, trial 1: answer"),
        (bad("rotation", 1, 2 * np.eye(3)), "outlier_rate 0, trial 1 has a rotation that is none .*I by 3"),
        (bad("rotation", 1, -np.eye(3)), "det R = -1.: give R without the scale, with det R = 1"),
        (bad("rotation", 4, np.nan), "to outlier_rate 0.9, trial 0 has a rotation that is not finite"),
        (bad("translation", 4, np.inf), "has a translation that is not finite"),
        (put("seconds", np.full(6, -1.0)), "has seconds -1: give a time, or NaN"),
        (put("seed", 1), "answers problems of seed 1, and 0 is asked for: ask for that seed, or export anew"),
        (put("seed", np.arange(6)), "seed has 6 values: expected one, as in a shard"),
        (put("seed", 0.5), "seed or protocol is no whole number"),
        (put("model", "bunny"), "answers problems of model 'bunny', and 'teapot' is asked for"),
        (put("model_crc32", "00000000"), "of model crc32 '00000000', and '' is asked for"),
        (put("study", "extreme"), "of study 'extreme', and 'known-scale' is asked for: ask for that study"),
        (put("protocol", 0), "of protocol 0, and 1 is asked for"),
    ],
)  # fmt: skip
def test_files_that_cannot_be_scored_say_why_and_what_to_do(answers, tmp_path, spoil, said):
    spoil(answers)
    np.savez(tmp_path / "mine.npz", **answers)
    with pytest.raises(FileError, match=said) as raised:
        read(tmp_path / "mine.npz")
    assert str(raised.value).startswith(str(tmp_path / "mine.npz"))


def test_answers_to_more_or_fewer_problems_than_are_asked_are_refused(answers, tmp_path):
    np.savez(tmp_path / "mine.npz", **answers)
    with pytest.raises(
        FileError, match="3 problems are asked; it answers 3 others, first outlier_rate 0, trial 1"
    ):
        read(tmp_path / "mine.npz", runs=1)
    with pytest.raises(
        FileError, match=r"9 problems are asked; it lacks 3 of them, .*with the runs and quick of"
    ):
        read(tmp_path / "mine.npz", runs=3)
    with pytest.raises(FileError, match="of seed 0, and 5 is asked for"):
        read(tmp_path / "mine.npz", seed=5)
    with pytest.raises(FileError, match="of model 'teapot', and 'box' is asked for"):
        read(tmp_path / "mine.npz", model=Model("box", np.ones((200, 3))))
    with pytest.raises(FileError, match="no such file"):
        read(tmp_path / "none.npz")
    (tmp_path / "mine.npz").write_bytes(b"no archive")
    with pytest.raises(FileError, match=r"is no .npz archive"):
        read(tmp_path / "mine.npz")


def test_a_scale_that_is_none_is_refused(tmp_path):
    (path,) = save_trials(tmp_path, draw_trials(studies()["scale"], runs=2, quick=True))
    shard = np.load(path)
    for value in (0.0, -1.0, np.inf):
        scale = np.array(shard["scale"])
        scale[2] = value
        np.savez(tmp_path / "mine.npz", method="mine", scale=scale, **{k: shard[k] for k in COPIED})
        with pytest.raises(
            FileError, match="to outlier_rate 0.5, trial 0 has (scale|a scale that is not finite)"
        ):
            read(tmp_path / "mine.npz", study="scale")


def test_the_command_refuses_what_cannot_go_together(tmp_path, capsys):
    for words, said in (
        (["all", "--score", "mine.npz"], "--score measures the answers to one study"),
        (["scale", "--score", "mine.npz", "--export", str(tmp_path)], "--export writes the problems"),
        (["scale", "--score", "none.npz", "--folder", str(tmp_path / "s")], "none.npz: no such file"),
    ):
        assert main(["study", *words]) == 2
        out, err = capsys.readouterr()
        assert (out, err.count("\n")) == ("", 1)
        assert said in err
    assert list(tmp_path.iterdir()) == []
