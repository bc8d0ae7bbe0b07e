"""The made-up places that the verdict is fitted on, and how its limits are chosen by folds."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from benchmarks.clouds.scenes import box
from benchmarks.verdict.__main__ import rates, report
from benchmarks.verdict.casting import camera, lidar, scan
from benchmarks.verdict.folds import LOOSE, by_folds, fitted, is_ok
from benchmarks.verdict.pairs import pairs
from benchmarks.verdict.places import KINDS, SCANS, places
from benchmarks.verdict.record import record
from teaser_jax.clouds.trust.judge import LIMITS

STILL = np.random.default_rng(0)


def test_rays_end_on_the_first_face_they_meet():
    eye = np.array([0.5, 0.2, 1.0])
    seen = scan(box([0, 0, 0], [4, 3, 2.5]) + box([1.5, 0, 0], [0.4, 0.4, 2]), eye, lidar(), 0.0, STILL) + eye
    faces = np.abs(seen / [2, 1.5, 1]).round(6)
    on_walls = (faces[:, 0] == 1) | (faces[:, 1] == 1) | np.isin(seen[:, 2].round(6), [0, 2.5])
    pillar = np.all(np.abs(seen[:, :2] - [1.5, 0]) < 0.2 + 1e-6, axis=1)
    assert len(seen) == len(lidar())  # no ray leaves a closed room
    assert np.all(on_walls | pillar)
    assert 0.01 < np.mean(pillar & ~on_walls) < 0.2
    behind = np.all([seen[:, 0] > 1.71, np.abs(seen[:, 1]) < 0.05, seen[:, 2] < 1.5], axis=0)
    assert not np.any(behind & ~pillar)


def test_a_camera_looks_ahead_and_up():
    level, tilted = camera(0.0, 0.0).mean(axis=0), camera(np.pi / 2, 0.4).mean(axis=0)
    assert level[0] > 0.5
    assert np.allclose(level[1:], 0, atol=1e-9)
    assert tilted[1] > 0.5
    assert tilted[2] > 0.2


def test_every_place_is_seen_three_times_and_truths_lay_scans_on_one_another():
    assert [place.kind for place in places(1)] == list(KINDS)
    found = list(pairs(2))
    assert len(found) == len(KINDS) * (2 * SCANS + 1)
    assert sum(pair.truth is None for pair in found) == len(KINDS)
    first = {}
    for pair in found:
        if pair.truth is not None:
            first.setdefault(pair.kind, pair)
    for pair in first.values():
        assert len(pair.overlap(0.1)) > 0
        assert pair.displacement(pair.truth, 0.2) == 0
        moved = pair.truth.apply(pair.src_viewpoint[None]) - pair.dst_viewpoint
        assert 0 < np.linalg.norm(moved) < 60
    assert all(
        pair.displacement(pair.truth or found[0].truth, 0.2) == np.inf for pair in found if not pair.truth
    )


def _row(place: str, own: float, right: bool, answer: bool = True) -> dict:
    evidence = dict(
        cells=2000, fit=0.6, fine_fit=0.5, overlap=0.5, support=0.3, in_front=None, visible=[0.1] * 6,
        equal=1 - own / 0.6, rival_fit=0.2, lead=0.0, against=1.0, beyond_planes=0.2,
    )  # fmt: skip
    evidence["in_front"] = np.nan
    return dict(kind="room", place=place, right=right, answer=answer, evidence=evidence)


def test_limits_are_chosen_so_that_no_wrong_answer_is_ok():
    rows = [_row(f"room {k}", 0.30, True) for k in range(20)] + [
        _row(f"room {k}", 0.17, False) for k in range(20)
    ]
    assert all(is_ok(row, LOOSE) for row in rows)
    best = fitted(rows)
    assert 0.17 < best.own <= 0.26 or best.equal < 1 - 0.17 / 0.6
    assert [is_ok(row, best) for row in rows] == [row["right"] for row in rows]
    assert by_folds(rows) == [row["right"] for row in rows]
    counted = rates(rows, by_folds(rows))
    assert (counted.right.hits, counted.wrong.hits, counted.wrong.of, counted.none.of) == (20, 0, 20, 0)
    written = report(rows, 10)
    assert "| all | 10 of 20 | 10 of 10 (> 74%) | 0 of 10 (< 26%)" in written
    assert written.count("\n## ") == 3


def test_a_row_without_evidence_is_not_ok():
    assert not is_ok(dict(evidence=None), LIMITS)


def test_a_run_goes_on_where_it_ended(tmp_path, monkeypatch):
    asked = []
    monkeypatch.setattr("benchmarks.verdict.record.pairs", lambda count: [_Named("a"), _Named("b")][:count])
    monkeypatch.setattr(
        "benchmarks.verdict.record._row",
        lambda pair, viewpoints: asked.append(pair.name) or {"name": pair.name},
    )
    path = tmp_path / "rows.jsonl"
    assert record(path, 1, viewpoints=False) == [{"name": "a"}]
    assert record(path, 2, viewpoints=False) == [{"name": "a"}, {"name": "b"}]
    assert asked == ["a", "b"]


class _Named:
    def __init__(self, name: str) -> None:
        self.name = name
