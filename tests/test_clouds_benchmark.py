"""The benchmark of raw clouds: what its scenes are, which answers count as right, and what its rates mean."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from benchmarks.clouds import table
from benchmarks.clouds.cases import CloudPair, pairs
from benchmarks.clouds.methods import Answer, asked, find_methods
from benchmarks.clouds.rates import Rate, Rates, rates
from benchmarks.clouds.scenes import PLAIN, scenes
from teaser_jax import Pose

SCENES = list(scenes())
CLOUD = np.random.default_rng(0).uniform(-1, 1, (500, 3))
TRUTH = Pose(Rotation.from_euler("y", 50, degrees=True).as_matrix(), np.array([1.0, 2, 3]), np.float64(1))
PAIR = CloudPair("cube", "a b", CLOUD, TRUTH.apply(CLOUD), (TRUTH,), 5.0, 0.1, 0.05)


def turned(axis: str, degrees: float) -> Pose:
    """The truth after a turn of the source about one of its axes."""
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return TRUTH @ Pose(turn, np.zeros(3), np.float64(1))


@pytest.mark.parametrize("scene", [x for x in SCENES if x.kind == PLAIN], ids=lambda x: x.name)
def test_plain_scenes_lie_on_themselves_and_share_no_point(scene):
    src, dst = scene.clouds(3)
    distance, _ = cKDTree(dst).query(src[::20])
    spacing = np.median(cKDTree(dst).query(dst[::20], k=2)[0][:, 1])
    assert np.median(distance) < 3 * spacing
    assert (distance > 0).all()
    again = scene.clouds(3)
    np.testing.assert_array_equal(src, again[0])
    assert not np.array_equal(src, scene.clouds(4)[0])


def test_there_are_fifty_scenes_of_every_kind_with_names_of_their_own():
    assert len(SCENES) >= 50
    assert len({scene.name for scene in SCENES}) == len(SCENES)
    assert {scene.kind for scene in SCENES} == {"slide or turn", "repeat", "plain", "noise"}


def test_only_plain_scenes_and_real_pairs_have_an_answer():
    for pair in pairs(quick=True):
        asked_for_nothing = pair.kind in ("another place", "another model", "mirrored", "noise")
        if asked_for_nothing or pair.kind.startswith("scenes that"):
            assert not pair.truths
            assert not pair.is_right(Pose(np.eye(3), np.zeros(3), np.float64(1)))
        else:
            assert all(pair.is_right(truth) for truth in pair.truths)
            assert pair.displacement(pair.truths[0]) == 0
            assert all(len(points) > 50 for points in pair.overlaps)


def test_an_answer_is_right_within_both_limits():
    assert PAIR.is_right(turned("x", 4.9))
    assert not PAIR.is_right(turned("x", 5.1))
    assert not PAIR.is_right(Pose(TRUTH.rotation, TRUTH.translation + [0, 0, 0.11], TRUTH.scale))


def test_a_round_part_may_be_turned_about_its_axis_and_upside_down_only():
    peg = replace(PAIR, axis=np.array([0.0, 1, 0]))
    assert peg.is_right(turned("y", 130))
    assert not peg.is_right(turned("x", 30))
    middle = CLOUD.mean(axis=0)
    upside_down = turned("x", 180)
    held = upside_down.translation + TRUTH.apply(middle[None])[0] - upside_down.apply(middle[None])[0]
    assert peg.is_right(Pose(upside_down.rotation, held, np.float64(1)))
    assert not peg.is_right(Pose(upside_down.rotation, held + [0, 0.2, 0], np.float64(1)))


def test_the_displacement_is_that_of_the_overlap():
    shift = np.array([0.03, 0.0, -0.04])
    assert PAIR.displacement(Pose(TRUTH.rotation, TRUTH.translation + shift, TRUTH.scale)) == pytest.approx(
        0.05
    )
    half = replace(PAIR, dst=PAIR.dst[CLOUD[:, 0] > 0])  # what is not seen twice does not count
    off = Pose(TRUTH.rotation, TRUTH.translation, TRUTH.scale) @ Pose(
        Rotation.from_euler("z", 1, degrees=True).as_matrix(), np.zeros(3), np.float64(1)
    )
    seen = half.overlaps[0]
    assert seen[:, 0].min() > -0.2
    assert half.displacement(off) == pytest.approx(
        np.linalg.norm(off.apply(seen) - TRUTH.apply(seen), axis=1).mean()
    )


def row(**known) -> dict:
    usual = dict(
        part="asked", method="ours", kind="a", says_ok=True, right_or_equivalent=0, displacement=None
    )
    more = dict(ok_beyond_two_voxels=0, statuses={"OK": 1}, status_right=0, wrong_ok=[], seconds=[2.0, 3.0])
    return {**usual, **more, **known}


ROWS = [
    row(pairs=10, answers=10, right=8, right_or_equivalent=9, ok=7, ok_right=6, displacement=[0.01, 0.02]),
    row(kind="none", pairs=20, answers=0, right=0, ok=1, ok_right=0, status_right=19, wrong_ok=["x y"]),
    {"part": "missing", "package": "open3d", "why": "no libusb"},
]


def test_rates_count_answers_and_pairs_without_one_apart():
    known = rates(ROWS[:2])
    assert known == Rates(Rate(8, 10), Rate(6, 8), Rate(1, 2), Rate(1, 20))


def test_the_precision_is_bayes_rule():
    known = Rates(found=Rate(8, 10), right=Rate(9, 10), wrong=Rate(1, 10), none=Rate(1, 50))
    good, bad = 0.5 * 0.8 * 0.9, 0.5 * 0.2 * 0.1 + 0.5 * 0.02
    assert known.precision(0.5) == pytest.approx(good / (good + bad))
    assert known.least_precision(0.5) < known.precision(0.5)
    assert known.precision(0.9) > known.precision(0.5) > known.precision(0.05)


def test_limits_hold_as_often_as_they_say():
    assert Rate(0, 46).high == pytest.approx(1 - 0.05 ** (1 / 46))  # of nothing in n
    assert Rate(187, 187).low == pytest.approx(0.05 ** (1 / 187))
    assert Rate(0, 0) == (0, 0)
    assert (Rate(0, 0).low, Rate(0, 0).high) == (0.0, 1.0)


def test_the_report_says_what_was_counted():
    text = table.report(ROWS)
    assert "Left out: open3d (no libusb)." in text
    assert "| a | 8 / 9 of 10 (6 + 1) |" in text
    assert "6 of 8, above" in text
    assert "| a | 3.0 |" in text
    assert "| none | 1 of 20 |" in text
    assert "Wrong and ok by ours: x y." not in text  # it is not ours
    assert "Wrong and ok by ours: x y." in table.report([{**r, "method": "teaser_jax"} for r in ROWS])


def test_a_run_that_ended_goes_on_and_then_forgets(tmp_path, monkeypatch):
    calls = []

    def turns(pair: CloudPair) -> Answer:
        calls.append(pair.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return Answer(TRUTH, True, "OK", (turned("x", 180),), 0.1, {"all": 1.0}, 1.0, 2.0)

    several = [replace(PAIR, name=name) for name in "ab"] + [replace(PAIR, kind="none", name="c", truths=())]
    monkeypatch.setattr(table, "RESULTS", tmp_path / "results")
    monkeypatch.setattr(table, "find_methods", lambda: ({"teaser_jax": turns, "Open3D FGR": fails}, {}))
    monkeypatch.setattr(table, "pairs", lambda quick: several)
    monkeypatch.setattr(table, "timed", lambda quick: [])
    with pytest.raises(KeyboardInterrupt):
        table.run(quick=False)
    rows = {(r["kind"], r["method"]): r for r in table.run(quick=False)}
    assert calls == ["a", "b", "b", "c"]
    assert (rows["cube", "teaser_jax"]["right"], rows["cube", "teaser_jax"]["ok_right"]) == (2, 2)
    assert rows["cube", "Open3D FGR"]["right"] == 0
    assert ("none", "Open3D FGR") not in rows  # it never says ok
    assert rows["none", "teaser_jax"]["wrong_ok"] == ["c"]
    assert not list(tmp_path.rglob("*.jsonl"))


def fails(pair: CloudPair) -> Answer:
    raise RuntimeError("no keypoints")


def test_an_answer_is_kept_as_it_is():
    said = Answer(TRUTH, None, "OK", (turned("x", 180),), np.nan, {"all": 1.0}, 1.0, 2.0)
    again = Answer.of_row(json.loads(json.dumps(said.as_row())))
    np.testing.assert_array_equal(again.pose.matrix, said.pose.matrix)
    np.testing.assert_array_equal(again.others[0].matrix, said.others[0].matrix)
    assert (again.ok, again.status, again.seconds, again.cpu) == (None, "OK", {"all": 1.0}, 2.0)
    assert Answer.of_row(asked(fails, PAIR).as_row()).pose is None


def test_a_method_that_fails_has_no_answer():
    said = asked(fails, PAIR)
    assert (said.pose, said.ok, said.status) == (None, False, "RuntimeError")
    counted = table._row("cube", "fails", [(PAIR, said)])
    assert (counted["right"], counted["ok"], counted["seconds"]) == (0, 0, None)


@pytest.mark.long
@pytest.mark.parametrize("name", [name for name in find_methods()[0] if name != "teaser_jax"])
def test_a_peer_finds_hills_and_tells_the_time_of_its_stages(name):
    src, dst = next(scene for scene in SCENES if scene.name.startswith("hills")).clouds(0)
    src, dst = (x[::4] - [14, 10, 9] for x in (src, dst))  # both seen from above the middle
    turn = Pose(TRUTH.rotation, np.zeros(3), np.float64(1))
    pair = CloudPair(
        "hills", "", turn.inverse().apply(src), dst, (turn,), 5.0, 0.5, 0.5, seen_from_origin=True
    )
    said = find_methods()[0][name](pair)
    assert pair.is_right(said.pose)
    assert set(said.seconds) >= {"cells", "descriptors", "solving"}
    assert 0 < sum(said.seconds.values()) < 2 * said.wall
