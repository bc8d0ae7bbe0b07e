"""One picture for whatever was registered, matched points or raw clouds."""

from __future__ import annotations

from typing import Any

from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.plots.answer import plot_registration
from teaser_jax.plots.clouds import plot_clouds
from teaser_jax.plots.style import Figure
from teaser_jax.register import Registration


def plot(result: Registration | CloudRegistration, src: Any = None, dst: Any = None) -> Figure:
    """Draw an answer of ``register`` or of ``register_clouds``: the points before and after.

    ``plots.plot_registration`` and ``plots.plot_clouds`` say what is seen, and have more choices.

    Args:
        result: The answer.
        src, dst: (n, 3) the points to draw; None: those of the answer, as they were registered [length].

    Returns:
        A ``matplotlib.figure.Figure``, which ``figure.savefig(path)`` saves.

    Raises:
        ImportError: If matplotlib is missing.
    """
    if isinstance(result, CloudRegistration):
        return plot_clouds(result, src, dst)
    src = result.problem.src if src is None else src
    dst = result.problem.dst if dst is None else dst
    return plot_registration(src, dst, result)
