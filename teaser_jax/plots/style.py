"""The style of all pictures: colours, empty figures, names of axes, legends. matplotlib loads when called."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.extras import needed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
else:
    Axes = Figure = Any

SRC, DST, GOOD, BAD, INK, PALE = "#e4842d", "#3a6ea5", "#1f9d55", "#c8443b", "#30343b", "#b9bec7"
LEGEND_COLUMNS = 5


def new_figure(size: tuple[Number, Number]) -> Figure:
    """Make an empty figure of a size [inch], bound to no backend.

    Raises:
        ImportError: If matplotlib is missing.
    """
    parts = ("figure", "layout_engine")
    figure, engine = (needed(f"matplotlib.{part}", "plots need matplotlib", "viz") for part in parts)
    layout = engine.ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    width, height = (float(x) for x in size)
    return figure.Figure(figsize=(width, height), dpi=150, facecolor="white", layout=layout)


def label(axes: Axes, title: str, x: str, y: str, *, counts: bool = True) -> None:
    """Name axes in the style of all pictures; with ``counts`` the vertical one has whole numbers only."""
    from matplotlib.ticker import MaxNLocator

    axes.set_title(title, fontsize=10, color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.tick_params(which="both", labelsize=8, colors=INK)
    axes.yaxis.set_major_locator(MaxNLocator("auto", integer=counts, steps=[1, 2, 5, 10]))
    without_spines(axes, "top", "right")


def legend(
    figure: Figure, colors: dict[str, str], markers: Mapping[str, str] = {}, columns: int = LEGEND_COLUMNS
) -> None:
    """Say below the panels what each colour is, and each marker that is no disk."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=color, markersize=5, label=name,
               marker="" if name == "rejected matches" else markers.get(name, "o"),
               linestyle="-" if name in ("inliers", "rejected matches") else "")
        for name, color in colors.items()
    ]  # fmt: skip
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(handles), columns),
        frameon=False,
        fontsize=9,
    )


def without_spines(axes: Axes, *sides: str) -> None:
    """Take away the frame of a panel on some sides."""
    for side in sides:
        axes.spines[side].set_visible(False)


def segments(axes: Axes, start: np.ndarray, end: np.ndarray, color: str, width: float, alpha: float) -> None:
    """Draw a line from each point of one array to that of another; a third coordinate is left out."""
    from matplotlib.collections import LineCollection

    ends = np.stack([start[:, :2], end[:, :2]], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=color, linewidths=width, alpha=alpha, zorder=1))
