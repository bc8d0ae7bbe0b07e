"""Pictures: drawn for every answer, without touching anything global."""

from __future__ import annotations

import io
import sys
from dataclasses import replace

import jax.numpy as jnp
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.collections import PathCollection

import teaser_jax as tj
from teaser_jax import plots
from teaser_jax.ground import bits


def drawn(figure) -> np.ndarray:
    """The pixels, which must not be all white."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=40)
    buffer.seek(0)
    pixels = mpl.image.imread(buffer, format="png")
    assert (pixels[..., :3].min(axis=-1) < 0.9).mean() > 0.005
    return pixels


@pytest.fixture(autouse=True)
def nothing_global_changes():
    before = dict(mpl.rcParams)
    yield
    assert dict(mpl.rcParams) == before
    assert "matplotlib.pyplot" not in sys.modules or not sys.modules["matplotlib.pyplot"].get_fignums()


def test_an_answer(small, solved):
    figure = plots.plot_registration(small.src, small.dst, solved)
    before, after = figure.axes
    assert before.get_title() == "Before: 32 matches"
    assert after.get_title() == "After: 16 inliers, OK"
    drawn(figure)


def test_a_failed_answer_says_so_in_red(small, solved):
    failed = replace(solved, status=tj.Status.NO_CONSENSUS, inliers=np.zeros(32, bool))
    after = plots.plot_registration(small.src, small.dst, failed).axes[1]
    assert after.get_title() == "After: 0 inliers, NO_CONSENSUS"
    assert after.title.get_color() == plots.BAD


def test_the_picture_does_not_depend_on_where_the_clouds_are(small, solved):
    # Far from the origin only the digits that float64 has left may differ.
    origin = np.array([1e6, -2e6, 3e6])
    pose = solved.pose
    translation = pose.translation + 2 * origin - pose.scale * pose.rotation @ origin
    moved = replace(solved, pose=tj.Pose(pose.rotation, translation, pose.scale))
    near = drawn(plots.plot_registration(small.src, small.dst, solved))
    far = drawn(plots.plot_registration(small.src + origin, small.dst + 2 * origin, moved))
    assert np.abs(near - far).mean() < 1e-3


@pytest.mark.parametrize("rows", [0, 1])
def test_hardly_any_finite_rows(small, solved, rows):
    src = small.src.copy()
    src[rows:] = np.nan
    before, after = plots.plot_registration(src, small.dst, solved).axes
    right = int(solved.inliers[:rows].sum())
    assert before.get_title() == f"Before: {rows} matches"
    assert after.get_title() == f"After: {right} {'inlier' if right == 1 else 'inliers'}, OK"
    # Both clouds and the inliers: nothing but the finite rows, in a window of some size.
    for axes in (before, after):
        clouds = [np.asarray(x.get_offsets()) for x in axes.collections if isinstance(x, PathCollection)]
        assert [len(points) for points in clouds] == [rows, rows, right]
        assert all(np.isfinite(points).all() for points in clouds)
        for low, high in (axes.get_xlim(), axes.get_ylim()):
            assert -np.inf < low < high < np.inf
    drawn(before.figure)


@pytest.mark.long
def test_every_stage(small, solved):
    selection = solved.solution.selection
    edges = np.array(small.inliers[:, None] & small.inliers & ~np.eye(32, dtype=bool))
    edges[0, 1] = edges[1, 0] = True
    edge_bits = np.asarray(bits.pack(jnp.asarray(edges)))
    r2 = np.random.default_rng(0).chisquare(3, size=32)
    offsets = small.dst - solved.pose.apply(small.src) + solved.pose.translation
    for figure in (
        plots.plot_trims(r2, np.full(32, 0.1), 1.0, truth=1.1),
        plots.plot_graph(edge_bits, selection.clique),
        plots.plot_clique(edge_bits, selection.clique),
        plots.plot_residuals(r2, r2 < 1),
        plots.plot_translation(offsets, np.full(32, 0.1), selection.translation, solved.pose.translation),
        plots.plot_refinement(r2, 0.9 * r2),
    ):
        drawn(figure)


@pytest.mark.long
def test_stages_with_nothing_to_show():
    none = np.zeros(0)
    figures = (
        plots.plot_trims(none, none, 1.0),
        plots.plot_residuals(none, none.astype(bool)),
        plots.plot_translation(none.reshape(0, 3), none, none.reshape(0, 3).astype(bool), np.zeros(3)),
        plots.plot_refinement(none, none),
        plots.plot_graph(np.zeros((4, 1), np.uint32), np.zeros(4, bool)),
        plots.plot_clique(np.zeros((4, 1), np.uint32), np.zeros(4, bool)),
    )
    for figure in figures:
        figure.savefig(io.BytesIO(), format="png", dpi=40)


def test_residuals_without_a_number_are_beyond_all():
    figure = plots.plot_residuals(np.array([0.1, 0.2, np.nan, np.inf]), np.array([True, True, False, False]))
    heights = [bar.get_height() for bar in figure.axes[0].patches]
    assert heights[59] == 0  # nothing kept in the last bar
    assert heights[119] == 2
    drawn(figure)


def test_without_matplotlib_the_extra_is_named(monkeypatch, small, solved):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ImportError, match=r"teaser-jax\[viz\]"):
        plots.plot_registration(small.src, small.dst, solved)


def test_the_cost_and_its_bound(solved):
    keep = solved.inliers | solved.solution.selection.clique
    p = solved.problem
    src, dst = (x[keep] - x[solved.inliers].mean(axis=0) for x in (p.src, p.dst))
    figure = plots.plot_landscape(src, dst, solved.certificate, noise_bound=p.noise_bound[keep])
    whole, close = figure.axes
    assert whole.get_title() == "Every rotation: OPTIMAL"
    lowest = min(np.min(line.get_ydata()) for line in whole.lines)
    assert lowest >= float(solved.certificate.lower_bound) - 1e-9
    drawn(figure)


@pytest.mark.long
def test_certified_answers_and_error_bounds():
    figure = plots.plot_certified({"right": (3, 4), "wrong": (0, 0)})
    assert [t.get_text() for t in figure.axes[0].texts] == ["3 of 4", "0 of 0"]
    drawn(figure)
    true, bounds = np.array([0.1, 0.2, 0.0]), np.array([1.0, 3.0, np.inf])
    drawn(plots.plot_bounds({"whole set": (true, bounds), "paper": (true, 10 * bounds)}))
    drawn(plots.plot_bounds({}))


@pytest.mark.long
def test_slopes_errors_and_training_are_drawn():
    rng = np.random.default_rng(0)
    residuals = rng.uniform(0, 3, 40)
    figure = plots.plot_slopes(residuals, residuals * 0, residuals, np.clip(1.5 - residuals, 0, 1))
    assert len(figure.axes) == 2
    drawn(figure)
    covariance = np.diag([1.0, 4, 9, 1, 4, 9])
    errors = rng.multivariate_normal(np.zeros(6), covariance, 4000)
    figure = plots.plot_errors(errors, covariance)
    shares = [float(axes.get_title().split(": ")[1].split(" %")[0]) for axes in figure.axes]
    np.testing.assert_allclose(shares, 95, atol=1.5)
    drawn(figure)
    for unknown in (np.full((6, 6), np.inf), np.zeros((6, 6))):
        with pytest.raises(ValueError, match="not ok"):
            plots.plot_errors(errors, unknown)
    trusted = rng.random((50, 4)) < 0.5
    history = tj.learn.History(rng.random(50), trusted, np.where(trusted, 0.0, 1.0))
    figure = plots.plot_training({"one": history, "other": history})
    assert [len(axes.lines) for axes in figure.axes] == [2, 2, 2]
    np.testing.assert_allclose(figure.axes[2].lines[0].get_ydata()[10:], 1)
    drawn(figure)
