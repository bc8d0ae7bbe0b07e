"""The figure of a study: box plots of every measure by method, as a picture and as a page to look into."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import FileError, os_errors_named, replacing
from teaser_jax.plots.style import INK, LEGEND_COLUMNS, PALE, Axes, Figure, label, legend, new_figure
from teaser_jax.studies.looks import Look, look_of
from teaser_jax.studies.results import PAGE, PICTURE, TABLE, Results, read_results
from teaser_jax.studies.study import LABELS, MATCHES, Measure

FLOOR = 1e-5  # below it a logarithmic axis says no more
SPREAD = 0.84  # of a cell, from the first method to the last
WIDTH = 11  # of a picture [inch]
LETTERS = 165  # of a line of its legend
POINTS = 66  # of an inch of it, without the margins
SYMBOLS = {
    "o": "circle", "s": "square", "D": "diamond", "d": "diamond-tall", "^": "triangle-up",
    "v": "triangle-down", "<": "triangle-left", ">": "triangle-right", "p": "pentagon", "h": "hexagon",
    "H": "hexagon2", "P": "cross", "X": "x", "*": "star",
}  # fmt: skip  # matplotlib's markers in the words of plotly


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
    figure = new_figure((WIDTH, 1.2 + 2.6 * (len(panels) + 1)))
    every = np.atleast_1d(figure.subplots(len(panels) + 1, 1))
    figure.suptitle(results.title, fontsize=11, color=INK)
    for axes, (measure, methods) in zip(every, panels, strict=False):
        _boxes(axes, results, measure, methods)
    _shares(every[-1], results)
    every[-1].set_xlabel(LABELS[results.study.sweep], fontsize=9, color=INK)
    _legend(figure, results)
    return figure


def _legend(figure: Figure, results: Results) -> None:
    looks = {results.label(method): look_of(method) for method in results.methods}
    colors, markers = ({name: look[k] for name, look in looks.items()} for k in range(2))
    columns = min(LEGEND_COLUMNS, LETTERS // (max(map(len, looks)) + 5))  # five are a marker and its room
    legend(figure, colors, markers, max(1, columns))


def _shifts(results: Results) -> dict[str, float]:
    """Give each method its place in a cell, the same in all panels, so that none hides another."""
    count = len(results.methods)
    return {method: SPREAD * ((k + 0.5) / count - 0.5) for k, method in enumerate(results.methods)}


def _marked(results: Results, look: Look, most: float) -> dict[str, Any]:
    """Say how matplotlib draws a marker of at most some size, which leaves its neighbours room."""
    size = min(most, POINTS * WIDTH * SPREAD / (len(results.values) * len(results.methods)))
    return {
        "marker": look.marker, "markersize": size, "markerfacecolor": look.color,
        "markeredgecolor": "white", "markeredgewidth": 0.5,
    }  # fmt: skip


def _boxes(axes: Axes, results: Results, measure: Measure, methods: list[str]) -> None:
    shifts = _shifts(results)
    width = SPREAD / len(shifts)
    label(axes, "", "", measure.label, counts=False)
    if measure.log:
        axes.set_yscale("log")
    for method in methods:
        look, cells = look_of(method), _cells(results, method, measure)
        if not cells:
            continue
        color, across = look.color, [place + shifts[method] for place in cells]
        axes.boxplot(
            list(cells.values()), positions=across, widths=min(0.86 * width, 0.2),
            patch_artist=True, manage_ticks=False,
            boxprops={"facecolor": color, "edgecolor": color, "alpha": 0.75, "linewidth": 0.6},
            medianprops={"color": INK, "linewidth": 0.9},
            whiskerprops={"color": color, "linewidth": 0.8}, capprops={"color": color, "linewidth": 0.8},
            flierprops={"marker": ".", "markersize": 2.5, "markeredgecolor": color},
        )  # fmt: skip
        medians = [np.median(numbers) for numbers in cells.values()]
        axes.plot(across, medians, linestyle="", zorder=3, **_marked(results, look, 5.0))
    _ticks(axes, results)


def _cells(results: Results, method: str, measure: Measure) -> dict[int, np.ndarray]:
    """Find what is drawn of a method, by the place of the cell; cells without a number are left out."""
    every = (_drawn(results.measured(method, value, measure.column), measure) for value in results.values)
    return {place: numbers for place, numbers in enumerate(every) if len(numbers)}


def _shares(axes: Axes, results: Results) -> None:
    label(axes, "", "", "right answers [share]", counts=False)
    for method in results.methods:
        shares = [results.success(method, value) for value in results.values]
        look = look_of(method)
        across = np.arange(len(shares)) + _shifts(results)[method]
        axes.plot(across, shares, color=look.color, linewidth=0.7, alpha=0.5)
        axes.plot(across, shares, linestyle="", zorder=3, clip_on=False, **_marked(results, look, 6.5))
    axes.set_ylim(-0.06, 1.06)
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
    panels, shown = list(_panels(results)), set()
    count = len(panels) + 1
    figure = make_subplots(rows=count, cols=1, shared_xaxes=True, vertical_spacing=0.1 / count)

    def add(trace: Any, method: str, row: int) -> None:
        look = look_of(method)
        trace.update(
            name=results.label(method), legendgroup=method, offsetgroup=method, marker_color=look.color,
            showlegend=method not in shown,
        )  # fmt: skip
        trace.marker.symbol = SYMBOLS[look.marker]
        figure.add_trace(trace, row=row, col=1)
        shown.add(method)

    for row, (measure, methods) in enumerate(panels, 1):
        for method in methods:
            cells = [
                (_value(results.study.sweep, v), x)
                for v in results.values
                for x in _drawn(results.measured(method, v, measure.column), measure)
            ]
            trace = go.Box(x=[v for v, _ in cells], y=[float(f"{x:.5g}") for _, x in cells])
            add(trace, method, row)
        kind = "log" if measure.log else "linear"
        figure.update_yaxes(title_text=measure.label, type=kind, row=row, col=1)
    names = [_value(results.study.sweep, v) for v in results.values]
    for method in results.methods:
        shares = [results.success(method, v) for v in results.values]
        add(go.Scatter(x=names, y=shares, mode="lines+markers"), method, count)
    figure.update_yaxes(title_text="right answers [share]", range=[-0.06, 1.06], row=count, col=1)
    figure.update_xaxes(categoryorder="array", categoryarray=names)
    figure.update_xaxes(title_text=LABELS[results.study.sweep], row=count, col=1)
    figure.update_layout(
        title=results.title, boxmode="group", scattermode="group", template="plotly_white",
        height=300 * count + 120,
        legend={"itemclick": "toggle", "itemdoubleclick": "toggleothers"},
    )  # fmt: skip
    return figure.to_html(include_plotlyjs=True, full_html=True)


def _plotly() -> tuple[Any, Any]:
    what = "studies draw pages with plotly"
    subplots = needed("plotly.subplots", what, "studies")
    return needed("plotly.graph_objects", what, "studies"), subplots.make_subplots
