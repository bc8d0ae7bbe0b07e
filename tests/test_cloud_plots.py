"""Pictures and pages of answers to two clouds: drawn for every kind, and turned in a browser."""

from __future__ import annotations

import io
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import matplotlib as mpl
import numpy as np
import pytest
from browser import find_browser, page
from cloud_scenes import ROOM, on_faces, terrain
from oracles import random_pose

import teaser_jax as tj
from teaser_jax import plots
from teaser_jax.cli.places import draw_clouds, write_page, writing
from teaser_jax.plots.scene import principal_axes, scene_of, thinned

pytest.importorskip("small_gicp", reason="needs the extra clouds")
pytest.importorskip("plotly", reason="needs the extra viz")

SRC, DST = terrain(0, 8000, 0, 20), terrain(1, 8000, 4, 24)
TRUE = random_pose(np.random.default_rng(3)).inverse()  # of the source as it is moved here
MOVED = TRUE.inverse().apply(SRC)
HOSTILE = "</title></script><script>document.body.innerHTML = ''</script> & <b>\"'"


@pytest.fixture(scope="module")
def answers() -> dict[str, tj.CloudRegistration]:
    """An answer of each kind."""
    right = tj.register_clouds(MOVED, DST)
    far = tj.Pose(TRUE.rotation, TRUE.translation + [9.0, 0, 0], 1.0)
    room = on_faces(0, 8000, ROOM), on_faces(1, 8000, ROOM)
    found = {
        "ok": right,
        "not ok": tj.register_clouds(MOVED, DST, initial=far, initial_error=0.5),
        "ambiguous": tj.register_clouds(*room, initial=np.eye(4)),
        "no pose": replace(
            right, pose=tj.Pose(np.eye(3), np.zeros(3), np.float64(1)), status=tj.Status.NO_CONSENSUS,
            doubt="matches", evidence=None, candidates=(), equivalent=(),
        ),
    }  # fmt: skip
    assert [x.ok for x in found.values()] == [True, False, False, False]
    assert found["ambiguous"].status == tj.Status.AMBIGUOUS
    assert len(found["ambiguous"].equivalent) >= 3
    return found


def pixels(figure) -> np.ndarray:
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=40)
    buffer.seek(0)
    return mpl.image.imread(buffer, format="png")[..., :3]


KINDS = ("ok", "not ok", "ambiguous", "no pose")


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_answer_has_its_picture(answers, kind: str):
    result = answers[kind]
    figure = tj.plot(result)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    expected = ["Before"]
    if kind != "no pose":
        rivals = range(1, 1 + min(3, len(result.equivalent)))
        expected += ["After, from above", "After, from the side", *(f"Other pose {k} of" for k in rivals)]
    assert len(titles) == len(expected)
    assert all(title.startswith(x) for title, x in zip(titles, expected, strict=True))
    assert (pixels(figure).min(axis=-1) < 0.9).mean() > 0.005
    words = " ".join(figure.get_suptitle().split())
    assert words.startswith("ok: points of the overlap are off by" if result.ok else "NOT OK, ")
    assert result.ok or result.advice in words


def test_the_same_answer_has_the_same_picture(answers):
    np.testing.assert_array_equal(pixels(tj.plot(answers["ok"])), pixels(tj.plot(answers["ok"])))


def test_one_name_draws_both_kinds_of_answers(small, solved):
    ours, theirs = tj.plot(solved), plots.plot_registration(small.src, small.dst, solved)
    np.testing.assert_array_equal(pixels(ours), pixels(theirs))
    assert tj.plot(solved, small.src, small.dst).axes[1].get_title() == "After: 16 inliers, OK"


def test_other_points_of_the_same_frames_can_be_drawn(answers):
    result = answers["ok"]
    few = scene_of(result, 10**6, MOVED[::4], DST[::4])
    middle = np.median(DST[::4], axis=0)
    np.testing.assert_allclose(few.target, DST[::4] - middle, atol=1e-9)
    np.testing.assert_allclose(few.after.points, result.pose.apply(MOVED[::4]) - middle, atol=1e-9)
    assert len(tj.plot(result, MOVED[::4], DST[::4]).axes) >= 3


def test_distances_are_those_to_the_nearest_point_of_the_target(answers):
    result = answers["ok"]
    scene = scene_of(result, 10**6)
    apart = np.linalg.norm(scene.after.points[:50, None] - scene.target[None], axis=2).min(axis=1)
    near = apart < 3 * result.voxel_size
    np.testing.assert_array_equal(scene.after.paired[:50], near)
    np.testing.assert_allclose(scene.after.distance[:50][near], apart[near], rtol=1e-9)
    # The source lies where the pose puts it, and before it stands beside the target, in its own directions.
    there = result.pose.apply(result.src.points + result.src.origin) - result.dst.origin
    np.testing.assert_allclose(scene.after.points, there, atol=1e-9)
    np.testing.assert_allclose(np.ptp(scene.before - result.src.points, axis=0), 0, atol=1e-9)
    assert (scene.before @ scene.axes[0]).mean() < (scene.target @ scene.axes[0]).mean()


def test_right_matches_end_where_their_points_are(answers):
    result = answers["ok"]
    scene = scene_of(result, 10**6)
    src, dst, inliers = scene.matches
    moved = (src - (scene.before[0] - result.src.points[0])) @ result.pose.rotation.T
    off = moved[inliers] - dst[inliers]
    assert np.median(np.linalg.norm(off - np.median(off, axis=0), axis=1)) < result.voxel_size


def test_thinning_leaves_no_part_bare():
    rng = np.random.default_rng(0)
    dense, sparse = rng.uniform(0, 1, (20_000, 3)), rng.uniform(5, 9, (100, 3))
    kept = thinned(np.concatenate([dense, sparse]), 1000)
    assert 800 < len(kept) <= 1000
    assert (kept[:, 0] > 5).sum() > 50
    assert thinned(dense, 20_000) is dense


def test_the_longest_axis_points_right():
    points = np.random.default_rng(0).normal(size=(500, 3)) * [1, 9, 3]
    right, back, up = principal_axes(points)
    np.testing.assert_allclose([right @ [0, 1, 0], back @ [0, 0, 1], up @ [1, 0, 0]], 1, atol=0.05)
    assert np.linalg.det([right, back, up]) > 0


class Reader(HTMLParser):
    """The words, the tags and the addresses of a page."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags, self.addresses, self.words, self.buttons = [], [], "", []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        self.tags.append(tag)
        self.addresses += [value for name, value in attributes if name in ("src", "href", "data")]
        if tag == "button":
            self.buttons.append("")

    def handle_data(self, data):
        if self.tags[-1:] not in (["script"], ["style"]):
            self.words += data
        if self.tags[-2:-1] == ["button"] or self.tags[-1:] == ["button"]:
            self.buttons[-1] += data


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_answer_has_its_page(answers, kind: str):
    result = answers[kind]
    text = plots.view(result, title=HOSTILE)
    read = Reader(text)
    assert read.addresses == []  # what it needs is in it
    assert "default-src 'none'" in text
    assert HOSTILE not in text
    assert HOSTILE in read.words
    assert all(line.strip() in read.words for line in repr(result).splitlines())
    layers = ["target", "source before"]
    if result.evidence is not None:
        layers += ["source after", *(f"other pose {k + 1}" for k in range(min(3, len(result.equivalent))))]
    if result.registration is not None:
        layers += ["inliers", "other matches"]
    shown = re.findall(r'data-traces="\[([\d, ]+)\]"', text)
    assert len(shown) == len(layers)
    numbers = [int(number) for traces in shown for number in traces.split(",")]
    assert numbers == list(range(text[text.rindex("Plotly.newPlot(") :].count('"hoverinfo":"skip"')))
    assert all(any(button.strip().startswith(x) for button in read.buttons) for x in layers)
    assert len(text) < 12e6


def test_words_of_the_answer_are_escaped(answers, monkeypatch):
    monkeypatch.setattr(type(answers["ok"]), "__repr__", lambda self: HOSTILE)
    text = plots.view(answers["ok"])
    assert HOSTILE not in text
    assert HOSTILE in Reader(text).words


def test_files_are_written_whole_or_not_at_all(answers, tmp_path: Path, monkeypatch):
    draw_clouds(tmp_path / "a.png", answers["ok"])
    write_page(tmp_path / "a.html", answers["ok"], "A onto B")
    assert "<title>A onto B</title>" in (tmp_path / "a.html").read_text(encoding="utf-8")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert set(before) == {"a.png", "a.html"}
    broken = lambda *_: (_ for _ in ()).throw(RuntimeError("broken"))
    monkeypatch.setattr(Path, "replace", broken)
    with pytest.raises(RuntimeError, match="broken"), writing(tmp_path / "a.png") as partial:
        draw_clouds(partial, answers["not ok"])
    with pytest.raises(RuntimeError, match="broken"):
        plots.write_view(tmp_path / "a.html", answers["not ok"])
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_browser_turns_the_page(answers, tmp_path: Path):
    browser = find_browser()
    if browser is None:
        pytest.skip("needs Chromium: on the path, of playwright, or named by CHROMIUM")
    plots.write_view(tmp_path / "view.html", answers["ambiguous"], title=HOSTILE)
    with page(browser, tmp_path / "profile") as tab:
        tab.open(tmp_path / "view.html")
        first = tab.photograph()
        tab.drag((650, 300), (800, 220))
        turned = tab.photograph()
        tab.run("document.querySelectorAll('[data-traces]')[2].click()")
        tab.rest_a_while()
        without = tab.photograph()
        drawn = tab.run("document.querySelector('#view').data.map(x => x.visible)")
        text = tab.run("document.querySelector('h1').textContent")
        assert tab.errors == []
        assert len(tab.requests) == 1  # for the page itself
    seen = [picture[:, 400:] for picture in (first, turned, without)]  # the drawing, without the words
    for picture in seen:
        assert (picture.min(axis=-1) < 0.8).mean() > 0.01
    assert (np.abs(seen[0] - seen[1]).max(axis=-1) > 0.2).mean() > 0.01
    assert (np.abs(seen[1] - seen[2]).max(axis=-1) > 0.2).mean() > 0.01
    assert drawn[:4] == [True, False, False, False]
    assert text == HOSTILE
