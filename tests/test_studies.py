"""Studies: every row once, whatever ends the program; the same problems for all; figures."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.files import FileError
from teaser_jax.studies import (
    Model,
    StudyError,
    draw_trials,
    read_results,
    read_table,
    read_trials,
    run_study,
    studies,
)
from teaser_jax.studies import methods as studied
from teaser_jax.studies.methods import BATCH, Method
from teaser_jax.studies.table import Table

TLS = ["TLS"]
ON_CPU = os.environ | {"JAX_PLATFORMS": "cpu"}
COMMAND = [sys.executable, "-m", "teaser_jax", "study"]


def keys(rows, sweep="outlier_rate"):
    return Counter((row[sweep], row["trial"], row["method"]) for row in rows)


def without_times(rows):
    """Leave out the time, and of how many problems it is a share: more devices take more at once."""
    return sorted(
        ({k: v for k, v in row.items() if k not in ("seconds", "together")} for row in rows),
        key=lambda row: (row["outlier_rate"], row["trial"], row["method"]),
    )


@pytest.fixture(scope="module")
def quick(tmp_path_factory):
    """One run a cell of the study of Fig. 6a, of two methods of ours."""
    folder = tmp_path_factory.mktemp("quick")
    chosen = ["teaser_jax", "least squares on the true inliers"]
    run_study("known-scale", folder, quick=True, runs=2, methods=chosen)
    return folder


@pytest.mark.long
def test_a_killed_study_loses_and_repeats_no_row(tmp_path):
    table, runs = tmp_path / "translation" / "table.csv", 30
    command = [*COMMAND, "translation", "--folder", str(tmp_path), "--runs", str(runs), "--method", "TLS"]
    study = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    while not table.exists() or table.read_bytes().count(b"\n") < 20:
        assert study.poll() is None, "it ended before it could be killed"
        time.sleep(0.002)
    study.send_signal(signal.SIGKILL)
    study.wait()
    before = read_table(table)
    assert 0 < len(before) < 10 * runs
    run_study("translation", tmp_path, runs=runs, methods=TLS)
    after = read_table(table)
    assert after[: len(before)] == before
    assert len(after) == 10 * runs
    assert set(keys(after).values()) == {1}
    run_study("translation", tmp_path / "at once", runs=runs, methods=TLS)
    assert without_times(after) == without_times(
        read_table(tmp_path / "at once" / "translation" / "table.csv")
    )


@pytest.mark.long
def test_two_processes_write_the_rows_of_one(quick, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    run_study("translation", tmp_path / "alone", quick=True, runs=2, methods=TLS)
    # One method takes its trials together, the other one by one.
    for study, method, alone in (
        ("known-scale", "teaser_jax", quick), ("translation", "TLS", tmp_path / "alone")
    ):  # fmt: skip
        command = [*COMMAND, study, "--folder", str(tmp_path), "--quick", "--runs", "2", "--method", method]
        both = [subprocess.Popen([*command, "--cluster", f"{address},2,{k}"], env=ON_CPU) for k in range(2)]
        assert [each.wait(timeout=300) for each in both] == [0, 0]
        shared, of_one = (read_table(folder / study / "table.csv") for folder in (tmp_path, alone))
        assert without_times(shared) == without_times(row for row in of_one if row["method"] == method)


@pytest.mark.long
def test_a_row_cut_in_the_middle_is_computed_again(tmp_path):
    run_study("translation", tmp_path, runs=2, quick=True, methods=TLS)
    table = tmp_path / "translation" / "table.csv"
    whole = table.read_bytes()
    for cut in (1, 7, len(whole.splitlines()[-1])):
        table.write_bytes(whole[:-cut])
        assert len(read_table(table)) == 7
        run_study("translation", tmp_path, runs=2, quick=True, methods=TLS)
        assert without_times(read_table(table)) == without_times(read_table_of(whole, tmp_path))


def read_table_of(content, folder):
    (folder / "other.csv").write_bytes(content)
    return read_table(folder / "other.csv")


@pytest.mark.parametrize(
    "content", [b"name,score\nann,1\nbob,2", b"notes of one line", b"\x00\xff", b"outlier_rate,x"]
)
def test_a_file_of_somebody_else_is_left_as_it_is(tmp_path, content):
    table = tmp_path / "translation" / "table.csv"
    table.parent.mkdir()
    table.write_bytes(content)
    with pytest.raises(FileError, match="holds other columns than this study writes: name another folder"):
        run_study("translation", tmp_path, quick=True, methods=TLS)
    assert table.read_bytes() == content


def test_half_a_header_is_written_again(tmp_path):
    path = tmp_path / "table.csv"
    path.write_bytes(b"n,tri")
    with Table(path, ("n", "trial", "method")) as table:
        table.append([{"n": 1, "trial": 0, "method": "TLS"}])
    assert path.read_bytes() == b"n,trial,method\n1,0,TLS\n"


def test_a_full_disk_is_said_and_loses_no_row(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    with Table(tmp_path / "table.csv", ("n", "trial", "method")) as table:
        table.append([{"n": 1, "trial": 0, "method": "TLS"}])
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(FileError, match="No space left on device: the rows before are safe"):
            table.append([{"n": 1, "trial": 1, "method": "TLS"}])
    assert read_table(tmp_path / "table.csv")[0] == {"n": 1.0, "trial": 0.0, "method": "TLS"}


def test_a_model_that_cannot_be_drawn_from_leaves_no_folder(tmp_path):
    few = Model("few", np.random.default_rng(0).random((50, 3)))
    flat = Model("flat", tj.synthetic.Triangles(np.zeros((4, 3)), np.array([[0, 1, 2], [1, 2, 3]])))
    for model, said in ((few, "50 points, fewer than n = 100"), (flat, "have no area")):
        with pytest.raises(
            StudyError, match=f"known-scale cannot draw from the model '{model.name}': .*{said}"
        ):
            run_study("known-scale", tmp_path / "s", quick=True, model=model, methods=["teaser_jax"])
        with pytest.raises(StudyError, match=said):
            next(iter(draw_trials(studies()["known-scale"], quick=True, model=model)))
    assert not (tmp_path / "s").exists()


@pytest.mark.long
def test_figures_without_a_place_are_said(quick, tmp_path):
    folder = shutil.copytree(quick, tmp_path / "studies")
    picture = folder / "known-scale" / "figure.png"
    picture.unlink()
    picture.mkdir()
    with pytest.raises(FileError, match="figures cannot be written: Is a directory"):
        run_study("known-scale", folder, quick=True, runs=2, methods=["teaser_jax"])


@pytest.mark.long
def test_runs_and_methods_are_added_to_a_table(tmp_path):
    run_study("translation", tmp_path, runs=1, quick=True, methods=TLS)
    first = read_table(tmp_path / "translation" / "table.csv")
    run_study("translation", tmp_path, runs=3, quick=True)
    after = read_table(tmp_path / "translation" / "table.csv")
    assert after[: len(first)] == first
    assert len(after) == len(keys(after)) == 4 * 3 * 2


@pytest.mark.long
def test_another_model_or_seed_needs_another_folder(tmp_path):
    run_study("translation", tmp_path, runs=1, quick=True, methods=TLS)
    with pytest.raises(FileError, match="seed 0, and 1 is asked for: name another folder"):
        run_study("translation", tmp_path, runs=1, quick=True, seed=1)
    cloud = Model("box", np.random.default_rng(0).random((200, 3)))
    with pytest.raises(FileError, match="model 'teapot', and 'box' is asked for"):
        run_study("translation", tmp_path, runs=1, quick=True, model=cloud)
    run_study("translation", tmp_path / "box", runs=1, quick=True, model=cloud, methods=TLS)
    other = Model("box", cloud.shape + 1)
    with pytest.raises(FileError, match="model crc32 '.{8}', and '.{8}' is asked for: name another folder"):
        run_study("translation", tmp_path / "box", runs=1, quick=True, model=other)


def test_one_writer_at_a_time(tmp_path):
    pytest.importorskip("fcntl")
    path = tmp_path / "table.csv"
    columns, key = ("a", "trial", "method", "b"), {"a": 1.5, "trial": 0, "method": "TLS"}
    with Table(path, columns) as table:
        table.append([key, key | {"b": float("nan")}])
        with pytest.raises(FileError, match="another program is writing it"):
            Table(path, columns)
    with pytest.raises(FileError, match="holds other columns"):
        Table(path, (*columns, "c"))
    with Table(path, columns) as again:
        assert again.rows[0] == key
        assert np.isnan(again.rows[1]["b"])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("a,b\n1\n", "line 2 has 1 fields, the header 2"),
        ("a,b\n1,x\n", "line 2: could not convert"),
        ("n,trial,method\n1,0,TLS\n1,,TLS\n", "line 3 does not say which cell, trial and method"),
        ("n,trial,method\n1,0.5,TLS\n", "line 2 does not say"),
        ("n,trial,method\n1,inf,TLS\n", "line 2 does not say"),
        ("n,trial,method\nnan,0,TLS\n", "line 2 does not say"),
        ("n,trial,method\n1,0,\n", "line 2 does not say"),
        (None, "run the study first"),
    ],
)
def test_a_broken_table_is_named(tmp_path, content, said):
    if content is not None:
        (tmp_path / "t.csv").write_text(content)
    with pytest.raises(FileError, match=said):
        read_table(tmp_path / "t.csv")


@pytest.mark.long
def test_answers_are_right_and_all_methods_see_the_same_problems(quick):
    results = read_results(quick / "known-scale")
    assert results.values == [0.0, 0.5, 0.9]
    for method in results.methods:
        for value in results.values:
            assert results.success(method, value) == 1
    # Refined on all matches, the answer is the fit to the true inliers.
    for value in results.values:
        limit, ours = (results.measured(m, value, "rotation_deg") for m in results.methods)
        np.testing.assert_allclose(ours, limit, rtol=0.2)
    assert results.measured("teaser_jax", 0.5, "together").tolist() == [BATCH, BATCH]
    assert results.label("teaser_jax") == f"teaser_jax (batches of {BATCH})"


@pytest.mark.long
def test_the_figure_is_drawn_and_the_page_stands_alone(quick):
    place = quick / "known-scale"
    assert (place / "figure.png").read_bytes().startswith(b"\x89PNG")
    page = (place / "figure.html").read_text()
    assert "least squares on the true inliers" in page
    assert "rotation error [deg]" in page
    assert f"teaser_jax (batches of {BATCH})" in page
    assert not re.search(r"<(script|link|img)[^>]{0,200}(src|href)=", page)
    about = json.loads((place / "about.json").read_text())
    assert about["model"] == "teapot"
    assert about["made_with"][0]["versions"]["jax"]


def test_a_batch_is_timed_whole_however_few_trials_are_scored(monkeypatch):
    """Regression: three problems of a quick study paid for a whole run, and the batch looked slow."""
    calls = []

    def solve_batch(problems, settings, mesh):
        calls.append(len(problems))
        time.sleep(0.02 * -(-len(problems) // 64))  # as a compiled program does, 64 problems a run
        return problems

    monkeypatch.setattr(studied, "solve_batch", solve_batch)
    monkeypatch.setattr(
        studied, "_judged", lambda trial, problem: {"own": np.array_equal(trial.problem.src, problem.src)}
    )
    study = studies()["known-scale"]
    few = [study.trial(0, 0.5, k, Model()) for k in range(3)]
    times = []
    for trials in (few[:1], few, few * 43):
        rows = studied.in_batches().run(trials, None)
        assert len(rows) == len(trials)
        assert all(row["own"] for row in rows)
        assert {row["together"] for row in rows} == {max(BATCH, len(trials))} == set(calls[-2:])
        times.append(rows[0]["seconds"])
    assert max(times) < 2 * min(times)
    assert studied.timed_together(3, 10_000, 1) == 10  # large problems fill a batch sooner
    assert studied.timed_together(3, 100, 4) == 4 * BATCH  # a piece of it for each device
    assert studied.timed_together(40, 1_000_000, 1) == 40


def test_what_another_library_raises_is_a_row(tmp_path, monkeypatch):
    def broken(trials, mesh):
        raise RuntimeError("no such\nthing")

    one = dataclasses.replace(
        studies()["translation"],
        methods=(Method("broken", broken, others=True), Method("silent", lambda trials, mesh: [{}])),
    )
    monkeypatch.setattr("teaser_jax.studies.run.studies", lambda: {"translation": one})
    run_study("translation", tmp_path, runs=1, quick=True)
    rows = read_table(tmp_path / "translation" / "table.csv")
    assert {row["error"] for row in rows if row["method"] == "broken"} == {"RuntimeError: no such thing"}
    assert len(rows) == 8
    ours = dataclasses.replace(one, methods=(Method("ours", broken),))
    monkeypatch.setattr("teaser_jax.studies.run.studies", lambda: {"translation": ours})
    with pytest.raises(RuntimeError, match="no such"):
        run_study("translation", tmp_path, runs=1, quick=True)


def test_every_study_draws_what_it_says():
    for study in studies().values():
        trial = study.trial(0, study.quick_values[-1], 0, Model())
        again = study.trial(0, study.quick_values[-1], 0, Model())
        other = study.trial(1, study.quick_values[-1], 0, Model())
        np.testing.assert_array_equal(trial.problem.dst, again.problem.dst)
        assert not np.array_equal(trial.problem.dst, other.problem.dst)
        p = trial.problem
        error = np.linalg.norm(p.dst - p.truth.apply(p.src), axis=1)
        assert (error[p.inliers] <= p.noise_bound).all()
        if study.sweep == "outlier_rate":
            assert p.inliers.mean() == pytest.approx(1 - study.quick_values[-1], abs=0.02)
        if trial.scale is not None:
            assert p.truth.scale == trial.scale
        assert set(study.quick_values) <= set(study.values)
        assert len({m.name for m in study.methods}) == len(study.methods)


@pytest.mark.slow
@pytest.mark.parametrize("name", list(studies()))
def test_every_study_runs(name, tmp_path):
    """In the range of errors that the paper's figures show: its easiest cell is solved by every method."""
    study = studies()[name]
    chosen = [method for method in study.methods if not method.slow and not method.others]
    run_study(name, tmp_path, quick=True, runs=1, methods=[method.name for method in chosen])
    results = read_results(tmp_path / name)
    assert len(results.rows) == len(study.quick_values) * len(chosen)
    assert not [row for row in results.rows if "error" in row]
    assert all(results.success(method, results.values[0]) == 1 for method in results.methods)
    assert {column for row in results.rows for column in row} - {study.sweep, "trial", "method"} <= {
        *study.columns
    }


@pytest.mark.parametrize(
    ("known", "said"),
    [
        ({"name": "nothing"}, "there is no study 'nothing': expected one of scale, clique"),
        ({"runs": 0}, "runs is 0: expected a whole number, 1 or above"),
        ({"seed": -1}, "seed is -1"),
        ({"methods": ["MOSEK"]}, "'MOSEK' takes no part in translation.*'TLS'"),
    ],
)
def test_what_makes_no_sense_is_said_before_anything_is_written(tmp_path, known, said):
    with pytest.raises(StudyError, match=said):
        run_study(**{"name": "translation", "folder": tmp_path / "none", **known})
    assert not (tmp_path / "none").exists()


@pytest.mark.long
def test_the_command(tmp_path, capsys):
    from teaser_jax.cli import main

    def run(*arguments):
        code = main(["study", *map(str, arguments)])
        return code, *capsys.readouterr()

    code, out, _ = run("list")
    assert code == 0
    for name in studies():
        assert name in out
    code, out, err = run("translation", "--folder", tmp_path / "s", "--runs", 1, "--quick", "--method", "TLS")
    assert code == 0
    assert out.split() == [
        str(tmp_path / "s" / "translation" / name) for name in ("table.csv", "figure.png", "figure.html")
    ]
    assert "100%" in err
    code, out, _ = run("scale", "--runs", 2, "--quick", "--export", tmp_path / "shards")
    assert code == 0
    assert len(list(read_trials(out.split()))) == 8
    for wrong in (
        ("nothing",),
        ("scale", "--model", tmp_path / "none.ply"),
        ("scale", "--runs", 0, "--folder", tmp_path),
        ("scale", "-o", "x.md"),
        ("scale", "--cluster", "here"),
        ("scale", "--cluster", "127.0.0.1:1,2,2"),
        ("scale", "--cluster", "127.0.0.1:port,2,0"),
        ("scale", "--cluster", "127.0.0.1:99999,2,0"),
        ("scale", "--cluster", ":,1,0"),
        ("scale", "--cluster", "127.0.0.1:1,0,0"),
        ("scale", "--export", tmp_path, "--method", "TLS"),
        ("scale", "--model", tmp_path),
        ("report", "--folder", tmp_path / "s"),
        ("report", "-o", "PAPER.md"),
    ):
        code, out, err = run(*wrong)
        assert (code, out) == (2, "")
        assert err.startswith("teaser-jax: ")
        assert err.count("\n") == 1
        assert ("python -m benchmarks.paper" in err) == ("report" in wrong or "-o" in wrong)
