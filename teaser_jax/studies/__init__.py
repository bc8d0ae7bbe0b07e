"""The paper's studies: thousands of problems by its protocol, ours and others beside one another.

``run_study("known-scale", "studies", quick=True)`` writes a table and its figure; ``studies()`` lists all.
``save_trials`` writes the problems for another program, and ``run_study(..., score="mine.npz")`` takes its
answers as one more method. The command line is ``teaser-jax study``. The extra ``studies`` draws the figures
and reads models.
"""

from teaser_jax.studies.answers import COPIED, read_answers
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.figures import draw_study
from teaser_jax.studies.methods import Method
from teaser_jax.studies.results import Results, read_results
from teaser_jax.studies.run import run_study
from teaser_jax.studies.shards import draw_trials, read_trials, save_trials
from teaser_jax.studies.study import Measure, Study
from teaser_jax.studies.table import read_table
from teaser_jax.studies.trials import TEAPOT, Model, Origin, StudyError, Trial, read_model

__all__ = [
    "COPIED", "TEAPOT", "Measure", "Method", "Model", "Origin", "Results", "Study", "StudyError", "Trial",
    "draw_study", "draw_trials", "read_answers", "read_model", "read_results", "read_table", "read_trials",
    "run_study", "save_trials", "studies",
]  # fmt: skip
