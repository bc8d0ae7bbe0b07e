"""The machinery of the benchmarks: what counts as worse than the baseline, and processes of their own."""

from __future__ import annotations

import os
import time
from functools import partial

import pytest

from benchmarks import baseline
from benchmarks.baseline import Metric
from benchmarks.crew import Crew
from benchmarks.processes import forget_peak, in_child, peak_megabytes
from teaser_jax.studies.peers import Question

pytestmark = pytest.mark.skipif(
    not os.path.exists("/proc/self/clear_refs"), reason="benchmarks measure on Linux"
)

HERE = {"device": "cpu:0", "processor": "this one", "cores": "2", "date": "2026-01-01"}
THERE = HERE | {"processor": "another"}


def speed(milliseconds: float) -> Metric:
    return Metric("time", milliseconds, "ms", "lower", 0.5, portable=False)


def success(share: float) -> Metric:
    return Metric("right", share, "share", "higher", 0.0)


@pytest.fixture
def kept(tmp_path, monkeypatch):
    monkeypatch.setattr(baseline, "BASELINE", tmp_path / "baseline.json")
    baseline.update("speed", [speed(10.0), success(1.0)], HERE)


@pytest.mark.parametrize(
    ("metrics", "where", "worse"),
    [
        ([speed(14.9), success(1.0)], HERE, 0),
        ([speed(15.1), success(1.0)], HERE, 1),
        ([speed(1.0), success(0.99)], HERE, 1),
        ([speed(99.0), success(0.0)], HERE, 2),
        ([speed(99.0), success(1.0)], THERE, 0),  # times of another machine say nothing
        ([speed(99.0), success(0.9)], THERE, 1),
    ],
)
def test_worse_than_its_tolerance_allows(kept, metrics, where, worse):
    said, count = baseline.compare("speed", metrics, where)
    assert count == worse
    assert said.count("- worse: ") == worse


def test_a_metric_that_is_gone_is_named(kept):
    assert "not measured: right" in baseline.compare("speed", [speed(1.0)], HERE)[0]


def test_without_a_baseline_nothing_is_worse(kept):
    assert baseline.compare("accuracy", [success(0.0)], HERE) == ("No baseline.", 0)


def cores_and_caches(name: str) -> list:
    return [len(os.sched_getaffinity(0)), os.environ.get("NUMBA_CACHE_DIR"), name]


def sleep(how_long: float) -> None:
    time.sleep(how_long)


@pytest.mark.long
def test_a_child_has_its_own_cores_and_nobodys_cache(monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", "of the parent")
    monkeypatch.setenv("PYTHONPATH", os.path.dirname(__file__))
    assert in_child(cores_and_caches, cores=1, name="a") == [1, None, "a"]
    kept = in_child(cores_and_caches, cores=1, variables={"NUMBA_CACHE_DIR": "own"}, name="b")
    assert kept == [1, "own", "b"]


@pytest.mark.long
def test_a_child_that_takes_too_long_has_no_result(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.path.dirname(__file__))
    assert in_child(sleep, seconds=1.0, how_long=60.0) is None


def test_the_peak_counts_from_when_it_was_forgotten():
    forget_peak()
    before = peak_megabytes()
    held = bytearray(64 << 20)
    held[::4096] = b"x" * len(held[::4096])
    assert peak_megabytes() - before > 48
    del held
    forget_peak()
    assert peak_megabytes() - before < 32


def ask_to_sleep(how_long: float) -> Question:
    time.sleep(0.5)  # making a question costs nothing
    answer = (how_long, os.getpid(), os.environ["OMP_NUM_THREADS"])
    return Question(partial(time.sleep, how_long), lambda _: answer)


@pytest.mark.long
def test_a_crew_is_timed_inside_its_processes(monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    with Crew(ask_to_sleep, processes=2) as crew:
        answers = crew.take([0.05, 0.2, 0.1])
        assert [a[0] for a in answers] == [0.05, 0.2, 0.1]
        assert len({answers[0][1], answers[1][1], os.getpid()}) == 3
        assert answers[0][1] == answers[2][1]
        assert {a[2] for a in answers} == {"1"}
        assert 0.2 <= min(crew.seconds() for _ in range(3)) < 0.3
        assert crew.take([0.01])[0][0] == 0.01  # in place of those before
        assert crew.seconds() < 0.1
    assert os.environ["OMP_NUM_THREADS"] == "7"
