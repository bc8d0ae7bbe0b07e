"""The report: every figure, table and competitor of the paper beside what the tables of the studies say."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.paper.claims import CLAIMS, COMPETITORS, PaperClaim
from benchmarks.paper.verdicts import Models, Verdict, median
from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError, os_errors_named, replacing
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.results import ABOUT, PICTURE, Results, read_results
from teaser_jax.studies.study import LABELS, MATCHES, Measure

MARKS = {True: "yes", False: "**no**", None: "-"}


def write_report(folder: str | Path, output: str | Path) -> Path:
    """Write ``PAPER.md`` from the tables of the studies in a folder; nothing in it is written by hand.

    Args:
        folder: Where ``run_study`` put the studies; those that are missing are said to be. Folders in it may
            hold the same studies of other models, as ``FOLDER/bunny/known-scale``.
        output: The file, which appears whole or not at all. It shows the figures by relative paths.

    Returns:
        The file.

    Raises:
        FileError: If there is no study in the folder, a table is broken, or the file cannot be written.
    """
    folder, output = Path(folder), Path(output)
    found = _studies_in(folder)
    if not found:
        raise FileError(f"{folder}: holds no study: run teaser-jax study first.")
    inner = {path.name: _studies_in(path) for path in sorted(folder.iterdir()) if path.name not in studies()}
    models = {name: some for name, some in inner.items() if some}
    with os_errors_named(output, "cannot be written"), replacing(output) as page:
        text = "\n".join(_report(found, models, folder, output.parent))
        page.write_text(text + "\n", encoding="utf-8")
    return output


def _studies_in(folder: Path) -> dict[str, Results]:
    return {name: read_results(folder / name) for name in studies() if (folder / name / ABOUT).exists()}


def _report(found: dict[str, Results], models: Models, folder: Path, here: Path) -> Iterator[str]:
    yield "# The paper, reproduced"
    yield ""
    yield (
        "*TEASER: Fast and Certifiable Point Cloud Registration* (Yang, Shi, Carlone, T-RO 2021), section "
        "XI, by its protocol. `teaser-jax study all` fills the tables and `python -m benchmarks.paper` "
        "writes this page from them, on any machine."
    )
    yield ""
    yield from _claims(found, models)
    yield from _competitors(found)
    for name, study in studies().items():
        yield f"## {name}"
        yield ""
        if name in found:
            yield from _section(found[name], Path(os.path.relpath(folder / name, here)))
        else:
            yield f"Not run: `teaser-jax study {name}` ({study.figure}, {study.title})."
            yield ""
    yield from _other_models(models)


def _other_models(models: Models) -> Iterator[str]:
    if not models:
        return
    yield "## Other models"
    yield ""
    yield "Share of right answers where the points are drawn from another model."
    yield ""
    for name, found in models.items():
        yield f"### {name}"
        yield ""
        for results in found.values():
            about = results.about
            yield (
                f"{results.title}; seed {about['seed']}. `teaser-jax study {results.study.name} --model ... "
                f"--folder .../{name}`"
            )
            yield ""
            yield from _successes(results)
        yield from _made_with([made for results in found.values() for made in results.about["made_with"]])


def _claims(found: dict[str, Results], models: Models) -> Iterator[str]:
    yield "## Every figure and table"
    yield ""
    yield "A **no** beside another library means that it does better here than in the paper."
    yield ""
    yield "| paper | what it reports | here | reproduced |"
    yield "|---|---|---|---|"
    for claim in CLAIMS:
        verdict = _verdict(claim, found, models)
        yield f"| {claim.where} | {claim.text} | {verdict.found} | {MARKS[verdict.holds]} |"
    yield ""


def _verdict(claim: PaperClaim, found: dict[str, Results], models: Models) -> Verdict:
    if claim.of_models is not None:
        return claim.of_models(models)
    if claim.study is None or claim.test is None:
        return Verdict(claim.reason)
    if claim.study not in found:
        return Verdict("not run")
    return claim.test(found[claim.study])


def _competitors(found: dict[str, Results]) -> Iterator[str]:
    yield "## Every competitor"
    yield ""
    yield "| method | where |"
    yield "|---|---|"
    for name, word, reason in COMPETITORS:
        where = [study for study, results in found.items() if any(word in m for m in results.methods)]
        yield f"| {name} | {'measured in ' + ', '.join(where) if where else f'not here: {reason}'} |"
    yield ""


def _section(results: Results, place: Path) -> Iterator[str]:
    about = results.about
    yield f"{results.title}; seed {about['seed']}. `teaser-jax study {results.study.name}`"
    yield ""
    yield f"![{results.study.title}]({(place / PICTURE).as_posix()})"
    yield ""
    yield "Share of right answers."
    yield ""
    yield from _successes(results)
    for measure in results.study.measures:
        having = [m for m in results.methods if results.has(m, measure.column)]
        yield f"Median {measure.label}."
        yield ""
        label = results.label if measure.column == "seconds" else str
        yield from _grid(results, having, partial(_number, results, measure=measure), label)
    failed = [row for row in results.rows if "error" in row]
    if failed:
        first = failed[0]
        yield f"{len(failed)} runs of other libraries raised; first {first['method']}: {first['error']}"
        yield ""
    yield from _made_with(about["made_with"])


def _successes(results: Results) -> Iterator[str]:
    yield from _grid(results, results.methods, lambda m, v: f"{results.success(m, v):.0%}")


def _made_with(environments: list[dict[str, Any]]) -> Iterator[str]:
    for k, made in enumerate(environments):
        if made in environments[:k]:
            continue
        versions = ", ".join(f"{package} {version}" for package, version in made["versions"].items())
        yield f"*{made['processor']}; {made['devices']}; python {made['python']}; {versions}*"
        yield ""


def _grid(
    results: Results,
    methods: list[str],
    cell: Callable[[str, Number], str],
    label: Callable[[str], str] = str,
) -> Iterator[str]:
    values = results.values
    heads = [f"{v:g}" if results.study.sweep == MATCHES else f"{v:.0%}" for v in values]
    yield f"| {LABELS[results.study.sweep]} | " + " | ".join(heads) + " |"
    yield "|---" * (len(values) + 1) + "|"
    for method in methods:
        cells = [cell(method, v) if results.of(method, v) else "" for v in values]
        yield f"| {label(method)} | " + " | ".join(cells) + " |"
    yield ""


def _number(results: Results, method: str, value: Number, measure: Measure) -> str:
    number = median(results, method, value, measure.column)
    return "" if np.isnan(number) else f"{number:.2g}"
