"""What a study is: the problems of its cells, those that take part, and what is measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.checks import whole_number
from teaser_jax.studies.methods import Method, Row
from teaser_jax.studies.trials import Draw, Model, Origin, StudyError, Trial, seed_of

OUTLIERS, OVERLAP, MATCHES = "outlier_rate", "overlap", "n"  # what can be swept
LABELS = {OUTLIERS: "wrong matches", OVERLAP: "overlap", MATCHES: "matches"}
QUICK_RUNS = 3


@dataclass(frozen=True)
class Measure:
    """A ``Measure`` is a column of the table that the figure shows.

    Attributes:
        column: The name of the column.
        label: What the axis says, with the unit.
        log: Whether the axis is logarithmic.
    """

    column: str
    label: str
    log: bool = True


@dataclass(frozen=True)
class Study:
    """A ``Study`` is one figure of the paper.

    Attributes:
        name: The name on the command line, and of the folder.
        figure: The figure of the paper.
        title: What is drawn, without the model.
        sweep: The quantity that is swept: the share of wrong matches, the overlap, or the number of matches.
        values: Its values, a cell each.
        quick_values: The values of a quick study.
        draw: Makes the problem of a seed and a value, from a model.
        methods: Those that take part here, each with its own name.
        measures: What the figure shows, a panel each.
        columns: What the table holds, beside cell, run, method and error.
        right: Whether a row is an accepted answer.
        scale: The known scale [-], or None.
        runs: Problems a cell.
    """

    name: str
    figure: str
    title: str
    sweep: str
    values: tuple[Number, ...]
    quick_values: tuple[Number, ...]
    draw: Draw
    methods: tuple[Method, ...]
    measures: tuple[Measure, ...]
    columns: tuple[str, ...]
    right: Callable[[Row], bool]
    scale: float | None = 1.0
    runs: int = 40

    def cells(self, runs: int | None = None, *, quick: bool = False) -> list[tuple[Number, range]]:
        """List the values that are swept, each with the numbers of its runs.

        Args:
            runs: Problems a cell; None: the study's own, or three in a quick study.
            quick: Whether to take ``quick_values``.

        Raises:
            StudyError: If there would be no run.
        """
        usual = QUICK_RUNS if quick else self.runs
        count = usual if runs is None else whole_number("runs", runs, 1, error=StudyError)
        return [(value, range(count)) for value in (self.quick_values if quick else self.values)]

    def origin(self, seed: int, model: Model) -> Origin:
        """Say what the problems of a seed and a model are drawn from."""
        return Origin(self.name, seed, model.name, model.crc32)

    def trial(self, seed: int, value: Number, number: int, model: Model) -> Trial:
        """Draw one problem of a cell; the same for the same arguments, on every machine.

        Args:
            seed: The seed of the whole study.
            value: The value of the cell.
            number: The number of the run in its cell.
            model: What points are drawn from.

        Raises:
            StudyError: If the model has too few points for it, or no area.
        """
        try:
            problem = self.draw(seed_of(self.name, seed, value, number), value, model)
        except ValueError as error:
            raise StudyError(f"{self.name} cannot draw from the model {model.name!r}: {error}") from error
        origin = self.origin(seed, model)
        return Trial(value, number, problem, self.scale, origin)


def below(**limits: Number) -> Callable[[Row], bool]:
    """Make a test of rows: whether every one of these measures is a number below its limit."""
    return lambda row: all(row.get(column, np.nan) < limit for column, limit in limits.items())
