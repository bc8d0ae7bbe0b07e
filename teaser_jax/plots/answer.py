"""The picture of an answer: both clouds before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from teaser_jax.plots.style import (
    BAD,
    DST,
    GOOD,
    INK,
    PALE,
    SRC,
    Axes,
    Figure,
    legend,
    new_figure,
    segments,
    without_spines,
)
from teaser_jax.register import Registration

PANEL_SHAPE = 1.3  # width by height


def plot_registration(
    src: Any, dst: Any, result: Registration, *, lines: int = 250, view: tuple[float, float] | None = None
) -> Figure:
    """Draw both clouds before and after: side by side with a sample of the matches, and aligned.

    Right matches are green lines, rejected ones pale. Both panels look at the points along the same
    direction, without perspective. The second shows the target moved back onto the source, ``T_src_dst``,
    so the source stands as it was given, and its title is red where the answer is not ok. Rows that are
    not finite are left out.

    Args:
        src, dst: (n, 3) the points that were registered [length].
        result: The answer of ``register``.
        lines: Number of matches to draw, right and wrong ones each.
        view: Elevation and azimuth of the eye in the source frame [deg]; None: from the side,
            or from higher up if the cloud is flat.

    Raises:
        ImportError: If matplotlib is missing.
    """
    src, dst = np.asarray(src, float), np.asarray(dst, float)
    finite = np.isfinite(src).all(axis=1) & np.isfinite(dst).all(axis=1)
    src, dst, inliers = src[finite], dst[finite], np.asarray(result.inliers)[finite]
    # Middles are taken away before anything is multiplied: far origins must not cost digits.
    middle = np.median(src, axis=0) if len(src) else np.zeros(3)
    eye = _eye(src, view)
    here, there = (src - middle) @ eye.T, _about_median(dst) @ eye.T
    back = (result.pose.inverse().apply(dst) - middle) @ eye.T
    figure = new_figure((11, 4.8))
    before, after = figure.subplots(1, 2)
    _draw_before(before, here, there + [1.1 * (_reach(here)[0] + _reach(there)[0]), 0, 0], inliers, lines)
    noun = "inlier" if inliers.sum() == 1 else "inliers"
    verdict = f"After: {inliers.sum()} {noun}, {result.status.name}"
    _frame(after, here, verdict, INK if result.ok else BAD)
    _cloud(after, back, DST)
    _cloud(after, here, SRC)
    segments(after, here[inliers], back[inliers], GOOD, 1.0, 1.0)
    _cloud(after, back[inliers], GOOD, size=13)
    legend(figure, {"source": SRC, "target": DST, "inliers": GOOD, "rejected matches": PALE})
    return figure


def _draw_before(axes: Axes, here: np.ndarray, there: np.ndarray, inliers: np.ndarray, lines: int) -> None:
    _frame(axes, np.concatenate([here, there]), f"Before: {len(here)} matches", INK)
    rng = np.random.default_rng(0)
    for rows, color, width, alpha in ((~inliers, PALE, 0.5, 0.5), (inliers, GOOD, 0.7, 0.5)):
        drawn = rng.permutation(np.flatnonzero(rows))[:lines]
        segments(axes, here[drawn], there[drawn], color, width, alpha)
    _cloud(axes, here, SRC)
    _cloud(axes, there, DST)
    _cloud(axes, there[inliers], GOOD, size=6)


def _eye(points: np.ndarray, view: tuple[float, float] | None) -> np.ndarray:
    """Make the rotation whose rows point right, up and towards the eye."""
    if view is None:
        reach = _reach(_about_median(points))
        view = (50.0, -75.0) if reach[2] < 0.35 * reach[:2].max() else (18.0, -70.0)
    elevation, azimuth = np.radians(view)
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _about_median(points: np.ndarray) -> np.ndarray:
    """Move points so that their median is the origin: one absurd point must not shift the picture."""
    return points - np.median(points, axis=0) if len(points) else points


def _reach(points: np.ndarray) -> np.ndarray:
    """Measure half the extent of each axis, without the farthest points."""
    return np.quantile(np.abs(points), 0.98, axis=0) if len(points) else np.ones(3)


def _cloud(axes: Axes, points: np.ndarray, color: str, size: float | None = None) -> None:
    """Draw points without perspective; the nearer, the more opaque."""
    from matplotlib.colors import to_rgb

    points = points[np.argsort(points[:, 2])]
    near = np.linspace(0.35, 0.95, len(points)) if size is None else np.ones(len(points))
    if size is None:  # as large as leaves the cloud transparent where it is drawn
        share = _reach(_about_median(points))[:2].max() / max(np.ptp(axes.get_xlim()), 1e-300)
        size = float(np.clip(1e5 * share**2 / max(len(points), 1), 0.4, 6))
    colors = np.column_stack([np.tile(to_rgb(color), (len(points), 1)), near])
    axes.scatter(points[:, 0], points[:, 1], s=size, c=colors, linewidths=0, zorder=2, rasterized=True)


def _frame(axes: Axes, points: np.ndarray, title: str, color: str) -> None:
    """Set equal axes around the points, the farthest left out, with a bar that shows a length."""
    corners = (
        np.quantile(points[:, :2], [0.002, 0.998], axis=0) if len(points) else np.array([[-1, -1], [1, 1]])
    )
    middle, half = corners.mean(axis=0), np.ptp(corners, axis=0) / 2
    # One shape for every panel, so that neighbours stand in line.
    height = 1.16 * max(half[0] / PANEL_SHAPE, half[1], 1e-12)
    width = PANEL_SHAPE * height
    low = middle - [width, height]
    axes.set(xlim=(low[0], low[0] + 2 * width), ylim=(low[1], low[1] + 2 * height))
    axes.set(aspect="equal", xticks=[], yticks=[])
    without_spines(axes, *axes.spines)
    length = _round_length(width / 3)
    x, y = low + 0.04 * height
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    above = (x + length / 2, y + 0.02 * height)
    axes.text(*above, f"{length:g}", ha="center", va="bottom", fontsize=8, color=INK)
    axes.set_title(title, fontsize=11, color=color)


def _round_length(length: float) -> float:
    """Find the nearest of 1, 2, 5 times a power of ten at or below a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
