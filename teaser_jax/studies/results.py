"""What a study has found so far: its table, cell by cell and method by method."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.looks import KNOWN
from teaser_jax.studies.methods import Row
from teaser_jax.studies.study import Study
from teaser_jax.studies.table import read_table, written

TABLE, ABOUT, PICTURE, PAGE = "table.csv", "about.json", "figure.png", "figure.html"


@dataclass(frozen=True, eq=False)
class Results:
    """``Results`` are the rows of a study's table, to be asked by cell and by method.

    Attributes:
        study: The study.
        about: What ``about.json`` says: model, seed, machines and versions.
        rows: The rows of the table.
    """

    study: Study
    about: dict[str, Any]
    rows: list[Row]

    @property
    def title(self) -> str:
        """The title of the figure says what is drawn, with which model, and how many runs there are."""
        runs = sorted({len(rows) for rows in self._cells.values()})
        spread = f"{runs[0]}" if len(runs) == 1 else f"{runs[0]} to {runs[-1]}" if runs else "0"
        return f"{self.study.title}; model: {self.about['model']}; {spread} runs a box ({self.study.figure})"

    @cached_property
    def _cells(self) -> dict[tuple[str, str], list[Row]]:
        """The rows that each method has in each cell."""
        found: dict[tuple[str, str], list[Row]] = {}
        for row in self.rows:
            found.setdefault((row["method"], written(row[self.study.sweep])), []).append(row)
        return found

    @property
    def values(self) -> list[Number]:
        """The values of the cells that the table has, in the study's order."""
        there = {value for _, value in self._cells}
        return [v for v in self.study.values if written(v) in there]

    @property
    def methods(self) -> list[str]:
        """The methods that the table has: the study's, those whose package is missing here, and users'."""
        order = [*dict.fromkeys([*(method.name for method in self.study.methods), *KNOWN])]
        there = sorted({method for method, _ in self._cells})
        return sorted(there, key=lambda name: order.index(name) if name in order else len(order))

    def label(self, method: str) -> str:
        """Name a method for a reader, who sees of how large batches the time is a share, if it is one."""
        together = sorted(
            {int(row["together"]) for row in self.rows if row["method"] == method and "together" in row}
        )
        if not together:
            return method
        return f"{method} (batches of {' to '.join(map(str, dict.fromkeys((together[0], together[-1]))))})"

    def of(self, method: str, value: Number) -> list[Row]:
        """Return the rows of one method and cell."""
        return self._cells.get((method, written(value)), [])

    def measured(self, method: str, value: Number, column: str) -> np.ndarray:
        """Return the numbers that a column has in one cell; runs that raised have none."""
        return np.array([row[column] for row in self.of(method, value) if column in row])

    def has(self, method: str, column: str) -> bool:
        """Tell whether any row of a method has a number in a column."""
        return any(row["method"] == method and column in row for row in self.rows)

    def success(self, method: str, value: Number) -> float:
        """Return the share of the runs of a cell that have an accepted answer; NaN without runs."""
        rows = self.of(method, value)
        return float(np.mean([self.study.right(row) for row in rows])) if rows else float("nan")


def read_results(place: str | Path) -> Results:
    """Read the results of a study.

    Args:
        place: The folder of the study, which holds its table.

    Raises:
        FileError: If it is no such folder, or its files are broken.
    """
    place = Path(place)
    try:
        about = json.loads((place / ABOUT).read_text(encoding="utf-8"))
        study = studies()[about["study"]]
    except FileNotFoundError:
        raise FileError(f"{place}: no study there: run teaser-jax study first.") from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise FileError(f"{place / ABOUT}: is no description of a study ({error}).") from error
    return Results(study, about, read_table(place / TABLE))
