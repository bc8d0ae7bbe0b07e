"""``teaser-jax demo``: two scans, or matches, with their answer, the time of each stage, and a picture."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from pathlib import Path

import teaser_jax as tj
from teaser_jax.cli.endings import OK, UNTRUSTED, BadInput
from teaser_jax.cli.places import check_matplotlib, check_writable, draw, draw_clouds, writing
from teaser_jax.cli.report import errors_as_text

POINTS, SCANNED, NOISE = 200_000, 20_000, 0.003  # of the solid, of each scan, and of each coordinate


def run(arguments: argparse.Namespace) -> int:
    """Register what is asked for, print and draw the answer, and return the exit code.

    Without matplotlib the picture is left out.

    Raises:
        BadInput: If the picture cannot be written, or a library is missing.
    """
    check_writable(arguments.plot)
    return _matches(arguments) if arguments.what == "matches" else _clouds(arguments)


def _clouds(arguments: argparse.Namespace) -> int:
    """Register two partial scans of a solid."""
    solid = tj.synthetic.random_solid(arguments.seed, n=POINTS)
    scans = tj.synthetic.scan_pair(arguments.seed, solid, n=SCANNED, sigma=NOISE)
    print(
        f"A solid of size 1, scanned from two sides with errors of {NOISE} (seed {arguments.seed}): "
        f"{SCANNED} points each, and no matches.\n"
    )
    try:
        result = tj.register_clouds(scans.src, scans.dst)
    except ImportError as error:
        raise BadInput(str(error)) from error
    print(result)
    print(errors_as_text(result.pose, scans.truth, "truth"))
    times = "\n".join(f"  {name:<13}{seconds:.3f} s" for name, seconds in result.seconds.items())
    print(f"\nTime of each stage, that of compiling included\n{times}\n")
    _picture(arguments.plot, lambda path: draw_clouds(path, result))
    return OK if result.ok else UNTRUSTED


def _matches(arguments: argparse.Namespace) -> int:
    """Register a thousand matches, most of them wrong."""
    problem = tj.synthetic.random_problem(arguments.seed)
    wrong = int((~problem.inliers).sum())
    print(f"A teapot: {len(problem.src)} matches, {wrong} of them wrong (seed {arguments.seed}).\n")
    profile = tj.profile(problem.src, problem.dst, noise_bound=problem.noise_bound)
    result = profile.result
    precision, recall = tj.metrics.precision_recall(result.inliers, problem.inliers)
    print(result)
    print(errors_as_text(result.pose, problem.truth, "truth"))
    print(
        f"  inliers      {precision:.1%} of those found are right, {recall:.1%} of the right ones are found\n"
    )
    print(f"Time of each stage\n{profile}\n")
    _picture(arguments.plot, lambda path: draw(path, problem.src, problem.dst, result))
    return OK if result.ok else UNTRUSTED


def _picture(path: Path, paint: Callable[[Path], None]) -> None:
    """Write a picture, if there is a library to draw it with."""
    try:
        check_matplotlib()
    except BadInput as error:
        print(f"No picture: {error}.", file=sys.stderr)
        return
    with writing(path) as partial:
        paint(partial)
    print(f"Picture: {path}")
