"""The figure of a study: box plots of every measure by method, as a picture and as a page to look into."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError, os_errors_named, replacing
from teaser_jax.plots.style import (
    BAD,
    DST,
    GOOD,
    INK,
    PALE,
    SRC,
    Axes,
    Figure,
    label,
    legend,
    new_figure,
)
from teaser_jax.studies.methods import LIMIT
from teaser_jax.studies.results import PAGE, PICTURE, TABLE, Results, read_results
from teaser_jax.studies.study import LABELS, MATCHES, Measure

FLOOR = 1e-5  # below it a logarithmic axis says no more
OUR_COLORS = (GOOD, DST, "#7fb0e0", "#17415f", "#8fd0ab", "#5b7f95")
OTHER_COLORS = (SRC, BAD, "#8e5ea2", "#9c6b3f", "#d9a520", "#d17fa8", INK)


def draw_study(place: str | Path) -> tuple[Path, Path]:
    """Draw ``figure.png`` (matplotlib) and ``figure.html`` (plotly, self-contained) beside the table.

    Both show box plots of every measure by method and cell, and the share of right answers.

    Args:
        place: The folder of the study.

    Returns:
        The two files.

    Raises:
        FileError: As ``read_results``; where the table has no row, or figures cannot be written.
        ImportError: Without the extra ``studies``.
    """
    place = Path(place)
    results = read_results(place)
    if not results.rows:
        raise FileError(f"{place / TABLE}: has no row yet: run the study first.")
    with os_errors_named(place, "figures cannot be written"):
        with replacing(place / PICTURE) as partial:
            _picture(results).savefig(partial, dpi=110)
        with replacing(place / PAGE) as partial:
            partial.write_text(_page(results), encoding="utf-8")
    return place / PICTURE, place / PAGE


def check_drawing() -> None:
    """Raise ImportError now, not after hours, where the extra ``studies`` is missing."""
    new_figure((1, 1))
    _plotly()


def _panels(results: Results) -> Iterator[tuple[Measure, list[str]]]:
    """List each measure with the methods that have it."""
    for measure in results.study.measures:
        having = [name for name in results.methods if results.has(name, measure.column)]
        if having:
            yield measure, having


def _picture(results: Results) -> Figure:
    panels = list(_panels(results))
    figure = new_figure((11, 1.2 + 2.6 * (len(panels) + 1)))
    every, colors = np.atleast_1d(figure.subplots(len(panels) + 1, 1)), _colors(results)
    figure.suptitle(results.title, fontsize=11, color=INK)
    for axes, (measure, methods) in zip(every, panels, strict=False):
        _boxes(axes, results, measure, {name: colors[name] for name in methods})
    _shares(every[-1], results, colors)
    every[-1].set_xlabel(LABELS[results.study.sweep], fontsize=9, color=INK)
    legend(figure, colors)
    return figure


def _boxes(axes: Axes, results: Results, measure: Measure, colors: dict[str, str]) -> None:
    width = 0.84 / len(colors)
    label(axes, "", "", measure.label, counts=False)
    if measure.log:
        axes.set_yscale("log")
    for k, (method, color) in enumerate(colors.items()):
        for place, value in enumerate(results.values):
            numbers = _drawn(results.measured(method, value, measure.column), measure)
            if not len(numbers):
                continue
            axes.boxplot(
                numbers, positions=[place + (k - (len(colors) - 1) / 2) * width], widths=0.86 * width,
                patch_artist=True, manage_ticks=False,
                boxprops={"facecolor": color, "edgecolor": color, "alpha": 0.75, "linewidth": 0.6},
                medianprops={"color": INK, "linewidth": 0.9},
                whiskerprops={"color": color, "linewidth": 0.8}, capprops={"color": color, "linewidth": 0.8},
                flierprops={"marker": ".", "markersize": 2.5, "markeredgecolor": color},
            )  # fmt: skip
    _ticks(axes, results)


def _shares(axes: Axes, results: Results, colors: dict[str, str]) -> None:
    label(axes, "", "", "right answers [share]", counts=False)
    for method in results.methods:
        shares = [results.success(method, value) for value in results.values]
        axes.plot(shares, color=colors[method], marker="o", markersize=3, linewidth=1.3)
    axes.set_ylim(-0.04, 1.04)
    _ticks(axes, results)


def _ticks(axes: Axes, results: Results) -> None:
    values = results.values
    axes.set_xticks(range(len(values)), [_value(results.study.sweep, v) for v in values])
    axes.set_xlim(-0.6, len(values) - 0.4)
    for edge in np.arange(0.5, len(values) - 1):
        axes.axvline(edge, color=PALE, linewidth=0.4)


def _value(sweep: str, value: Number) -> str:
    return f"{value:g}" if sweep == MATCHES else f"{100 * value:g} %"


def _drawn(numbers: np.ndarray, measure: Measure) -> np.ndarray:
    numbers = numbers[np.isfinite(numbers)]
    return np.maximum(numbers, FLOOR) if measure.log else numbers


def _page(results: Results) -> str:
    """Draw the page of a study with plotly and return its text, which needs nothing from anywhere."""
    go, make_subplots = _plotly()
    panels, shown, colors = list(_panels(results)), set(), _colors(results)
    count = len(panels) + 1
    figure = make_subplots(rows=count, cols=1, shared_xaxes=True, vertical_spacing=0.1 / count)

    def add(trace: Any, method: str, row: int) -> None:
        trace.update(
            name=method, legendgroup=method, showlegend=method not in shown, marker_color=colors[method]
        )
        figure.add_trace(trace, row=row, col=1)
        shown.add(method)

    for row, (measure, methods) in enumerate(panels, 1):
        for method in methods:
            cells = [
                (_value(results.study.sweep, v), x)
                for v in results.values
                for x in _drawn(results.measured(method, v, measure.column), measure)
            ]
            trace = go.Box(
                x=[v for v, _ in cells], y=[float(f"{x:.5g}") for _, x in cells], offsetgroup=method
            )
            add(trace, method, row)
        kind = "log" if measure.log else "linear"
        figure.update_yaxes(title_text=measure.label, type=kind, row=row, col=1)
    names = [_value(results.study.sweep, v) for v in results.values]
    for method in results.methods:
        shares = [results.success(method, v) for v in results.values]
        add(go.Scatter(x=names, y=shares, mode="lines+markers"), method, count)
    figure.update_yaxes(title_text="right answers [share]", range=[-0.04, 1.04], row=count, col=1)
    figure.update_xaxes(categoryorder="array", categoryarray=names)
    figure.update_xaxes(title_text=LABELS[results.study.sweep], row=count, col=1)
    figure.update_layout(
        title=results.title, boxmode="group", template="plotly_white", height=300 * count + 120,
        legend={"itemclick": "toggle", "itemdoubleclick": "toggleothers"},
    )  # fmt: skip
    return figure.to_html(include_plotlyjs=True, full_html=True)


def _plotly() -> tuple[Any, Any]:
    try:
        import plotly.graph_objects as go
        from plotly.subplots import make_subplots
    except ImportError:
        raise ImportError("studies draw pages with plotly: pip install 'teaser-jax[studies]'") from None
    return go, make_subplots


def _colors(results: Results) -> dict[str, str]:
    """Give each method a colour: ours are cool, others warm, the limit is pale."""
    ours, others = iter(OUR_COLORS * 9), iter(OTHER_COLORS * 9)
    known = {m.name for m in results.study.methods if not m.others}
    return {
        name: PALE if name in (LIMIT, "before pruning") else next(ours if name in known else others)
        for name in results.methods
    }
