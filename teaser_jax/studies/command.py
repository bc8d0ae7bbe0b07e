"""``teaser-jax study``: run the paper's studies, or write their problems for another program."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import jax

from teaser_jax.files import one_line
from teaser_jax.studies.catalogue import studies
from teaser_jax.studies.paper import write_report
from teaser_jax.studies.peers import find_peers
from teaser_jax.studies.results import PAGE, PICTURE, TABLE
from teaser_jax.studies.run import named_study, run_study
from teaser_jax.studies.shards import draw_trials, save_trials
from teaser_jax.studies.trials import TEAPOT, Model, StudyError, read_model

ALL, REPORT, LIST = "all", "report", "list"
FOLDER = Path("studies")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The arguments of the command."""
    parser.add_argument("name", metavar="NAME", help=f"{LIST}, a study that it names, {ALL}, or {REPORT}")
    parser.add_argument(
        "--folder",
        type=Path,
        default=FOLDER,
        metavar="DIR",
        help=f"of tables and figures (default: {FOLDER})",
    )
    parser.add_argument("--runs", type=int, metavar="N", help="problems a cell (default: 40 or 100)")
    parser.add_argument("--seed", type=int, default=0, metavar="S", help="default: 0")
    parser.add_argument(
        "--model", default="procedural", metavar="PATH|procedural",
        help="points or triangles to draw from: .npy, .ply, .obj, .stl, .off (default: procedural, a teapot)",
    )  # fmt: skip
    parser.add_argument(
        "--method", action="append", metavar="M", help="one that takes part, again for more (default: all)"
    )
    parser.add_argument("--quick", action="store_true", help="a few cells of three runs: two minutes a study")
    parser.add_argument(
        "--export", type=Path, metavar="DIR", help="write the problems as .npz shards, and solve nothing"
    )
    parser.add_argument(
        "--cluster", nargs="?", const="", metavar="HOST:PORT,N,K",
        help="share the work among N processes, of which this is number K; alone, as Slurm or Open MPI say",
    )  # fmt: skip
    parser.add_argument(
        "-o", "--output", type=Path, metavar="MD", help=f"of {REPORT} (default: PAPER.md in the folder)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Do what the arguments say. Raises StudyError, FileError or ImportError on what cannot be done."""
    if arguments.cluster is not None:
        _join(arguments.cluster)
    if arguments.name == LIST:
        return _list()
    if arguments.name == REPORT:
        print(write_report(arguments.folder, arguments.output or arguments.folder / "PAPER.md"))
        return 0
    if arguments.output is not None:
        raise StudyError(f"--output is for {REPORT}: tables and figures go to --folder")
    names = list(studies()) if arguments.name == ALL else [named_study(arguments.name).name]
    model = TEAPOT if arguments.model == "procedural" else read_model(arguments.model)
    for name in names:
        if arguments.export is not None:
            if arguments.method:
                raise StudyError("--method chooses solvers: --export solves nothing")
            _export(name, model, arguments)
        else:
            _run(name, model, arguments)
    return 0


def _join(cluster: str) -> None:
    """Become one of several processes (``jax.distributed``), before any device is looked at."""
    known: tuple[Any, ...] = ()
    if cluster:
        address, *numbers = cluster.split(",")
        host, _, port = address.rpartition(":")
        whole = all(x.isdecimal() for x in (port, *numbers))
        if len(numbers) != 2 or not host or not whole or not 0 < int(port) < 2**16 or int(numbers[0]) < 1:
            raise StudyError(f"--cluster is {cluster!r}: expected HOST:PORT,N,K as in 127.0.0.1:9876,2,0")
        count, number = map(int, numbers)
        if number >= count:
            raise StudyError(f"--cluster is {cluster!r}: of {count} processes the last is number {count - 1}")
        known = address, count, number
    try:
        jax.distributed.initialize(*known)
    except (ValueError, RuntimeError) as error:
        hint = "" if cluster else ": Slurm or Open MPI say nothing here, give HOST:PORT,N,K"
        raise StudyError(f"--cluster: processes cannot be joined ({one_line(error)}){hint}") from error


def _list() -> int:
    for study in studies().values():
        print(f"{study.name:<14} {study.figure:<11} {study.title}; {study.runs} runs a cell")
        print("".join(f"{'':<16}{method.name}\n" for method in study.methods), end="")
    for package, reason in find_peers()[1].items():
        print(f"without {package}: {reason}")
    return 0


def _export(name: str, model: Model, arguments: argparse.Namespace) -> None:
    study = named_study(name)
    drawn = draw_trials(study, runs=arguments.runs, seed=arguments.seed, model=model, quick=arguments.quick)
    for path in save_trials(arguments.export, drawn, name=name):
        print(path)


def _run(name: str, model: Model, arguments: argparse.Namespace) -> None:
    try:
        place = run_study(
            name, arguments.folder,
            runs=arguments.runs, seed=arguments.seed, model=model, methods=arguments.method,
            quick=arguments.quick, progress=jax.process_index() == 0,
        )  # fmt: skip
    except KeyboardInterrupt:
        print(f"\nteaser-jax: {name} is not finished: the same command goes on where it was", file=sys.stderr)
        raise
    if jax.process_index() == 0:
        print("\n".join(str(place / file) for file in (TABLE, PICTURE, PAGE)))
