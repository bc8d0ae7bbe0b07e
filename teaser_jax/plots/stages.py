"""Pictures of the stages behind an answer, one each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, UInt32

from teaser_jax.ground.arrays import AnyArray, Number
from teaser_jax.ground.bits import unpack_host
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
    new_figure,
    segments,
)


def plot_trims(
    values: Float[AnyArray, " k"],
    bounds: Float[AnyArray, " k"],
    estimate: Number | Float[AnyArray, ""],
    *,
    cbar2: Number = 1.0,
    truth: Number | None = None,
) -> Figure:
    """Draw the vote of the scale: where its measurements lie, and how many allow each scale.

    Left a histogram of the ratios of lengths: right matches make a peak. Right the number of intervals that
    hold each scale; the estimate stands in green, the truth dotted.

    Args:
        values, bounds: TRIMs s_ij and alpha_ij [-], from ``stages.pairs.trims``.
        estimate: The scale of the vote [-].
        cbar2: Truncation [-].
        truth: The true scale [-], if known.

    Raises:
        ImportError: If matplotlib is missing.

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


def plot_graph(edge_bits: UInt32[AnyArray, "n w"], clique: Bool[AnyArray, " n"]) -> Figure:
    """Draw the consistency graph: its adjacency matrix, clique first, and the degrees.

    The clique is the green square in the corner of the matrix, and the green bars of the degrees.

    Args:
        edge_bits: Packed bit rows, from ``stages.consistency.consistency_graph``.
        clique: Members.

    Raises:
        ImportError: If matplotlib is missing.
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
    edge_bits: UInt32[AnyArray, "n w"], clique: Bool[AnyArray, " n"], *, lines: int = 6000
) -> Figure:
    """Draw the clique inside the graph: members on a green ring, the others around it.

    The more members a match agrees with, the nearer it stands.

    Args:
        edge_bits: Packed bit rows of the consistency graph.
        clique: Members.
        lines: Number of edges outside the clique to draw.

    Raises:
        ImportError: If matplotlib is missing.
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
    segments(axes, place[i[outside]], place[j[outside]], PALE, 0.3, 0.5)
    segments(axes, place[i[inside]], place[j[inside]], GOOD, 0.5, min(1.0, 0.08 + 8 / max(size, 1)))
    x, y = place.T
    axes.scatter(x[~clique], y[~clique], s=6, color=INK, linewidths=0, alpha=0.6)
    axes.scatter(x[clique], y[clique], s=16, color=GOOD, linewidths=0, zorder=3)
    axes.set_title(f"{size} of {n} matches agree pairwise", fontsize=10, color=INK)
    axes.set_aspect("equal")
    axes.set_axis_off()
    return figure


def plot_residuals(
    squared: Float[AnyArray, " k"],
    kept: Bool[AnyArray, " k"],
    *,
    cbar2: Number = 1.0,
    of: str = "rotation measurements",
) -> Figure:
    """Draw a histogram of residuals, those that were kept in green and those that were truncated.

    The truncation is the dashed line; the last bar holds all that lie beyond.

    Args:
        squared: r^2 / delta^2 of each measurement [-]; what is no number counts as beyond all.
        kept: Those with weight 1 in the end.
        cbar2: Truncation [-].
        of: What was measured, for the title.

    Raises:
        ImportError: If matplotlib is missing.
    """
    squared, kept = np.asarray(squared, float), np.asarray(kept, bool)
    size = np.sqrt(np.where(np.isnan(squared), np.inf, squared))
    finite = size[np.isfinite(size)]
    figure = new_figure((6.4, 3.4))
    axes = figure.subplots()
    limit = max(2.0 * np.sqrt(cbar2), float(np.quantile(finite, 0.98)) if finite.size else 0.0)
    sets = [np.minimum(size[kept], limit), np.minimum(size[~kept], limit)]
    labels = [f"kept ({kept.sum()})", f"rejected ({(~kept).sum()})"]
    axes.set_xlim(0, limit)
    axes.hist(sets, bins=60, range=(0, limit), stacked=True, color=[GOOD, PALE], label=labels)
    _truncation(axes, cbar2)
    label(axes, f"residuals of the {of}", "residual / bound (the last bar holds all beyond)", "number")
    axes.legend(frameon=False, fontsize=8)
    return figure


def plot_translation(
    offsets: Float[AnyArray, "n 3"],
    noise_bound: Float[AnyArray, " n"],
    members: Bool[AnyArray, "n 3"],
    estimate: Float[AnyArray, "3"],
    *,
    cbar2: Number = 1.0,
) -> Figure:
    """Draw the vote of each axis of the translation: every point allows an interval.

    Points of the consensus are green and overlap at the estimate, which stands at zero.

    Args:
        offsets: b_i - s R a_i of the voters [length].
        noise_bound: beta_i of the voters [length].
        members: Voters in the consensus of each axis.
        estimate: The translation [length].
        cbar2: Truncation [-].

    Raises:
        ImportError: If matplotlib is missing.
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
    before: Float[AnyArray, " n"], after: Float[AnyArray, " n"], *, cbar2: Number = 1.0
) -> Figure:
    """Draw the joint residuals of all matches under the cascade's pose and under the refined one.

    Left the number of matches within each residual, right a histogram of the explained ones: refinement
    moves both to the left.

    Args:
        before, after: |b - s R a - t|^2 / beta^2 of each match [-].
        cbar2: Truncation [-].

    Raises:
        ImportError: If matplotlib is missing.
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


def _edges(edge_bits: np.ndarray, clique: np.ndarray) -> tuple[AnyArray, np.ndarray]:
    clique = np.asarray(clique, bool)
    return unpack_host(np.asarray(edge_bits), len(clique)), clique


def _truncation(axes: Axes, cbar2: Number) -> None:
    """Draw a dashed line where residuals are truncated."""
    axes.axvline(np.sqrt(cbar2), color=BAD, linewidth=1, linestyle="--", label="truncation")
