"""The command line: what it prints, what it writes, and how it fails."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from typing import get_args

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import teaser_jax as tj
from teaser_jax import cli, plots
from teaser_jax.cli import register as register_command


@pytest.fixture
def matches(tmp_path, small):
    """The small problem in a file."""
    path = tmp_path / "matches.npz"
    np.savez(path, src=small.src, dst=small.dst, T_dst_src=small.truth.matrix)
    return path


@pytest.fixture
def wrong(tmp_path):
    """A file in which no match is right."""
    problem = tj.synthetic.random_problem(0, n=32, outlier_rate=1)
    path = tmp_path / "wrong.npz"
    np.savez(path, src=problem.src, dst=problem.dst)
    return path


def strictly(text: str) -> dict:
    """JSON as every parser understands it."""

    def refuse(constant):
        raise AssertionError(f"{constant} is no JSON")

    return json.loads(text, parse_constant=refuse)


def bad_input(capsys, *arguments) -> str:
    """The one line that a command ends with."""
    assert cli.main([str(a) for a in arguments]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.endswith("\n")
    assert len(err.splitlines()) == 1
    assert err.startswith("teaser-jax: ")
    assert "Traceback" not in err
    return err


def test_a_right_answer(matches, tmp_path, small, solved, capsys):
    output, plot = tmp_path / "T.txt", tmp_path / "p.png"
    arguments = ["register", matches, "--noise-bound", 0.0554, "-o", output, "--plot", plot]
    assert cli.main([str(a) for a in arguments]) == 0
    out, err = capsys.readouterr()
    assert out.startswith("ok: OK\n")
    assert "Error against the T_dst_src of the file" in out
    assert err == ""
    np.testing.assert_allclose(np.loadtxt(output), solved.pose.matrix, atol=1e-12)
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_json_holds_the_whole_answer(matches, solved, capsys):
    assert cli.main(["register", str(matches), "--noise-bound", "0.0554", "--json"]) == 0
    report = strictly(capsys.readouterr().out)
    assert report["ok"] is True
    assert report["status"] == "OK"
    np.testing.assert_allclose(report["pose"]["T_dst_src"], solved.pose.matrix, atol=1e-12)
    np.testing.assert_allclose(report["pose"]["quaternion_xyzw"], solved.pose.quat, atol=1e-12)
    assert report["inliers"] == np.flatnonzero(solved.inliers).tolist()
    assert report["clique"] == {"size": 16, "upper_bound": 16, "is_maximum": True}
    assert report["error"]["rotation_deg"] < 3


def test_text_and_bounds_from_a_file_give_the_same_answer(tmp_path, small, solved, capsys):
    table, archive = tmp_path / "m.csv", tmp_path / "m.npz"
    np.savetxt(table, np.hstack([small.src, small.dst]), delimiter=",", header="x,y,z,u,v,w", comments="")
    np.savez(archive, src=small.src, dst=small.dst, noise_bound=np.full(32, small.noise_bound))
    bound = repr(small.noise_bound)
    for arguments in ([table, "--noise-bound", bound], [archive]):
        assert cli.main(["register", *map(str, arguments), "--json"]) == 0
        matrix = strictly(capsys.readouterr().out)["pose"]["T_dst_src"]
        np.testing.assert_allclose(matrix, solved.pose.matrix, atol=1e-12)


@pytest.mark.parametrize("name", ["scale", "cbar2"])
def test_options_win_over_the_file_and_the_file_over_the_defaults(
    tmp_path, small, solved, capsys, monkeypatch, name
):
    received = []
    monkeypatch.setattr(
        tj, "register", lambda *_, settings, certify, **known: received.append(known) or solved
    )
    plain, full = tmp_path / "plain.npz", tmp_path / "full.npz"
    np.savez(plain, src=small.src, dst=small.dst)
    np.savez(full, src=small.src, dst=small.dst, **{name: 2.0})
    for path, *options in ((plain,), (full,), (full, f"--{name}", "3")):
        assert cli.main(["register", str(path), "--noise-bound", "1", *options]) == 0
    assert received == [{"noise_bound": 1}, {"noise_bound": 1, name: 2}, {"noise_bound": 1, name: 3}]


@pytest.mark.long
def test_an_estimated_scale(tmp_path, capsys):
    problem = tj.synthetic.random_problem(1, n=32, outlier_rate=0.25, scale=3.0)
    path = tmp_path / "m.npz"
    np.savez(path, src=problem.src, dst=problem.dst)
    assert cli.main(["register", str(path), "--noise-bound", "0.0554", "--scale", "estimate", "--json"]) == 0
    assert strictly(capsys.readouterr().out)["pose"]["scale"] == pytest.approx(3, rel=0.05)


def test_no_trustworthy_answer_leaves_no_pose_behind(wrong, tmp_path, capsys):
    output, plot = tmp_path / "T.txt", tmp_path / "p.png"
    output.write_text("the pose of an earlier run")
    arguments = ["register", wrong, "--noise-bound", 0.0554, "-o", output, "--plot", plot]
    assert cli.main([str(a) for a in arguments]) == 1
    out, err = capsys.readouterr()
    assert out.startswith("NOT OK: ")
    assert err == f"teaser-jax: {output} not written, and the older file removed: {out.split()[2]}\n"
    assert not output.exists()
    assert plot.exists()
    assert cli.main(["register", str(wrong), "--noise-bound", "0.0554", "--json"]) == 1
    report = strictly(capsys.readouterr().out)
    assert report["ok"] is False
    assert report["status"] == out.split()[2]


@pytest.mark.parametrize("draws", [True, False])
def test_nothing_is_said_or_changed_when_something_cannot_be_written(
    matches, tmp_path, capsys, monkeypatch, draws
):
    def full(*_):
        raise OSError(28, "No space left on device")

    where = (plots, "plot_registration") if draws else (register_command, "write_pose")
    monkeypatch.setattr(*where, full)
    output, plot = tmp_path / "T.txt", tmp_path / "p.png"
    for path in (output, plot):
        path.write_text("of an earlier run")
    arguments = ["register", matches, "--noise-bound", 0.0554, "-o", output, "--plot", plot]
    assert "cannot be written: No space left on device" in bad_input(capsys, *arguments)
    assert {path.read_text() for path in (output, plot)} == {"of an earlier run"}
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize(("name", "bound"), [("none.npz", 1), ("matches.npz", -1)])
def test_bad_input_leaves_an_older_file_alone(matches, tmp_path, capsys, name, bound):
    output = tmp_path / "T.txt"
    output.write_text("the pose of an earlier run")
    bad_input(capsys, "register", tmp_path / name, "--noise-bound", bound, "-o", output)
    assert output.read_text() == "the pose of an earlier run"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "required: COMMAND"),
        (["regsiter"], "invalid choice: 'regsiter'"),
        (["register"], "required: FILE"),
        (["register", "{m}"], "--noise-bound is missing"),
        (["register", "{m}", "--noise-bound", "much"], "invalid float value: 'much'"),
        (["register", "{m}", "--noise-bound", "nan"], "noise_bound contains nan"),
        (["register", "{m}", "--noise-bound", "inf"], "noise_bound contains inf"),
        (["register", "{m}", "--noise-bound", "-1"], "noise_bound contains -1"),
        (
            ["register", "{m}", "--noise-bound", "1", "--scale", "big"],
            "neither a number nor the word estimate",
        ),
        (["register", "{m}", "--noise-bound", "1", "--scale", "0"], "scale is 0"),
        (["register", "{m}", "--noise-bound", "1", "--cbar2", "nan"], "cbar2 is nan"),
        (["register", "{m}", "--noise-bound", "1", "--clique", "big"], "invalid choice: 'big'"),
        (["register", "{m}", "--noise-bound", "1", "-o", "{d}"], "is a folder: name a file to write"),
        (["register", "{m}", "--noise-bound", "1", "-o", "{d}/no/T.txt"], "does not exist: make it first"),
        (["register", "{m}", "--noise-bound", "1", "-o", "{m}"], "is a file that is read"),
        (["register", "{m}", "--noise-bound", "1", "--plot", "{d}/p.bmp2"], "end the name in one of .png"),
        (["register", "{m}", "--noise-bound", "1", "--plot", "{d}/p.pgf"], "end the name in one of .png"),
        (["register", "{m}", "--noise-bound", "1", "--plot", "-"], "name a file"),
        (["register", "{m}", "--noise-bound", "1", "-o", "-"], "name a file"),
        (["register", "{m}", "--noise-bound", "1", "-o", "x" * 300], "cannot be written: File name too long"),
        (["register", "{d}", "--noise-bound", "1"], "is a folder: name the file of matches in it"),
        (["register", "{m}", "--noise-bound", "1", "-o", "{null}"], "is no ordinary file"),
        (
            ["register", "{m}", "--noise-bound", "1", "-o", "{d}/a.png", "--plot", "{d}/a.png"],
            "name two files",
        ),
        (
            ["register", "{m}", "--noise-bound", "1", "-o", "{d}/a.png", "--plot", "{d}/../{n}/a.png"],
            "name two files",
        ),
        (["register", "{d}/none.npz", "--noise-bound", "1"], "no such file"),
        (["demo", "--plot", "{d}/no/demo.png"], "does not exist: make it first"),
        (["demo", "--plot", "demo.pgf"], "end the name in one of .png"),
        (["demo", "--seed", "-1"], "-1 is no seed"),
        (["register", "{m}", "--noise", "1"], "unrecognized arguments: --noise"),  # a shortened option
        (["demo", "--pl=x.png"], "unrecognized arguments: --pl"),
    ],
)
def test_bad_arguments(matches, tmp_path, capsys, arguments, message):
    filled = [a.format(m=matches, d=tmp_path, n=tmp_path.name, null=os.devnull) for a in arguments]
    assert message in bad_input(capsys, *filled)
    assert matches.exists()


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (dict(src=np.zeros((5, 3)), dst=np.zeros((4, 3))), "src has 5 rows and dst has 4"),
        (dict(src=np.zeros((3, 5)), dst=np.zeros((3, 5))), "points are rows"),
        (dict(src=np.zeros((0, 3)), dst=np.zeros((0, 3))), "empty"),
        (dict(src=np.array(["a"]), dst=np.array(["b"])), "src"),
        (dict(src=np.full((5, 3), np.nan), dst=np.zeros((5, 3))), "no row of src and dst is finite"),
        (dict(src=np.zeros((5, 3)), dst=np.zeros((5, 3)), mask=np.ones(4, bool)), "mask has shape (4,)"),
        (dict(src=np.zeros((5, 3)), dst=np.zeros((5, 3)), cbar2=-1.0), "cbar2 is -1"),
    ],
)
def test_bad_arrays(tmp_path, capsys, arrays, message):
    path = tmp_path / "m.npz"
    np.savez(path, **arrays)
    assert message in bad_input(capsys, "register", path, "--noise-bound", 1)


NUMBERS = hnp.arrays(
    st.sampled_from([np.float64, np.float32, np.int32, np.uint8, np.bool_, np.complex64]),
    hnp.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=5)
    | st.tuples(st.integers(0, 20), st.just(3)),
)


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(src=NUMBERS, dst=NUMBERS, bound=st.floats(width=32))
def test_any_arrays_end_in_an_exit_code(tmp_path, capsys, src, dst, bound):
    path = tmp_path / "any.npz"
    np.savez(path, src=src, dst=dst)
    code = cli.main(["register", str(path), "--json", f"--noise-bound={bound}"])
    out, err = capsys.readouterr()
    if code == 2:
        assert out == ""
        assert len(err.splitlines()) == 1
    else:
        assert strictly(out)["ok"] is (code == 0)


class OfNumpy(MemoryError):
    """numpy raises a kind of its own, which says how much and not what to do."""


@pytest.mark.parametrize(
    ("error", "message"),
    [
        (MemoryError(), "32 matches need more memory"),
        (MemoryError("pass pairs="), "pass pairs="),
        (OfNumpy("Unable to allocate 9 GiB"), "32 matches need more memory"),
    ],
)
def test_memory_runs_out(matches, capsys, monkeypatch, error, message):
    def register(*_, **__):
        raise error

    monkeypatch.setattr(tj, "register", register)
    assert message in bad_input(capsys, "register", matches, "--noise-bound", 1)


def test_a_bug_is_not_called_bad_input(matches, monkeypatch):
    def register(*_, **__):
        raise RuntimeError("a bug")

    monkeypatch.setattr(tj, "register", register)
    with pytest.raises(RuntimeError, match="a bug"):
        cli.main(["register", str(matches), "--noise-bound", "1"])


@pytest.mark.long
def test_demo(tmp_path, small, capsys, monkeypatch):
    monkeypatch.setattr(tj.synthetic, "random_problem", lambda seed: small)
    path = tmp_path / "demo.png"
    assert cli.main(["demo", "matches", "--plot", str(path)]) == 0
    out, err = capsys.readouterr()
    for part in (
        "32 matches, 16 of them wrong",
        "ok: OK",
        "proved maximum",
        "refinement",
        f"Picture: {path}",
    ):
        assert part in out
    assert err == ""
    assert path.read_bytes().startswith(b"\x89PNG")


def test_demo_without_matplotlib_leaves_the_picture_out(tmp_path, small, capsys, monkeypatch):
    monkeypatch.setattr(tj.synthetic, "random_problem", lambda seed: small)
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert cli.main(["demo", "matches", "--plot", str(tmp_path / "demo.png")]) == 0
    assert "teaser-jax[viz]" in capsys.readouterr().err


def test_the_choices_are_those_of_the_settings():
    from teaser_jax.cli import arguments

    assert tuple(tj.settings.CLIQUES) == arguments.CLIQUES
    assert tuple(tj.settings.ROTATIONS) == arguments.ROTATIONS
    assert get_args(tj.settings.TimGraph) == arguments.TIM_GRAPHS
    assert get_args(tj.settings.Criterion) == arguments.VOTES


def test_version_and_help(capsys):
    for arguments, text in ((["--version"], tj.__version__), (["register", "--help"], "--noise-bound")):
        with pytest.raises(SystemExit, match="0"):
            cli.main(arguments)
        assert text in capsys.readouterr().out


@pytest.mark.long
def test_as_a_program(tmp_path):
    path = tmp_path / "broken.npz"
    path.write_bytes(b"PK\x03\x04")
    command = [sys.executable, "-m", "teaser_jax", "register", str(path), "--noise-bound", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stdout == ""
    assert len(done.stderr.splitlines()) == 1
    assert "is no .npz archive" in done.stderr


@pytest.mark.long
def test_a_real_pair(data_dir, capsys):
    path = data_dir / "kitti_fpfh" / "080.npz"
    if not path.exists():
        pytest.skip("real data: no KITTI pairs there")
    assert cli.main(["register", str(path), "--noise-bound", "0.6", "--json"]) == 0
    error = strictly(capsys.readouterr().out)["error"]
    assert error["rotation_deg"] < 5
    assert error["translation"] < 0.6


@pytest.mark.long
def test_every_setting_of_the_search_has_an_option(matches, small, capsys):
    options = ["--clique-seconds", "5", "--clique-nodes", "1000", "--tim-graph", "complete", "--no-refine"]
    assert (
        cli.main(["register", str(matches), "--noise-bound", str(small.noise_bound), "--json", *options]) == 0
    )
    found = json.loads(capsys.readouterr().out)
    chosen = tj.Settings(
        clique=tj.settings.ExactClique(seconds=5.0, nodes=1000), tim_graph="complete", refine=False
    )
    expected = tj.register(small.src, small.dst, noise_bound=small.noise_bound, settings=chosen)
    np.testing.assert_allclose(found["pose"]["T_dst_src"], expected.pose.matrix, atol=1e-12)
    known = ["register", matches, "--noise-bound", small.noise_bound]
    assert "--clique greedy has no budget" in bad_input(
        capsys, *known, "--clique", "greedy", "--clique-seconds", 1
    )
    assert "ExactClique.seconds is -1.0: expected 0 or more" in bad_input(
        capsys, *known, "--clique-seconds", -1
    )
