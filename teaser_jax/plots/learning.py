"""Pictures of gradients, of uncertainty, and of training."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from teaser_jax.ground.arrays import AnyArray
from teaser_jax.learn.training import History
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

COLORS = (GOOD, DST, SRC, BAD, INK)
RIGHT = np.radians(10.0)  # of a label's rotation, for the statistics
CHI2 = 5.991  # of two numbers, at 95 %


def plot_slopes(
    residuals: Float[AnyArray, " n"],
    hard: Float[AnyArray, " n"],
    soft: Float[AnyArray, " n"],
    weights: Float[AnyArray, " n"],
) -> Figure:
    """Draw how much the pose would feel a shift of each match, through ``solve`` and ``soft_solve``.

    Left the weight of a match falls with its residual; right the gradients: those of ``solve`` end at the
    threshold, those of ``soft_solve`` reach beyond it.

    Args:
        residuals: Residuals in units of the bounds [-].
        hard, soft: Length of the gradient by the target point, through ``solve`` and ``soft_solve``.
        weights: Weights of ``soft_solve`` [-].

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((10, 3.4))
    left, right = figure.subplots(1, 2)
    shown = np.asarray(residuals) < 2.5
    _dots(left, residuals, weights, shown, GOOD)
    _dots(right, residuals, hard, shown, PALE)
    _dots(right, residuals, soft, shown, GOOD)
    label(left, "How far a match counts", "residual [bounds]", "weight of soft_solve", counts=False)
    label(right, "What a shift of it would do", "residual [bounds]", "|gradient|", counts=False)
    for axes in (left, right):
        axes.axvline(1, color=INK, lw=0.8, ls=":")
    legend(figure, {"soft_solve": GOOD, "solve": PALE, "threshold": INK})
    return figure


def plot_errors(
    errors: Float[AnyArray, "runs 6"], covariance: Float[AnyArray, "6 6"], *, unit: str = "length"
) -> Figure:
    """Draw the errors of many runs in the ellipse that should hold 95 % of them, for turns and for shifts.

    The title of each panel says how many are inside.

    Args:
        errors: Turn [rad], then shift [length], in the coordinates of ``convention="right"``.
        covariance: Their covariance, as ``covariance(..., convention="right")`` gives it.
        unit: The name of the unit of lengths.

    Raises:
        ImportError: If matplotlib is missing.
        ValueError: If the covariance is of no ellipse, as that of an answer that is not ok.
    """
    errors, covariance = np.asarray(errors), np.asarray(covariance)
    if not np.all(np.isfinite(covariance)) or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise ValueError(
            "the covariance is not finite and positive definite, so it has no ellipse: nothing is known of "
            "an answer that is not ok."
        )
    figure = new_figure((10, 4))
    parts = (
        ("Turn", (0, 1), 180 / np.pi, "deg"), ("Shift", (3, 4), 1.0, unit), ("Both", (0, 4), 1.0, "")
    )  # fmt: skip
    for axes, (title, pair, factor, of) in zip(figure.subplots(1, 3), parts, strict=True):
        shown, block = errors[:, pair], covariance[np.ix_(pair, pair)]
        inside = _draw_ellipse(axes, factor * shown, factor**2 * block)
        names = [
            ("turn" if i < 3 else "shift") + f" {'xyz'[i % 3]}" + (f" [{of}]" if of else "") for i in pair
        ]
        label(axes, f"{title}: {100 * inside:.1f} % inside", *names, counts=False)
    legend(figure, {"runs": PALE, "95 % of the covariance": GOOD})
    return figure


def plot_training(histories: Mapping[str, History], *, window: int = 25) -> Figure:
    """Draw loss, trusted share, and how many of the trusted labels were right, over the steps of training.

    Each history has a colour. Where the solver teaches, the trusted share rises with the network.

    Args:
        histories: What ``train`` returned, by the names for the legend.
        window: Steps that a mean is taken over.

    Raises:
        ImportError: If matplotlib is missing.
    """
    figure = new_figure((11, 3.6))
    panels = figure.subplots(1, 3)
    loss, share, right = panels
    for history, color in zip(histories.values(), COLORS, strict=False):
        for axes, values in zip(panels, _curves(history, window), strict=True):
            axes.plot(values, color=color, lw=1.4)
    label(loss, "Loss", "step", "contrastive loss [nat]", counts=False)
    label(share, "Pairs that the teacher trusts", "step", "share", counts=False)
    label(right, "Trusted labels that are right", "step", "share within 10 deg", counts=False)
    for axes in (share, right):
        axes.set_ylim(0, 1.03)
    legend(figure, dict(zip(histories, COLORS, strict=False)))
    return figure


def _dots(axes: Axes, x: AnyArray, y: AnyArray, shown: Bool[np.ndarray, " n"], color: str) -> None:
    axes.plot(np.asarray(x)[shown], np.asarray(y)[shown], "o", color=color, markersize=4)


def _draw_ellipse(axes: Axes, errors: np.ndarray, covariance: np.ndarray) -> float:
    """Draw errors of two numbers with the ellipse of their covariance, and return the share inside it."""
    angle = np.linspace(0, 2 * np.pi, 200)
    circle = np.sqrt(CHI2) * np.stack([np.cos(angle), np.sin(angle)])
    axes.plot(*errors.T, ".", color=PALE, markersize=3)
    axes.plot(*(np.linalg.cholesky(covariance) @ circle), color=GOOD, lw=1.4)
    return float(np.mean(np.einsum("ri,ij,rj->r", errors, np.linalg.inv(covariance), errors) < CHI2))


def _curves(history: History, window: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Smooth the loss, the trusted share, and the share of right ones among the trusted labels."""
    trusted = np.asarray(history.trusted, float)
    good = trusted * (np.asarray(history.angle) < RIGHT)
    with np.errstate(invalid="ignore", divide="ignore"):  # where nothing was trusted
        right = _smooth(good.sum(axis=1), window) / _smooth(trusted.sum(axis=1), window)
    return _smooth(np.asarray(history.loss), window), _smooth(trusted.mean(axis=1), window), right


def _smooth(values: np.ndarray, window: int) -> np.ndarray:
    """Average the last ``window`` values, fewer at the start."""
    sums = np.cumsum(np.nan_to_num(values))
    before = np.concatenate([np.zeros(window), sums])[: len(sums)]
    return (sums - before) / np.minimum(np.arange(1, len(sums) + 1), window)
