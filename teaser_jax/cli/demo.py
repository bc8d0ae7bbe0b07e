"""``teaser-jax demo``: a problem with its answer, the time of each stage, and a picture."""

from __future__ import annotations

import argparse
import sys

import teaser_jax as tj
from teaser_jax.cli.endings import OK, UNTRUSTED, BadInput
from teaser_jax.cli.places import check_matplotlib, check_writable, draw, writing
from teaser_jax.cli.report import errors_as_text


def run(arguments: argparse.Namespace) -> int:
    """Register a thousand matches, most of them wrong, print and draw the answer, and return the exit code.

    Without matplotlib the picture is left out.

    Raises:
        BadInput: If the picture cannot be written.
    """
    check_writable(arguments.plot)
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
    try:
        check_matplotlib()
    except BadInput as error:
        print(f"No picture: {error}.", file=sys.stderr)
    else:
        with writing(arguments.plot) as partial:
            draw(partial, problem.src, problem.dst, result)
        print(f"Picture: {arguments.plot}")
    return OK if result.ok else UNTRUSTED
