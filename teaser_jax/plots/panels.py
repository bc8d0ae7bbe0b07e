"""Points seen from some side, in panels of one shape with a bar that shows a length."""

from __future__ import annotations

import numpy as np

from teaser_jax.plots.style import INK, Axes, without_spines

PANEL_SHAPE = 1.3  # width by height


def eye_of(points: np.ndarray, view: tuple[float, float] | None) -> np.ndarray:
    """Make the rotation whose rows point right, up and towards the eye."""
    if view is None:
        reach = reach_of(about_median(points))
        view = (50.0, -75.0) if reach[2] < 0.35 * reach[:2].max() else (18.0, -70.0)
    elevation, azimuth = np.radians(view)
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def about_median(points: np.ndarray) -> np.ndarray:
    """Move points so that their median is the origin: one absurd point must not shift the picture."""
    return points - np.median(points, axis=0) if len(points) else points


def reach_of(points: np.ndarray) -> np.ndarray:
    """Measure half the extent of each axis, without the farthest points."""
    return np.quantile(np.abs(points), 0.98, axis=0) if len(points) else np.ones(3)


def draw_points(axes: Axes, points: np.ndarray, color: str | np.ndarray, size: float | None = None) -> None:
    """Draw points without perspective, in one color or each in its own; the nearer, the more opaque."""
    from matplotlib.colors import to_rgba_array

    order = np.argsort(points[:, 2])
    points = points[order]
    near = np.linspace(0.35, 0.95, len(points)) if size is None else np.ones(len(points))
    if size is None:  # as large as leaves the cloud transparent where it is drawn
        share = reach_of(about_median(points))[:2].max() / max(np.ptp(axes.get_xlim()), 1e-300)
        size = float(np.clip(1e5 * share**2 / max(len(points), 1), 0.4, 6))
    colors = np.empty((len(points), 4))
    colors[:] = to_rgba_array(color) if isinstance(color, str) else color[order]
    colors[:, 3] = near
    axes.scatter(points[:, 0], points[:, 1], s=size, c=colors, linewidths=0, zorder=2, rasterized=True)


def corners_of(points: np.ndarray) -> np.ndarray:
    """Find the lower and the upper corner of what is seen of points, the farthest left out."""
    if len(points) == 0:
        return np.array([[-1.0, -1.0], [1.0, 1.0]])
    return np.quantile(points[:, :2], [0.002, 0.998], axis=0)


def set_frame(axes: Axes, points: np.ndarray, title: str, color: str, shape: float = PANEL_SHAPE) -> None:
    """Set equal axes around the points, the farthest left out, with a bar that shows a length."""
    corners = corners_of(points)
    middle, half = corners.mean(axis=0), np.ptp(corners, axis=0) / 2
    # One shape for every panel, so that neighbours stand in line.
    height = 1.16 * max(half[0] / shape, half[1], 1e-12)
    width = shape * height
    low = middle - [width, height]
    axes.set(xlim=(low[0], low[0] + 2 * width), ylim=(low[1], low[1] + 2 * height))
    axes.set(aspect="equal", xticks=[], yticks=[])
    without_spines(axes, *axes.spines)
    length = round_length(width / 3)
    x, y = low + 0.04 * height
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    axes.text(x + length + 0.03 * height, y, f"{length:g}", va="center", fontsize=8, color=INK)
    axes.set_title(title, fontsize=11, color=color)


def round_length(length: float) -> float:
    """Find the nearest of 1, 2, 5 times a power of ten at or below a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))
