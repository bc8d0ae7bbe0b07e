"""The picture of an answer to two clouds: before and after, from above and from the side, and its rivals."""

from __future__ import annotations

import textwrap
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.plots.panels import PANEL_SHAPE, corners_of, draw_points, set_frame
from teaser_jax.plots.scene import ALONE, RAMP, SATURATED, Laid, Matches, Scene, scene_of
from teaser_jax.plots.style import BAD, DST, GOOD, INK, SRC, Axes, Figure, legend, new_figure, segments

MOST_POINTS = 20_000  # of each cloud
PANEL_WIDTH, LINE = 4.4, 0.22  # of a panel, and of a line of words [inch]
WORDS = 125  # characters of a line above the panels
FLATTEST = 2.2  # width of a panel, by its height


def plot_clouds(result: CloudRegistration, src: Any = None, dst: Any = None, *, lines: int = 150) -> Figure:
    """Draw two clouds before and after, the latter from above and from the side, and poses that rival it.

    Before, the source stands beside the target, turned as it was given (and at the size that a known scale
    makes it), with a sample of the matches: right ones green, others red. After, it lies on the target, and
    its points show how far the target is from them, up to two voxels; grey ones lie further than three from
    all of it. Panels look along the principal axes of the overlap, without perspective. Up to three
    ``equivalent`` poses follow side by side. Of an answer without a pose there is only before.

    Args:
        result: The answer of ``register_clouds``.
        src, dst: Clouds to draw in place of those of the answer, in the same frames; None: those.
        lines: Number of matches to draw, right and wrong ones each.

    Raises:
        ImportError: If matplotlib is missing.
    """
    scene, words = scene_of(result, MOST_POINTS, src, dst), _words(result)
    right, back, up = scene.axes
    above, beside = np.stack([right, back, up]), np.stack([right, up, -back])
    shape = _shape(scene, above)
    rows, columns = (1, 1) if scene.after is None else (1 + bool(scene.rivals), 3)
    height = rows * (PANEL_WIDTH / shape + 2 * LINE) + LINE * (3 + len(words.splitlines()))
    figure = new_figure((max(columns, 2) * PANEL_WIDTH, height))
    panels = np.atleast_1d(figure.subplots(rows, columns)).reshape(rows, columns)
    figure.suptitle(words, fontsize=11, color=INK if result.ok else BAD)
    _draw_before(panels[0, 0], scene, above, lines, shape)
    shown = {"source": SRC, "target": DST}
    if len(scene.matches.src):
        shown |= {"inliers": GOOD, "rejected matches": BAD}
    if scene.after is not None:
        _draw_laid(panels[0, 1], scene, scene.after, above, "After, from above", shape)
        _draw_laid(panels[0, 2], scene, scene.after, beside, "After, from the side", shape)
        for axes in panels[1:].flat[len(scene.rivals) :]:
            axes.set_axis_off()
        for k, (axes, rival) in enumerate(zip(panels[1:].flat, scene.rivals, strict=False)):
            title = f"Other pose {k + 1} of {len(result.equivalent)}:\n{rival.words}"
            _draw_laid(axes, scene, rival, above, title, shape)
        _draw_bar(figure, panels[:, -1], scene.voxel_size)
        shown |= {"source without a partner": ALONE}
    legend(figure, shown)
    return figure


def _shape(scene: Scene, eye: Float[np.ndarray, "3 3"]) -> float:
    """Choose the width of all panels, by their height: flat where the clouds are long."""
    seen = scene.target if scene.after is None else np.concatenate([scene.target, scene.after.points])
    width, height = np.ptp(corners_of(seen @ eye.T), axis=0)
    return float(np.clip(width / max(height, 1e-300), PANEL_SHAPE, FLATTEST))


def _words(result: CloudRegistration) -> str:
    """Say in a line or two whether the pose holds, and how well."""
    if result.ok:
        return (
            f"ok: points of the overlap are off by {result.displacement:.3g} (expected), in cells of "
            f"{result.voxel_size:.3g}"
        )
    return f"NOT OK, {result.status.name}\n" + textwrap.fill(result.advice, WORDS)


def _draw_before(axes: Axes, scene: Scene, eye: Float[np.ndarray, "3 3"], lines: int, shape: float) -> None:
    matches = scene.matches
    right = int(matches.inliers.sum())
    title = f"Before: {right} of {len(matches.src)} matches are inliers" if len(matches.src) else "Before"
    here, there = scene.before @ eye.T, scene.target @ eye.T
    set_frame(axes, np.concatenate([here, there]), title, INK, shape)
    _draw_matches(axes, matches, eye, lines)
    draw_points(axes, here, SRC)
    draw_points(axes, there, DST)


def _draw_matches(axes: Axes, matches: Matches, eye: Float[np.ndarray, "3 3"], lines: int) -> None:
    rng = np.random.default_rng(0)
    here, there = matches.src @ eye.T, matches.dst @ eye.T
    for rows, color, width in ((~matches.inliers, BAD, 0.4), (matches.inliers, GOOD, 0.8)):
        drawn = rng.permutation(np.flatnonzero(rows))[:lines]
        segments(axes, here[drawn], there[drawn], color, width, 0.5)


def _draw_laid(
    axes: Axes, scene: Scene, laid: Laid, eye: Float[np.ndarray, "3 3"], title: str, shape: float
) -> None:
    there, here = scene.target @ eye.T, laid.points @ eye.T
    set_frame(axes, np.concatenate([there, here]), title, INK, shape)
    draw_points(axes, there, DST)
    draw_points(axes, here, _colors(laid, scene.voxel_size))


def _colors(laid: Laid, voxel_size: float) -> Float[np.ndarray, "n 4"]:
    """Give each point the color of its distance, or that of those without a partner."""
    from matplotlib.colors import to_rgba

    paired = laid.paired
    share = np.where(paired, laid.distance, 0) / (SATURATED * voxel_size)
    return np.where(paired[:, None], _ramp()(np.minimum(share, 1)), to_rgba(ALONE))


def _ramp() -> Any:
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("distance", list(RAMP))


def _draw_bar(figure: Figure, panels: np.ndarray, voxel_size: float) -> None:
    """Say beside the panels what the colors of the source mean."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    scale = ScalarMappable(Normalize(0, SATURATED * voxel_size), _ramp())
    shrink = 0.8 / len(panels)  # as high as the uppermost panel, whatever stands below
    bar = figure.colorbar(scale, ax=list(panels), extend="max", shrink=shrink, anchor=(0, 0.9), aspect=25)
    bar.set_ticks([0, voxel_size, SATURATED * voxel_size])
    bar.set_ticklabels(["0", f"{voxel_size:.3g}\n(a voxel)", f"{SATURATED * voxel_size:.3g}\n(two)"])
    bar.set_label("distance to the target\n[unit of the points]", fontsize=9, color=INK)
    bar.ax.tick_params(labelsize=8, colors=INK)
    bar.outline.set_visible(False)
