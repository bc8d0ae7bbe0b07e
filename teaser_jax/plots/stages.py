"""Pictures of an answer and of each stage behind it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, UInt32

from teaser_jax.ground.bits import unpack_host
from teaser_jax.register import Registration

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SRC, DST, GOOD, BAD, INK, PALE = "#e4842d", "#3a6ea5", "#1f9d55", "#c8443b", "#30343b", "#b9bec7"
PANEL_SHAPE = 1.3
LEGEND_COLUMNS = 5


def plot_registration(
    src: Any, dst: Any, result: Registration, *, lines: int = 250, view: tuple[float, float] | None = None
) -> Figure:
    """Before: both clouds side by side and a sample of the matches. After: the aligned clouds.

    Both panels look at the points along the same direction, without perspective. The second shows
    the target moved back onto the source, ``T_src_dst``, so the source stands as it was given.
    Rows that are not finite are left out.

    Args:
        src, dst: (n, 3) the points that were registered.
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
    here, there = (src - middle) @ eye.T, _centred(dst) @ eye.T
    back = (result.pose.inverse().apply(dst) - middle) @ eye.T

    figure = new_figure((11, 4.8))
    before, after = figure.subplots(1, 2)
    there = there + [1.1 * (_reach(here)[0] + _reach(there)[0]), 0, 0]
    both = np.concatenate([here, there])
    _frame(before, both, f"Before: {len(src)} matches", INK)
    rng = np.random.default_rng(0)
    for rows, color, width, alpha in ((~inliers, PALE, 0.5, 0.5), (inliers, GOOD, 0.7, 0.5)):
        drawn = rng.permutation(np.flatnonzero(rows))[:lines]
        _segments(before, here[drawn], there[drawn], color, width, alpha)
    _cloud(before, here, SRC)
    _cloud(before, there, DST)
    _cloud(before, there[inliers], GOOD, size=6)

    noun = "inlier" if inliers.sum() == 1 else "inliers"
    verdict = f"After: {inliers.sum()} {noun}, {result.status.name}"
    _frame(after, here, verdict, INK if result.ok else BAD)
    _cloud(after, back, DST)
    _cloud(after, here, SRC)
    _segments(after, here[inliers], back[inliers], GOOD, 1.0, 1.0)
    _cloud(after, back[inliers], GOOD, size=13)
    legend(figure, {"source": SRC, "target": DST, "inliers": GOOD, "rejected matches": PALE})
    return figure


def plot_trims(
    values: Float[np.ndarray, " k"],
    bounds: Float[np.ndarray, " k"],
    estimate: float,
    *,
    cbar2: float = 1.0,
    truth: float | None = None,
) -> Figure:
    """Scale measurements: where they lie, and how many allow each scale.

    Args:
        values, bounds: TRIMs s_ij and alpha_ij [-], from ``stages.invariants.trims``.
        estimate: The scale of the vote.
        cbar2: Truncation [-].
        truth: The true scale, if known.

    References: eq. (TRIM), Algorithm 2.
    """
    values, reach = np.asarray(values, float), np.sqrt(cbar2) * np.asarray(bounds, float)
    voters = np.isfinite(values) & np.isfinite(reach)
    values, reach = values[voters], reach[voters]
    low, high = 0.0, max(2.0 * float(estimate), np.quantile(values, 0.9) if values.size else 1.0)
    figure = new_figure((9, 3.6))
    left, right = figure.subplots(1, 2)
    left.hist(values, bins=120, range=(low, high), color=DST)
    label(left, "measurements of the scale", "s_ij", "pairs of matches")
    grid = np.linspace(low, high, 1200)
    agreeing = np.searchsorted(np.sort(values - reach), grid, side="right") - np.searchsorted(
        np.sort(values + reach), grid, side="left"
    )
    right.fill_between(grid, agreeing, color=DST, alpha=0.25, linewidth=0)
    right.plot(grid, agreeing, color=DST, linewidth=1.2)
    label(right, "how many measurements allow a scale", "s", "pairs that agree")
    for axes in (left, right):
        axes.axvline(float(estimate), color=GOOD, linewidth=1.6, label=f"estimate {float(estimate):.4g}")
        if truth is not None:
            axes.axvline(truth, color=INK, linewidth=1, linestyle=":", label=f"truth {truth:.4g}")
        axes.set_xlim(low, high)
    right.legend(frameon=False, fontsize=8)
    return figure


def plot_graph(edge_bits: UInt32[np.ndarray, "n w"], clique: Bool[np.ndarray, " n"]) -> Figure:
    """The consistency graph: its adjacency matrix, clique first, and the degrees.

    Args:
        edge_bits: Packed bit rows, from ``stages.consistency.consistency_graph``.
        clique: (n,) members.
    """
    edges, clique = _edges(edge_bits, clique)
    degree = edges.sum(axis=1)
    order = np.lexsort((-degree, ~clique))
    n, size = len(degree), int(clique.sum())
    figure = new_figure((9, 4.2))
    left, right = figure.subplots(1, 2)
    i, j = np.nonzero(edges[np.ix_(order, order)])
    inside = (i < size) & (j < size)
    dot = max(0.9, 250 / max(n, 1)) ** 2  # one cell of the matrix, or as small as can be seen
    for rows, color in ((~inside, INK), (inside, GOOD)):
        left.scatter(j[rows], i[rows], s=dot, marker="s", color=color, linewidths=0, rasterized=True)
    left.set(xlim=(-0.5, n - 0.5), ylim=(n - 0.5, -0.5), aspect="equal")
    density = edges.sum() / max(n * (n - 1), 1)
    label(left, f"which matches agree: {density:.1%} of the pairs", "match (clique first)", "match")
    rank = np.arange(n)
    right.bar(rank, degree[order], width=1.0, color=np.where(clique[order], GOOD, PALE))
    right.axhline(size - 1, color=GOOD, linewidth=1, linestyle=":")
    title = f"degree of each match; the clique has {size}"
    label(right, title, "match (clique first)", "matches it agrees with")
    right.set_xlim(-0.5, n - 0.5)
    return figure


def plot_clique(
    edge_bits: UInt32[np.ndarray, "n w"], clique: Bool[np.ndarray, " n"], *, lines: int = 6000
) -> Figure:
    """The clique inside the graph: members on a ring, the others around it.

    The more members a match agrees with, the nearer it stands.

    Args:
        edge_bits: Packed bit rows of the consistency graph.
        clique: (n,) members.
        lines: Number of edges outside the clique to draw.
    """
    edges, clique = _edges(edge_bits, clique)
    n, size = len(clique), int(clique.sum())
    known = edges[:, clique].sum(axis=1)
    others = np.flatnonzero(~clique)[np.argsort(-known[~clique], kind="stable")]
    radius, turn = np.ones(n), np.zeros(n)
    turn[clique] = np.arange(size) / max(size, 1)
    turn[others] = np.arange(n - size) * 0.6180339887498949  # the sunflower's: evenly spread
    radius[others] = np.sqrt(np.linspace(1.6**2, 3.0**2, n - size))
    place = radius[:, None] * np.stack([np.cos(2 * np.pi * turn), np.sin(2 * np.pi * turn)], axis=1)
    i, j = np.nonzero(np.triu(edges, 1))
    inside = clique[i] & clique[j]
    outside = np.random.default_rng(0).permutation(np.flatnonzero(~inside))[:lines]
    figure = new_figure((5.6, 5.6))
    axes = figure.subplots()
    _segments(axes, place[i[outside]], place[j[outside]], PALE, 0.3, 0.5)
    _segments(axes, place[i[inside]], place[j[inside]], GOOD, 0.5, min(1.0, 0.08 + 8 / max(size, 1)))
    x, y = place.T
    axes.scatter(x[~clique], y[~clique], s=6, color=INK, linewidths=0, alpha=0.6)
    axes.scatter(x[clique], y[clique], s=16, color=GOOD, linewidths=0, zorder=3)
    axes.set_title(f"{size} of {n} matches agree pairwise", fontsize=10, color=INK)
    axes.set_aspect("equal")
    axes.set_axis_off()
    return figure


def plot_residuals(
    squared: Float[np.ndarray, " k"],
    kept: Bool[np.ndarray, " k"],
    *,
    cbar2: float = 1.0,
    of: str = "rotation measurements",
) -> Figure:
    """Residuals in units of their bounds, those that were kept and those that were truncated.

    Args:
        squared: r^2 / delta^2 of each measurement [-].
        kept: Those with weight 1 in the end.
        cbar2: Truncation [-].
        of: What was measured, for the title.
    """
    size, kept = np.sqrt(np.asarray(squared, float)), np.asarray(kept, bool)
    figure = new_figure((6.4, 3.4))
    axes = figure.subplots()
    limit = max(2.0 * np.sqrt(cbar2), float(np.quantile(size, 0.98)) if size.size else 0.0)
    sets = [np.minimum(size[kept], limit), np.minimum(size[~kept], limit)]
    labels = [f"kept ({kept.sum()})", f"rejected ({(~kept).sum()})"]
    axes.set_xlim(0, limit)
    axes.hist(sets, bins=60, range=(0, limit), stacked=True, color=[GOOD, PALE], label=labels)
    _truncation(axes, cbar2)
    label(axes, f"residuals of the {of}", "residual / bound (the last bar holds all beyond)", "number")
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_translation(
    offsets: Float[np.ndarray, "n 3"],
    noise_bound: Float[np.ndarray, " n"],
    members: Bool[np.ndarray, "n 3"],
    estimate: Float[np.ndarray, "3"],
    *,
    cbar2: float = 1.0,
) -> Figure:
    """The vote of each axis of the translation: every point allows an interval.

    Args:
        offsets: b_i - s R a_i of the voters [length].
        noise_bound: beta_i of the voters.
        members: Voters in the consensus of each axis.
        estimate: The translation.
        cbar2: Truncation [-].
    """
    offsets, members = np.asarray(offsets, float), np.asarray(members, bool)
    estimate = np.asarray(estimate, float)
    reach = np.sqrt(cbar2) * np.broadcast_to(noise_bound, len(offsets))
    figure = new_figure((10, 3.6))
    for k, axes in enumerate(figure.subplots(1, 3)):
        order = np.argsort(offsets[:, k])
        x, r, kept = offsets[order, k] - estimate[k], reach[order], members[order, k]
        height = np.arange(len(x))
        for rows, color in ((~kept, PALE), (kept, GOOD)):
            axes.hlines(height[rows], x[rows] - r[rows], x[rows] + r[rows], color=color, linewidth=0.8)
            axes.scatter(x[rows], height[rows], s=7, color=color, linewidths=0, zorder=3)
        axes.axvline(0, color=INK, linewidth=1)
        half = 4 * float(np.median(reach)) if len(reach) else 1.0
        axes.set_xlim(-half, half)
        title = f"{'xyz'[k]}: {estimate[k]:.4g}, {kept.sum()} of {len(x)} agree"
        label(axes, title, "offset from the estimate", "point, sorted" if k == 0 else "")
    return figure


def plot_refinement(
    before: Float[np.ndarray, " n"], after: Float[np.ndarray, " n"], *, cbar2: float = 1.0
) -> Figure:
    """The joint residuals of all matches under the cascade's pose and under the refined one.

    Args:
        before, after: |b - s R a - t|^2 / beta^2 of each match [-].
        cbar2: Truncation [-].
    """
    figure = new_figure((9, 3.6))
    left, right = figure.subplots(1, 2)
    sizes = [np.sqrt(np.sort(np.asarray(r2, float))) for r2 in (before, after)]
    limit = 2.5 * np.sqrt(cbar2)
    for size, color, name in zip(sizes, (SRC, GOOD), ("cascade", "refined"), strict=True):
        inside = int((size <= np.sqrt(cbar2)).sum())
        cost = np.minimum(size**2, cbar2).sum()
        left.plot(size, np.arange(1, len(size) + 1), color=color, label=f"{name}: {inside} inliers")
        shown = size[size <= limit]
        right.hist(shown, bins=30, range=(0, limit), histtype="step", linewidth=1.4, color=color,
                   label=f"{name}: cost {cost:.5g}")  # fmt: skip
    shown = max((int((size <= limit).sum()) for size in sizes), default=1)
    left.set(xlim=(0, limit), ylim=(0, 1.05 * max(shown, 1)))
    right.set_xlim(0, limit)
    label(left, "matches explained within a residual", "residual / bound", "matches")
    label(right, "residuals of the explained matches", "residual / bound", "matches")
    for axes, corner in ((left, "lower right"), (right, "upper right")):
        _truncation(axes, cbar2)
        axes.legend(frameon=False, fontsize=8, loc=corner)
    return figure


def new_figure(size: tuple[float, float]) -> Figure:
    """An empty one, bound to no backend."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError as error:
        raise ImportError("plots need matplotlib: pip install 'teaser-jax[viz]'") from error
    layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08)
    return Figure(figsize=size, dpi=150, facecolor="white", layout=layout)


def _eye(points: np.ndarray, view: tuple[float, float] | None) -> np.ndarray:
    """Rows: right, up, towards the eye."""
    if view is None:
        reach = _reach(_centred(points))
        view = (50.0, -75.0) if reach[2] < 0.35 * reach[:2].max() else (18.0, -70.0)
    elevation, azimuth = np.radians(view)
    towards = np.array(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
    )
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    return np.stack([right, np.cross(towards, right), towards])


def _centred(points: np.ndarray) -> np.ndarray:
    return points - np.median(points, axis=0) if len(points) else points


def _reach(points: np.ndarray) -> np.ndarray:
    """Half the extent of each axis, without the farthest points."""
    return np.quantile(np.abs(points), 0.98, axis=0) if len(points) else np.ones(3)


def _cloud(axes: Axes, points: np.ndarray, color: str, size: float | None = None) -> None:
    """Points without perspective; the nearer, the more opaque."""
    from matplotlib.colors import to_rgb

    points = points[np.argsort(points[:, 2])]
    near = np.linspace(0.35, 0.95, len(points)) if size is None else np.ones(len(points))
    if size is None:  # as large as leaves the cloud transparent where it is drawn
        share = _reach(_centred(points))[:2].max() / max(np.ptp(axes.get_xlim()), 1e-300)
        size = float(np.clip(1e5 * share**2 / max(len(points), 1), 0.4, 6))
    colors = np.column_stack([np.tile(to_rgb(color), (len(points), 1)), near])
    axes.scatter(points[:, 0], points[:, 1], s=size, c=colors, linewidths=0, zorder=2, rasterized=True)


def _segments(axes: Axes, start: np.ndarray, end: np.ndarray, color: str, width: float, alpha: float) -> None:
    from matplotlib.collections import LineCollection

    ends = np.stack([start[:, :2], end[:, :2]], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=color, linewidths=width, alpha=alpha, zorder=1))


def _frame(axes: Axes, points: np.ndarray, title: str, color: str) -> None:
    """Equal axes around the points, the farthest left out, with a bar for the length unit."""
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
    for spine in axes.spines.values():
        spine.set_visible(False)
    length = _round_length(width / 3)
    x, y = low + 0.04 * height
    axes.plot([x, x + length], [y, y], color=INK, linewidth=2, solid_capstyle="butt")
    above = (x + length / 2, y + 0.02 * height)
    axes.text(*above, f"{length:g}", ha="center", va="bottom", fontsize=8, color=INK)
    axes.set_title(title, fontsize=11, color=color)


def _round_length(length: float) -> float:
    """The nearest of 1, 2, 5 times a power of ten at or below the length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(step for step in (1, 2, 5) if step * power <= length * (1 + 1e-9)))


def _edges(edge_bits: np.ndarray, clique: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    clique = np.asarray(clique, bool)
    return unpack_host(np.asarray(edge_bits), len(clique)), clique


def label(axes: Axes, title: str, x: str, y: str, *, counts: bool = True) -> None:
    """Title and axes in the style of all pictures; ``counts`` puts whole numbers at the vertical one."""
    from matplotlib.ticker import MaxNLocator

    axes.set_title(title, fontsize=10, color=INK)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    axes.yaxis.set_major_locator(MaxNLocator("auto", integer=counts, steps=[1, 2, 5, 10]))
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def _truncation(axes: Axes, cbar2: float) -> None:
    axes.axvline(np.sqrt(cbar2), color=BAD, linewidth=1, linestyle="--", label="truncation")


def legend(figure: Figure, colors: dict[str, str]) -> None:
    """Below the panels: what each colour is."""
    from matplotlib.lines import Line2D

    handles = [
        Line2D([], [], color=color, marker="" if name == "rejected matches" else "o", markersize=5,
               linestyle="-" if name in ("inliers", "rejected matches") else "", label=name)
        for name, color in colors.items()
    ]  # fmt: skip
    figure.legend(
        handles=handles,
        loc="outside lower center",
        ncols=min(len(handles), LEGEND_COLUMNS),
        frameon=False,
        fontsize=9,
    )
