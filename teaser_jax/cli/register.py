"""``teaser-jax register MATCHES``: from a file of matches to a pose, a picture, and words about both."""

from __future__ import annotations

import argparse
import json
import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import teaser_jax as tj
from teaser_jax.cli import clouds
from teaser_jax.cli.clouds import CLOUDS_ONLY, check_kind
from teaser_jax.cli.endings import OK, UNTRUSTED, BadInput
from teaser_jax.cli.places import check_places, draw, failures_named, tell_unwritten, writing
from teaser_jax.cli.report import as_plain_data, errors_as_text
from teaser_jax.files.matches import KNOWN, MatchFile, read_matches
from teaser_jax.files.poses import write_pose
from teaser_jax.ground.io import one_line
from teaser_jax.stages.clique.exact import ExactClique

CHOICES = ("clique", "rotation", "tim_graph", "vote", "refine")  # of Settings
BUDGETS = {"clique_seconds": "seconds", "clique_nodes": "nodes"}  # of ExactClique


def run(arguments: argparse.Namespace) -> int:
    """Register the matches of a file, or two clouds, write what is asked for, and return the exit code.

    Raises:
        BadInput: If something cannot be read, solved or written; then no file has changed.
        FileError: If a file cannot be used.
    """
    if arguments.target is not None:
        return clouds.run(arguments)
    check_kind(arguments, CLOUDS_ONLY, "two clouds")
    source, output, plot = arguments.source, arguments.output, arguments.plot
    check_places((source,), {"output": output, "plot": plot})
    matches = read_matches(source)
    for sentence in matches.ignored:
        print(f"teaser-jax: {one_line(source)}: {sentence}", file=sys.stderr)
    given = vars(arguments)
    known = {**matches.known, **{name: value for name, value in given.items() if name in KNOWN}}
    if "noise_bound" not in known:
        raise BadInput(
            "--noise-bound is missing: give the largest error of a right match, in the unit of the points"
        )
    start = time.perf_counter()
    settings = _settings(given)
    result = _answer(source, matches, settings, known | {"certify": given.get("certify", False)})
    seconds = time.perf_counter() - start

    older = output is not None and output.exists()
    # The words come last: whatever fails before, nothing that counts is out yet.
    _write(result, matches, output, plot)
    if not result.ok:
        tell_unwritten(output, older, result.status.name)
    if arguments.json:
        print(json.dumps(as_plain_data(result, matches.truth, seconds), allow_nan=False))
    else:
        print(result)
        if matches.truth is not None:
            print(errors_as_text(result.pose, matches.truth, "T_dst_src of the file"))
    return OK if result.ok else UNTRUSTED


def _settings(given: dict[str, Any]) -> tj.Settings:
    """Make the settings that the options ask for. Raises BadInput if they contradict each other."""
    chosen = {name: given[name] for name in CHOICES if name in given}
    budget = {field: given[name] for name, field in BUDGETS.items() if name in given}
    try:
        if budget:
            if chosen.get("clique", "exact") != "exact":
                raise BadInput(
                    f"--clique {chosen['clique']} has no budget: leave --clique-seconds and --clique-nodes"
                )
            chosen["clique"] = ExactClique(**budget)
        return tj.Settings(**chosen)
    except ValueError as error:
        raise BadInput(str(error)) from error


def _answer(path: Path, matches: MatchFile, settings: tj.Settings, known: dict[str, Any]) -> tj.Registration:
    try:
        return tj.register(matches.src, matches.dst, settings=settings, **known)
    except (ValueError, ImportError) as error:
        raise BadInput(f"{path}: {error}") from error
    except MemoryError as error:
        # That of register says what to do; those of Python and numpy do not.
        advice = str(error) if type(error) is MemoryError else ""
        too_many = f"{len(matches.src)} matches need more memory than there is: give fewer, the best first"
        raise BadInput(f"{path}: {advice or too_many}") from error


def _write(result: tj.Registration, matches: MatchFile, output: Path | None, plot: Path | None) -> None:
    """Write the picture and the pose, or neither if one of them fails.

    A pose of an earlier run must not pass for this run's answer: it goes if there is none.
    """
    with ExitStack() as until_all_is_well:
        if plot is not None:
            partial = until_all_is_well.enter_context(writing(plot))
            draw(partial, matches.src, matches.dst, result)
        if output is not None:
            with failures_named(output):
                if result.ok:
                    write_pose(output, result.pose)
                else:
                    output.unlink(missing_ok=True)
