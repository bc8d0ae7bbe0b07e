"""Run a study: the rows that its table lacks, then its figure. Whatever ends it, it goes on where it was."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from importlib import metadata
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

import jax
from jax.sharding import Mesh

from teaser_jax.engine.processes import all_of, check_agreement
from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError, one_line, os_errors_named, replacing
from teaser_jax.studies.answers import read_answers
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.figures import check_drawing, draw_study
from teaser_jax.studies.methods import Method, Row
from teaser_jax.studies.results import ABOUT, TABLE
from teaser_jax.studies.study import Study
from teaser_jax.studies.table import Table, written
from teaser_jax.studies.trials import TEAPOT, Model, Origin, StudyError, Trial, check_seed

PACKAGES = ("teaser-jax", "jax", "jaxlib", "numpy", "numba", "scs", "kiss-matcher", "open3d-cpu", "open3d")


class Todo(NamedTuple):
    """A ``Todo`` lists the runs of one cell and method that a table lacks."""

    value: Number
    method: Method
    numbers: list[int]


def run_study(
    name: str,
    folder: str | Path,
    *,
    runs: int | None = None,
    seed: int = 0,
    model: Model = TEAPOT,
    methods: Sequence[str] | None = None,
    mesh: Mesh | None = None,
    quick: bool = False,
    progress: bool = False,
    score: str | Path | Sequence[str | Path] = (),
) -> Path:
    """Run one of the paper's studies, or go on with it, and draw its figure.

    Every problem follows from the study, the seed, the cell and the run, so that all methods see the same
    ones and a table that was interrupted is finished as if it had not been: rows that are there stay, the
    others are computed. Ask for more ``runs`` or other ``methods`` later to add to a table.

    Args:
        name: One of ``studies()``.
        folder: Where ``NAME/table.csv``, ``about.json``, ``figure.png`` and ``figure.html`` go.
        runs: Problems a cell; None: the study's own, 40 or more.
        seed: The seed of the whole study.
        model: What points are drawn from, see ``read_model``.
        methods: Names of those that take part; None: all, in a quick study without the slow ones.
        mesh: Devices for the methods that take problems in batches; None: all. Under ``jax.distributed``
            every process calls, shares the work, and the first one writes.
        quick: A few cells of three runs each, in two minutes. What solves in batches is timed on a large one,
            which repeats these problems; the legend says how many.
        progress: Show a bar with the time left.
        score: Files with answers of other programs to the problems of ``save_trials``; each program becomes
            one more method. ``answers.read_answers`` describes the format.

    Returns:
        The folder of the study.

    Raises:
        StudyError: On names, runs or seeds that make no sense; it is a ValueError.
        FileError: If the folder holds a study of another model or seed, or other answers of a method that is
            scored, or cannot be written; on files to score that cannot be used.
        ImportError: Without the extra ``studies``, before anything is computed.
    """
    check_drawing()
    study, seed = named_study(name), check_seed(seed)
    files = [score] if isinstance(score, str | Path) else list(score)
    cells, chosen = study.cells(runs, quick=quick), _chosen(study, methods, quick)
    scored = read_answers(files, study, study.origin(seed, model), cells)
    work = _Work(study, seed, model, cells, chosen, mesh, scored)
    work.check()
    asked = (name, runs, seed, model.name, model.shape, methods, quick, [str(path) for path in files])
    check_agreement("run_study", asked, error=StudyError)
    place = Path(folder) / name
    _fill(place, work, progress)
    if jax.process_index() == 0:
        draw_study(place)
    return place


class _Work(NamedTuple):
    """What was asked of a study, and those that do it."""

    study: Study
    seed: int
    model: Model
    cells: list[tuple[Number, range]]
    methods: list[Method]
    mesh: Mesh | None
    scored: list[Method]

    def trial(self, value: Number, number: int = 0) -> Trial:
        return self.study.trial(self.seed, value, number, self.model)

    def check(self) -> None:
        """Raise StudyError now, before anything is written, if a cell cannot be drawn."""
        for value, _ in self.cells:
            self.trial(value)

    def todo(self, known: set[tuple[Any, ...]]) -> Iterator[Todo]:
        """List the runs that are missing, of the methods that the first trial of a cell suits."""
        for value, numbers in self.cells:
            first = self.trial(value)
            for method in (*self.methods, *self.scored):
                missing = [k for k in numbers if (written(value), k, method.name) not in known]
                if missing and method.suits(first):
                    yield Todo(value, method, missing)

    def rows(self, todo: Sequence[Todo]) -> Iterator[list[Row]]:
        """Compute rows of the table as they come, cell by cell."""
        for value, cell in groupby(todo, key=lambda t: t.value):
            listed = list(cell)
            numbers = sorted({k for each in listed for k in each.numbers})
            trials = {k: self.trial(value, k) for k in numbers}
            for _, method, some in listed:
                yield from _answers(self.study, method, [trials[k] for k in some], self.mesh)


def _fill(place: Path, work: _Work, progress: bool) -> None:
    """Compute the rows that the table lacks; in every process, of which the first one writes."""
    from tqdm import tqdm

    with ExitStack() as stack:
        table, known, failure = None, set(), None
        if jax.process_index() == 0:
            try:
                table = stack.enter_context(_opened(place, work))
                _check_scored(table, work)
                known = {_key(row, work.study) for row in table.rows}
            except FileError as error:
                failure = str(error)
        known, failure = all_of((known, failure))[0]
        if failure is not None:
            raise FileError(failure)  # in every process, or the others would wait
        todo = list(work.todo(known))
        count = sum(len(each.numbers) for each in todo)
        bar = stack.enter_context(tqdm(total=count, disable=not progress, unit="row", desc=work.study.name))
        for rows in work.rows(todo):
            if table is not None:
                table.append(rows)
            bar.update(len(rows))


def _check_scored(table: Table, work: _Work) -> None:
    """Raise FileError if the table has other answers of a method that is scored: those rows would stay."""
    before = {_key(row, work.study): table.fields(row) for row in table.rows}
    for method in work.scored:
        for value, numbers in work.cells:
            there = [k for k in numbers if (written(value), k, method.name) in before]
            trials = [work.trial(value, k) for k in there]
            for row in _named(work.study, method, trials, method.run(trials, None)):
                if before[_key(row, work.study)] != table.fields(row):
                    raise FileError(
                        f"{table.path}: holds other answers of {method.name!r}: give the method another "
                        "name in the file, or remove its rows from the table."
                    )


def _answers(study: Study, method: Method, trials: list[Trial], mesh: Mesh | None) -> Iterator[list[Row]]:
    """Ask a method about trials of one cell, together or one by one, shared among the processes."""
    named = partial(_named, study, method)
    if method.together:
        yield named(trials, method.run(trials, mesh))
    elif jax.process_count() == 1:
        for trial in trials:
            yield named([trial], _guarded(method, trial))
    else:
        share = trials[jax.process_index() :: jax.process_count()]
        rows = [row for trial in share for row in named([trial], _guarded(method, trial))]
        yield [row for some in all_of(rows) for row in some]


def _named(study: Study, method: Method, trials: list[Trial], measured: list[Row]) -> list[Row]:
    """Say in rows of which cell, run and method they are."""
    return [
        {study.sweep: t.value, "trial": t.number, "method": method.name} | row
        for t, row in zip(trials, measured, strict=True)
    ]


def _guarded(method: Method, trial: Trial) -> list[Row]:
    """Ask a method about one trial; if it is another library and raises, the row says so."""
    try:
        return method.run([trial], None)
    except Exception as error:
        if not method.others:
            raise
        return [{"error": f"{type(error).__name__}: {one_line(error)}"}]


def _key(row: Row, study: Study) -> tuple[Any, ...]:
    """Tell which cell, run and method a row is of."""
    return written(row[study.sweep]), int(row["trial"]), row["method"]


def _opened(place: Path, work: _Work) -> Table:
    """Open the table of a study in its folder, which must be of the same problems; note this environment."""
    study, origin = work.study, work.study.origin(work.seed, work.model)
    about = {"figure": study.figure, "title": study.title, "sweep": study.sweep, **asdict(origin)}
    path = place / ABOUT
    with os_errors_named(place, "cannot be written"):
        place.mkdir(parents=True, exist_ok=True)
        try:
            made_with = _made_with(place, origin)
        except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError, AttributeError) as error:
            raise FileError(f"{path}: is no description of a study ({error}): remove the folder.") from error
        table = Table(place / TABLE, (study.sweep, "trial", "method", *study.columns, "error"))
        with replacing(path) as partial:
            partial.write_text(json.dumps(about | {"made_with": made_with}, indent=1) + "\n")
        return table


def _made_with(place: Path, origin: Origin) -> list[dict[str, Any]]:
    """List the environments that have worked on a study, and this one; FileError if it is another study."""
    path, here = place / ABOUT, environment()
    if not path.exists():
        return [here]
    before = json.loads(path.read_text(encoding="utf-8"))
    if differs := origin.unlike(before):
        raise FileError(
            "{}: holds a study of {} {!r}, and {!r} is asked for: name another folder.".format(
                place, *differs
            )
        )
    made_with: list[dict[str, Any]] = before["made_with"]
    return [*made_with, *([] if here in made_with else [here])]


def environment() -> dict[str, Any]:
    """Tell which machine and which versions of packages this is, as a report states them."""
    versions = {}
    for package in PACKAGES:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            continue
    device = jax.devices()[0]
    return {
        "processor": f"{processor()}, {os.cpu_count()} cores",
        "devices": f"{jax.device_count()} x {device.device_kind} ({device.platform})",
        "processes": jax.process_count(),
        "python": platform.python_version(),
        "versions": versions,
    }


def processor() -> str:
    """Tell the name of the processor, as the system knows it."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    named = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return named[0] if named else platform.processor() or platform.machine()


def named_study(name: str) -> Study:
    """Return one of ``studies()``, or raise StudyError with their names."""
    known = studies()
    if name not in known:
        raise StudyError(f"there is no study {name!r}: expected one of {', '.join(known)}.")
    return known[name]


def _chosen(study: Study, names: Sequence[str] | None, quick: bool) -> list[Method]:
    """Choose the methods that take part by their names, or raise StudyError."""
    if names is None:
        return [each for each in study.methods if not (quick and each.slow)]
    known = {each.name: each for each in study.methods}
    for name in names:
        if name not in known:
            raise StudyError(
                f"{name!r} takes no part in {study.name}, or its package is missing: expected some of "
                f"{', '.join(map(repr, known))}."
            )
    return [known[name] for name in names]
