"""The picture of an answer: both clouds before and after."""

from __future__ import annotations

from typing import Any

import numpy as np

from teaser_jax.plots.panels import about_median, draw_points, eye_of, reach_of, set_frame
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
)
from teaser_jax.register import Registration


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
    eye = eye_of(src, view)
    here, there = (src - middle) @ eye.T, about_median(dst) @ eye.T
    back = (result.pose.inverse().apply(dst) - middle) @ eye.T
    figure = new_figure((11, 4.8))
    before, after = figure.subplots(1, 2)
    _draw_before(before, here, there + [1.1 * (reach_of(here)[0] + reach_of(there)[0]), 0, 0], inliers, lines)
    noun = "inlier" if inliers.sum() == 1 else "inliers"
    verdict = f"After: {inliers.sum()} {noun}, {result.status.name}"
    set_frame(after, here, verdict, INK if result.ok else BAD)
    draw_points(after, back, DST)
    draw_points(after, here, SRC)
    segments(after, here[inliers], back[inliers], GOOD, 1.0, 1.0)
    draw_points(after, back[inliers], GOOD, size=13)
    legend(figure, {"source": SRC, "target": DST, "inliers": GOOD, "rejected matches": PALE})
    return figure


def _draw_before(axes: Axes, here: np.ndarray, there: np.ndarray, inliers: np.ndarray, lines: int) -> None:
    set_frame(axes, np.concatenate([here, there]), f"Before: {len(here)} matches", INK)
    rng = np.random.default_rng(0)
    for rows, color, width, alpha in ((~inliers, PALE, 0.5, 0.5), (inliers, GOOD, 0.7, 0.5)):
        drawn = rng.permutation(np.flatnonzero(rows))[:lines]
        segments(axes, here[drawn], there[drawn], color, width, alpha)
    draw_points(axes, here, SRC)
    draw_points(axes, there, DST)
    draw_points(axes, there[inliers], GOOD, size=6)
