"""Pictures of what is proved and what is not: the cost and its bound, certified answers, error bounds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from teaser_jax.certify.certificate import Certificate, CertificateStatus
from teaser_jax.ground.arrays import AnyArray, Number
from teaser_jax.plots.style import (
    BAD,
    DST,
    GOOD,
    INK,
    PALE,
    SRC,
    Figure,
    label,
    legend,
    new_figure,
    without_spines,
)

AXES = {"x": SRC, "y": DST, "z": INK}


def plot_landscape(
    src: Float[AnyArray, "k 3"],
    dst: Float[AnyArray, "k 3"],
    certificate: Certificate,
    *,
    noise_bound: Any,
    cbar2: Number = 1.0,
) -> Figure:
    """Draw the cost of turning away from a certified rotation, and the level below which nothing can lie.

    Left the whole circle about each axis, right the neighbourhood of the rotation. No line enters the green
    band, and where the green dot stands on its edge, the rotation is optimal.

    Args:
        src, dst: The vectors that were measured, as the certificate got them [length].
        noise_bound: Their largest errors, one number or one each [length].
        cbar2: Truncation [-].
        certificate: Its polished rotation stands at zero degrees.

    Raises:
        ImportError: If matplotlib is missing.
    """
    src, dst = np.asarray(src, float), np.asarray(dst, float)
    bound = np.broadcast_to(np.asarray(noise_bound, float), len(src))
    status = CertificateStatus(int(certificate.status)).name
    figure = new_figure((10, 3.6))
    for axes, reach, title in zip(
        figure.subplots(1, 2), (180.0, 6.0), (f"Every rotation: {status}", "Close by"), strict=True
    ):
        degrees = np.linspace(-reach, reach, 721)
        for i, color in enumerate(AXES.values()):
            axes.plot(
                degrees, _costs_about(i, degrees, src, dst, certificate, bound, cbar2), color=color, lw=1
            )
        axes.axhline(float(certificate.lower_bound), color=GOOD, lw=1.2)
        axes.axhspan(0, float(certificate.lower_bound), color=GOOD, alpha=0.12, lw=0)
        axes.plot(0, float(_costs_about(0, np.zeros(1), src, dst, certificate, bound, cbar2)[0]), "o",
                  color=GOOD, markersize=5)  # fmt: skip
        axes.set_ylim(bottom=0)
        label(axes, title, "turned about an axis [deg]", "truncated cost (12)")
    colors = {f"about {name}": color for name, color in AXES.items()}
    legend(figure, colors | {"proved: no rotation lies below": GOOD})
    return figure


def _costs_about(
    axis: int, degrees: np.ndarray, src: np.ndarray, dst: np.ndarray, certificate: Certificate,
    bound: np.ndarray, cbar2: Number,
) -> np.ndarray:  # fmt: skip
    """Compute the truncated cost (12) of the certified rotation, turned about one axis by some angles."""
    from scipy.spatial.transform import Rotation

    vectors = np.deg2rad(degrees)[:, None] * np.eye(3)[axis]
    turned = np.asarray(certificate.rotation) @ Rotation.from_rotvec(vectors).as_matrix()
    residuals = dst - np.einsum("gij,kj->gki", turned, src)
    r2 = np.sum((residuals / bound[:, None]) ** 2, axis=2)
    return np.minimum(r2, cbar2).sum(axis=1)


def plot_certified(counts: Mapping[str, tuple[int, int]]) -> Figure:
    """Draw how many answers of each kind are certified, as shares of a bar: that says optimal, not right.

    Args:
        counts: For each kind of problem the number of certified answers and of all.

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((9, 0.8 + 0.38 * len(counts)))
    axes = figure.subplots()
    for row, (_, (certified, everything)) in enumerate(counts.items()):
        share = certified / max(everything, 1)
        axes.barh(row, share, color=GOOD, height=0.6)
        axes.barh(row, 1 - share, left=share, color=PALE, height=0.6)
        axes.text(1.02, row, f"{certified} of {everything}", va="center", fontsize=8, color=INK)
    axes.set_yticks(range(len(counts)), list(counts), fontsize=8, color=INK)
    axes.set_xlim(0, 1.18)
    axes.set_xticks([0, 0.5, 1], ["0", "50 %", "100 %"], fontsize=8)
    axes.invert_yaxis()
    without_spines(axes, "top", "right", "left")
    legend(figure, {"certified": GOOD, "not certified": PALE})
    return figure


def plot_bounds(
    errors: Mapping[str, tuple[Float[AnyArray, " p"], Float[AnyArray, " p"]]], *, unit: str = "deg"
) -> Figure:
    """Draw true errors against their bounds, on logarithmic axes: no dot may lie above the diagonal.

    Args:
        errors: For each kind of bound the true errors and the bounds, in one unit.
        unit: The name of that unit, for the axes.

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((5.6, 4.6))
    axes = figure.subplots()
    colors = dict(zip(errors, (GOOD, SRC, DST, BAD), strict=False))
    drawn = [np.asarray(x, float) for pair in errors.values() for x in pair]
    finite = np.concatenate([x[np.isfinite(x) & (x > 0)] for x in drawn] or [np.ones(1)])
    low, high = finite.min() / 1.5, finite.max() * 1.5
    axes.fill_between([low, high], [low, high], [high, high], color=BAD, alpha=0.08, lw=0)
    axes.plot([low, high], [low, high], color=INK, lw=0.8)
    for name, (true, bounds) in errors.items():
        axes.loglog(bounds, true, "o", color=colors[name], markersize=3.5, alpha=0.8)
    axes.set_xlim(low, high)
    axes.set_ylim(low, high)
    axes.set_xlabel(f"bound [{unit}]", fontsize=9, color=INK)
    axes.set_ylabel(f"true error [{unit}]", fontsize=9, color=INK)
    axes.tick_params(labelsize=8, colors=INK)
    without_spines(axes, "top", "right")
    legend(figure, colors)
    return figure
