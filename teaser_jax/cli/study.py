"""``teaser-jax study``: run the paper's studies, or write their problems for another program."""

from __future__ import annotations

import argparse
import sys

import jax

from teaser_jax.cli.endings import OK, BadInput
from teaser_jax.ground.io import one_line
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.peers import find_peers
from teaser_jax.studies.results import PAGE, PICTURE, TABLE
from teaser_jax.studies.run import named_study, run_study
from teaser_jax.studies.shards import draw_trials, save_trials
from teaser_jax.studies.trials import TEAPOT, Model, StudyError, read_model

ALL, REPORT, LIST = "all", "report", "list"
REPORT_HAS_MOVED = (
    "the report is written in the repository: python -m benchmarks.paper STUDIES_FOLDER -o PAPER.md"
)


def run(arguments: argparse.Namespace) -> int:
    """Run, list or export studies, and return the exit code.

    Raises:
        BadInput: If it cannot be done as asked, or a package is missing.
        FileError: If a file cannot be used.
    """
    try:
        return _run(arguments)
    except (StudyError, ImportError) as error:
        raise BadInput(str(error)) from error


def _run(arguments: argparse.Namespace) -> int:
    if arguments.name == REPORT or arguments.output is not None:
        raise StudyError(REPORT_HAS_MOVED)
    if arguments.cluster is not None:
        _join(arguments.cluster)
    if arguments.name == LIST:
        return _list()
    names = list(studies()) if arguments.name == ALL else [named_study(arguments.name).name]
    if arguments.score and arguments.name == ALL:
        raise StudyError("--score measures the answers to one study: name it instead of 'all'")
    model = TEAPOT if arguments.model == "procedural" else read_model(arguments.model)
    for name in names:
        if arguments.export is not None:
            if arguments.method:
                raise StudyError("--method chooses solvers: --export solves nothing")
            if arguments.score:
                raise StudyError(
                    "--score measures answers: --export writes the problems, before there are any"
                )
            _export(name, model, arguments)
        else:
            _go_on(name, model, arguments)
    return OK


def _join(cluster: str) -> None:
    """Join the processes of a cluster (``jax.distributed``), before any device is looked at."""
    known = _place_in(cluster) if cluster else ()
    try:
        jax.distributed.initialize(*known)
    except (ValueError, RuntimeError) as error:
        hint = "" if cluster else ": Slurm or Open MPI say nothing here, give HOST:PORT,N,K"
        raise StudyError(f"--cluster: processes cannot be joined ({one_line(error)}){hint}") from error


def _place_in(cluster: str) -> tuple[str, int, int]:
    """Read HOST:PORT,N,K: the address, the number of processes, and which of them this one is."""
    address, *numbers = cluster.split(",")
    host, _, port = address.rpartition(":")
    decimal = all(x.isdecimal() for x in (port, *numbers))
    if len(numbers) != 2 or not host or not decimal or not 0 < int(port) < 2**16 or int(numbers[0]) < 1:
        raise StudyError(f"--cluster is {cluster!r}: expected HOST:PORT,N,K as in 127.0.0.1:9876,2,0")
    count, number = map(int, numbers)
    if number >= count:
        raise StudyError(f"--cluster is {cluster!r}: of {count} processes the last is number {count - 1}")
    return address, count, number


def _list() -> int:
    """Print the studies, who takes part in them, and who is missing."""
    for study in studies().values():
        print(f"{study.name:<14} {study.figure:<11} {study.title}; {study.runs} runs a cell")
        print("".join(f"{'':<16}{method.name}\n" for method in study.methods), end="")
    for package, reason in find_peers()[1].items():
        print(f"without {package}: {reason}")
    return OK


def _export(name: str, model: Model, arguments: argparse.Namespace) -> None:
    """Write the problems of a study, and print the names of the files."""
    study = named_study(name)
    drawn = draw_trials(study, runs=arguments.runs, seed=arguments.seed, model=model, quick=arguments.quick)
    for path in save_trials(arguments.export, drawn, name=name):
        print(path)


def _go_on(name: str, model: Model, arguments: argparse.Namespace) -> None:
    """Run a study, or go on with it, and print the names of its files."""
    try:
        place = run_study(
            name, arguments.folder,
            runs=arguments.runs, seed=arguments.seed, model=model, methods=arguments.method,
            quick=arguments.quick, score=arguments.score, progress=jax.process_index() == 0,
        )  # fmt: skip
    except KeyboardInterrupt:
        print(f"\nteaser-jax: {name} is not finished: the same command goes on where it was", file=sys.stderr)
        raise
    if jax.process_index() == 0:
        print("\n".join(str(place / file) for file in (TABLE, PICTURE, PAGE)))
