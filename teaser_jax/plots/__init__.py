"""Pictures of an answer, of each stage behind it, and of what is proved.

Every function returns a ``matplotlib.figure.Figure`` of its own: nothing is shown, no global
matplotlib state is read for layout or changed, and any backend will do. Save one with
``figure.savefig(path)``; in a notebook it shows after ``%matplotlib inline``. ``view`` and ``write_view``
make a page that turns in a browser. Matplotlib and plotly are the extra ``viz`` and load when a function is
called.
"""

from teaser_jax.plots.answer import plot_registration
from teaser_jax.plots.clouds import plot_clouds
from teaser_jax.plots.either import plot
from teaser_jax.plots.learning import plot_errors, plot_slopes, plot_training
from teaser_jax.plots.proofs import plot_bounds, plot_certified, plot_landscape
from teaser_jax.plots.stages import (
    plot_clique,
    plot_graph,
    plot_refinement,
    plot_residuals,
    plot_translation,
    plot_trims,
)
from teaser_jax.plots.style import BAD, DST, GOOD, INK, PALE, SRC
from teaser_jax.plots.view import view, write_view

__all__ = [
    "BAD", "DST", "GOOD", "INK", "PALE", "SRC",
    "plot", "plot_bounds", "plot_certified", "plot_clique", "plot_clouds", "plot_errors", "plot_graph",
    "plot_landscape", "plot_refinement", "plot_registration", "plot_residuals", "plot_slopes",
    "plot_training", "plot_translation", "plot_trims", "view", "write_view",
]  # fmt: skip
