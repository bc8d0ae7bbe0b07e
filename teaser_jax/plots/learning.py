"""Pictures of gradients, of uncertainty, and of training."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from teaser_jax.learn.training import History
from teaser_jax.plots.stages import BAD, DST, GOOD, INK, PALE, SRC, label, legend, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLORS = (GOOD, DST, SRC, BAD, INK)
RIGHT = np.radians(10.0)  # of a label's rotation, for the statistics


def plot_slopes(
    residuals: Float[np.ndarray, " n"],
    hard: Float[np.ndarray, " n"],
    soft: Float[np.ndarray, " n"],
    weights: Float[np.ndarray, " n"],
) -> Figure:
    """How much the pose would feel a shift of each match: through ``solve`` and through ``soft_solve``.

    Args:
        residuals: In units of the bounds.
        hard, soft: Length of the gradient by the target point, through either.
        weights: Of ``soft_solve``.

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((10, 3.4))
    left, right = figure.subplots(1, 2)
    shown = np.asarray(residuals) < 2.5
    left.plot(np.asarray(residuals)[shown], np.asarray(weights)[shown], "o", color=GOOD, markersize=4)
    label(left, "How far a match counts", "residual [bounds]", "weight of soft_solve", counts=False)
    for values, color in ((hard, PALE), (soft, GOOD)):
        right.plot(np.asarray(residuals)[shown], np.asarray(values)[shown], "o", color=color, markersize=4)
    label(right, "What a shift of it would do", "residual [bounds]", "|gradient|", counts=False)
    for axes in (left, right):
        axes.axvline(1, color=INK, lw=0.8, ls=":")
    legend(figure, {"soft_solve": GOOD, "solve": PALE, "threshold": INK})
    return figure


def plot_errors(
    errors: Float[np.ndarray, "runs 6"], covariance: Float[np.ndarray, "6 6"], *, unit: str = "length"
) -> Figure:
    """Errors of many runs, with the ellipse that should hold 95 % of them, for turns and for shifts.

    Args:
        errors: In the coordinates of ``convention="right"``: turn, then shift.
        covariance: In the same coordinates.
        unit: Of lengths.

    Raises:
        ImportError: If matplotlib is missing.
    """
    errors, covariance = np.asarray(errors), np.asarray(covariance)
    figure = new_figure((10, 4))
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = np.sqrt(5.991) * np.stack([np.cos(angle), np.sin(angle)])  # chi^2 of two numbers, 95 %
    parts = (
        ("Turn", (0, 1), 180 / np.pi, "deg"), ("Shift", (3, 4), 1.0, unit), ("Both", (0, 4), 1.0, "")
    )  # fmt: skip
    for axes, (title, pair, factor, of) in zip(figure.subplots(1, 3), parts, strict=True):
        block = covariance[np.ix_(pair, pair)]
        inside = np.einsum("ri,ij,rj->r", errors[:, pair], np.linalg.inv(block), errors[:, pair]) < 5.991
        axes.plot(*(factor * errors[:, pair].T), ".", color=PALE, markersize=3)
        axes.plot(*(factor * np.linalg.cholesky(block) @ circle), color=GOOD, lw=1.4)
        names = [
            ("turn" if i < 3 else "shift") + f" {'xyz'[i % 3]}" + (f" [{of}]" if of else "") for i in pair
        ]
        label(axes, f"{title}: {100 * inside.mean():.1f} % inside", *names, counts=False)
    legend(figure, {"runs": PALE, "95 % of the covariance": GOOD})
    return figure


def plot_training(histories: Mapping[str, History], *, window: int = 25) -> Figure:
    """Loss, trusted share, and how many of the trusted labels were right, over the steps.

    Args:
        histories: By name.
        window: Steps that a mean is taken over.

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((11, 3.6))
    loss, share, right = figure.subplots(1, 3)
    for (_, history), color in zip(histories.items(), COLORS, strict=False):
        trusted = np.asarray(history.trusted, float)
        good = trusted * (np.asarray(history.angle) < RIGHT)
        loss.plot(_smooth(np.asarray(history.loss), window), color=color, lw=1.4)
        share.plot(_smooth(trusted.mean(axis=1), window), color=color, lw=1.4)
        each = _smooth(trusted.sum(axis=1), window)
        with np.errstate(invalid="ignore", divide="ignore"):
            right.plot(_smooth(good.sum(axis=1), window) / each, color=color, lw=1.4)
    label(loss, "Loss", "step", "contrastive loss [nat]", counts=False)
    label(share, "Pairs that the teacher trusts", "step", "share", counts=False)
    label(right, "Trusted labels that are right", "step", "share within 10 deg", counts=False)
    for axes in (share, right):
        axes.set_ylim(0, 1.03)
    legend(figure, dict(zip(histories, COLORS, strict=False)))
    return figure


def _smooth(values: np.ndarray, window: int) -> np.ndarray:
    """The mean of the last ``window`` values, of fewer at the start."""
    sums = np.cumsum(np.nan_to_num(values))
    before = np.concatenate([np.zeros(window), sums])[: len(sums)]
    return (sums - before) / np.minimum(np.arange(1, len(sums) + 1), window)
