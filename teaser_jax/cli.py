"""The command line: ``teaser-jax register MATCHES``, ``teaser-jax demo`` and ``teaser-jax study NAME``.

Exit codes: 0, the answer can be trusted; 1, there is no trustworthy answer and the status says
why; 2, bad input, with one line on stderr that says what is wrong and what to do. With 2 no file
has changed.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import re
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

import teaser_jax as tj
from teaser_jax.files import KNOWN, FileError, Matches, one_line, read_matches, whole, write_pose
from teaser_jax.studies import StudyError, command

OK, UNTRUSTED, BAD_INPUT = 0, 1, 2
PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")  # what matplotlib writes without further programs
SIGINT, SIGPIPE = 130, 141  # as shells report a program that these signals end


class BadInput(Exception):
    """Something the caller can put right; ends the command with one line and exit code 2."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program's name; None: those of the process.
    """
    try:
        arguments = _parser().parse_args(argv)
        code = arguments.run(arguments)
        sys.stdout.flush()
        return code
    except (BadInput, FileError) as error:
        print(f"teaser-jax: {one_line(error, 600)}", file=sys.stderr)
        return BAD_INPUT
    except BrokenPipeError:  # the reader of a pipe has left: nobody is there to be told
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
        return SIGPIPE
    except KeyboardInterrupt:
        return SIGINT


class _Parser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; see {self.prog} --help")


def _parser() -> argparse.ArgumentParser:
    parser = _Parser(
        prog="teaser-jax",
        description="Robust registration of matched 3-D points.",
        epilog="Exit codes: 0 ok, 1 no trustworthy answer (the status says why), 2 bad input.",
    )
    parser.add_argument("--version", action="version", version=f"teaser-jax {tj.__version__}")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    register = commands.add_parser("register", help="find the pose behind a file of matches")
    register.set_defaults(run=_register)
    register.add_argument(
        "matches", metavar="MATCHES", type=Path,
        help=".npz with arrays src and dst, maybe also noise_bound, scale, cbar2, mask, confidence, pairs; "
        "or text or CSV with six columns",
    )  # fmt: skip
    # Options that are not given stay absent: then the file speaks, then the defaults of tj.register.
    register.add_argument(
        "--noise-bound", type=float, default=argparse.SUPPRESS, metavar="B",
        help="largest error of a right match, in the unit of the points (default: noise_bound in the file)",
    )  # fmt: skip
    register.add_argument(
        "--scale", type=_scale, default=argparse.SUPPRESS, metavar="S|estimate",
        help="the known scale (default: scale in the file, or 1), or the word estimate",
    )  # fmt: skip
    register.add_argument(
        "--cbar2", type=float, default=argparse.SUPPRESS, metavar="C",
        help="truncation of the cost (default: cbar2 in the file, or 1)",
    )  # fmt: skip
    register.add_argument(
        "--clique", choices=("exact", "greedy", "networkx", "none"), default=tj.Settings().clique,
        help="how to prune wrong matches (default: exact)",
    )  # fmt: skip
    register.add_argument(
        "--rotation", choices=("gnc", "global", "sdp"), default=tj.Settings().rotation,
        help="how to find the rotation (default: gnc)",
    )  # fmt: skip
    register.add_argument(
        "--certify", action="store_true", help="prove how good the rotation is, and say so in the answer"
    )
    register.add_argument("--json", action="store_true", help="print the answer as JSON")
    register.add_argument(
        "--plot", type=_picture, metavar="PNG",
        help="write a picture of the answer, good or bad: .png, .pdf, .svg or .jpg",
    )  # fmt: skip
    register.add_argument(
        "-o", "--output", type=_output, metavar="TXT",
        help="write T_dst_src, 4 x 4; if the answer cannot be trusted, an older file is removed instead",
    )  # fmt: skip

    demo = commands.add_parser(
        "demo", help="register 1000 matches of which 950 are wrong, and draw the answer"
    )
    demo.set_defaults(run=_demo)
    demo.add_argument(
        "--plot", type=_picture, default=Path("demo.png"), metavar="PNG", help="default: demo.png"
    )
    demo.add_argument("--seed", type=_seed, default=0, help="default: 0")

    study = commands.add_parser("study", help="run the paper's studies: tables and figures of many problems")
    study.set_defaults(run=_study)
    command.add_arguments(study)
    return parser


def _scale(text: str) -> float | None:
    try:
        return None if text == "estimate" else float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"'{text}' is neither a number nor the word estimate") from None


def _seed(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text} is no seed: give a whole number, 0 or above")
    return int(text)


def _output(text: str) -> Path:
    if text == "-":
        raise argparse.ArgumentTypeError("- is not understood as standard output: name a file")
    return Path(text)


def _picture(text: str) -> Path:
    path = _output(text)
    if path.suffix.lower() not in PICTURES:
        kinds = ", ".join(PICTURES[:-1])
        raise argparse.ArgumentTypeError(f"{text}: unknown kind of picture: end the name in one of {kinds}")
    return path


def _register(arguments: argparse.Namespace) -> int:
    source, output, plot = arguments.matches, arguments.output, arguments.plot
    _check_places(source, output, plot)
    matches = read_matches(source)
    known = {**matches.known, **{name: value for name, value in vars(arguments).items() if name in KNOWN}}
    if "noise_bound" not in known:
        raise BadInput(
            "--noise-bound is missing: give the largest error of a right match, in the unit of the points"
        )
    start = time.perf_counter()
    settings = tj.Settings(clique=arguments.clique, rotation=arguments.rotation)
    result = _answer(source, matches, settings, known | {"certify": arguments.certify})
    seconds = time.perf_counter() - start

    older = output is not None and output.exists()
    # The words come last: whatever fails before, nothing that counts is out yet.
    _write(result, matches, output, plot)
    if output is not None and not result.ok:
        what = "not written, and the older file removed" if older else "not written"
        print(f"teaser-jax: {output} {what}: {result.status.name}", file=sys.stderr)
    if arguments.json:
        print(json.dumps(_report(result, matches.truth, seconds), allow_nan=False))
    else:
        print(result)
        if matches.truth is not None:
            print(_errors(result.pose, matches.truth, "T_dst_src of the file"))
    return OK if result.ok else UNTRUSTED


def _answer(path: Path, matches: Matches, settings: tj.Settings, known: dict[str, Any]) -> tj.Registration:
    try:
        return tj.register(matches.src, matches.dst, settings=settings, **known)
    except (ValueError, ImportError) as error:
        raise BadInput(f"{path}: {error}") from error
    except (MemoryError, RuntimeError) as error:
        exhausted = re.search("out of memory|RESOURCE_EXHAUSTED", str(error), re.IGNORECASE)
        if not (exhausted or isinstance(error, MemoryError)):
            raise
        # A MemoryError of register says what to do; those of Python, numpy and XLA do not.
        advice = str(error) if type(error) is MemoryError else ""
        too_many = f"{len(matches.src)} matches need more memory than there is: give fewer, the best first"
        raise BadInput(f"{path}: {advice or too_many}") from error


def _write(result: tj.Registration, matches: Matches, output: Path | None, plot: Path | None) -> None:
    """The picture and the pose, or neither if one of them fails.

    A pose of an earlier run must not pass for this run's answer: it goes if there is none.
    """
    with ExitStack() as until_all_is_well:
        if plot is not None:
            partial = until_all_is_well.enter_context(_writing(plot))
            _draw(partial, matches.src, matches.dst, result)
        if output is not None:
            with _named(output):
                if result.ok:
                    write_pose(output, result.pose)
                else:
                    output.unlink(missing_ok=True)


def _demo(arguments: argparse.Namespace) -> int:
    _check_writable(arguments.plot, None)
    problem = tj.synthetic.random_problem(arguments.seed)
    wrong = int((~problem.inliers).sum())
    print(f"A teapot: {len(problem.src)} matches, {wrong} of them wrong (seed {arguments.seed}).\n")
    profile = tj.profile(problem.src, problem.dst, noise_bound=problem.noise_bound)
    result = profile.result
    precision, recall = tj.metrics.precision_recall(result.inliers, problem.inliers)
    print(result)
    print(_errors(result.pose, problem.truth, "truth"))
    print(
        f"  inliers      {precision:.1%} of those found are right, {recall:.1%} of the right ones are found\n"
    )
    print(f"Time of each stage\n{profile}\n")
    try:
        _check_matplotlib()
    except BadInput as error:
        print(f"No picture: {error}.", file=sys.stderr)
    else:
        with _writing(arguments.plot) as partial:
            _draw(partial, problem.src, problem.dst, result)
        print(f"Picture: {arguments.plot}")
    return OK if result.ok else UNTRUSTED


def _study(arguments: argparse.Namespace) -> int:
    try:
        return command.run(arguments)
    except (StudyError, ImportError) as error:
        raise BadInput(str(error)) from error


def _errors(pose: tj.Pose, truth: tj.Pose, name: str) -> str:
    error = tj.metrics.errors(pose, truth)
    return (
        f"\nError against the {name}\n"
        f"  rotation     {error.rotation_deg:.4g} deg\n"
        f"  translation  {float(error.translation):.4g}\n"
        f"  scale        {float(error.scale):.4g}"
    )


def _report(result: tj.Registration, truth: tj.Pose | None, seconds: float) -> dict[str, Any]:
    """The answer as plain numbers; those that are not finite become null, which JSON can hold."""
    pose, solution = result.pose, result.solution
    report = {
        "ok": result.ok,
        "status": result.status.name,
        "advice": result.status.advice,
        "pose": {
            "scale": _plain(pose.scale),
            "rotation": _plain(pose.rotation),
            "quaternion_xyzw": _plain(pose.quat),
            "translation": _plain(pose.translation),
            "T_dst_src": _plain(pose.matrix),
        },
        "matches": len(result.inliers),
        "excluded": int(solution.excluded),
        "inliers": np.flatnonzero(result.inliers).tolist(),
        "clique": {
            "size": int(solution.clique_size),
            "upper_bound": int(solution.clique_upper_bound),
            "is_maximum": bool(solution.clique_is_maximum),
        },
        "cost": _plain(solution.cost),
        "seconds": round(seconds, 6),
    }
    if "certificate" in vars(result):
        report["certificate"] = _certificate(result.certificate)
    if truth is not None:
        error = tj.metrics.errors(pose, truth)
        report["error"] = {
            "rotation_deg": _plain(error.rotation_deg),
            "translation": _plain(error.translation),
            "scale": _plain(error.scale),
        }
    return report


def _certificate(found: tj.Certificate) -> dict[str, Any]:
    status = tj.CertificateStatus(int(found.status))
    return {
        "status": status.name,
        "advice": status.advice,
        "is_optimal": bool(found.is_optimal),
        "is_unique": bool(found.is_unique),
        "suboptimality": _plain(found.suboptimality),
        "lower_bound": _plain(found.lower_bound),
        "angle_bound_deg": _plain(np.degrees(found.angle_bound)),
        "measurements": int(found.measurements),
        "iterations": int(found.iterations),
        "method": tj.CertifiedBy(int(found.method)).name.lower(),
        "inlier_gap": _plain(found.inlier_gap),
        "explained_gap": _plain(found.explained_gap),
    }


def _plain(values: Any) -> Any:
    listed = np.asarray(values, float).tolist()

    def finite(x: Any) -> Any:
        return [finite(y) for y in x] if isinstance(x, list) else (x if math.isfinite(x) else None)

    return finite(listed)


def _draw(path: Path, src: Any, dst: Any, result: tj.Registration) -> None:
    from teaser_jax.plots import plot_registration

    plot_registration(src, dst, result).savefig(path)


@contextmanager
def _writing(path: Path) -> Iterator[Path]:
    with _named(path), whole(path) as partial:
        yield partial


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Whatever keeps the file from being written is said in one line."""
    try:
        yield
    except OSError as error:
        raise BadInput(f"{path}: cannot be written: {error.strerror or error}") from error


def _check_places(source: Path, output: Path | None, plot: Path | None) -> None:
    for path in (output, plot):
        _check_writable(path, source)
    if plot is not None:
        _check_matplotlib()
    if output is not None and plot is not None and os.path.realpath(output) == os.path.realpath(plot):
        raise BadInput(f"{output}: is named for the pose and for the picture: name two files")


def _check_writable(path: Path | None, source: Path | None) -> None:
    """Say before the work, not after it, that its answer has no place to go."""
    if path is None:
        return
    with _named(path):
        path.exists()  # raises if the name is too long
    folder = path.parent
    if path.is_dir():
        raise BadInput(f"{path}: is a folder: name a file to write")
    if path.exists() and not path.is_file():
        raise BadInput(f"{path}: is no ordinary file: name one to write")
    if not folder.is_dir():
        raise BadInput(f"{path}: the folder {folder} does not exist: make it first")
    if not all(os.access(place, os.W_OK) for place in (folder, path) if place.exists()):
        raise BadInput(f"{path}: cannot be written: no permission")
    if source is not None and path.exists() and source.exists() and path.samefile(source):
        raise BadInput(f"{path}: is the file of matches: name another one to write")


def _check_matplotlib() -> None:
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError:
        raise BadInput("pictures need matplotlib: pip install 'teaser-jax[viz]'") from None


if __name__ == "__main__":
    sys.exit(main())
