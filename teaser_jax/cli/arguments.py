"""The arguments of the commands. Nothing is loaded here but argparse, so that help comes at once."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, NoReturn

from teaser_jax import __version__
from teaser_jax.cli.endings import BadInput

PICTURES = (".png", ".pdf", ".svg", ".jpg", ".jpeg")  # what matplotlib writes without further programs
CLIQUES = ("exact", "greedy", "networkx", "none")
ROTATIONS = ("gnc", "global", "sdp")
TIM_GRAPHS = ("chain", "complete")
VOTES = ("tls", "consensus")
ALIGNMENTS = ("gicp", "plane", "none")


class _Parser(argparse.ArgumentParser):
    def __init__(self, **options: Any) -> None:
        # A shortened option would mean another one as soon as there is one more.
        super().__init__(allow_abbrev=False, **options)

    def error(self, message: str) -> NoReturn:
        raise BadInput(f"{message}; see {self.prog} --help")


def parser() -> argparse.ArgumentParser:
    """Make the parser of the command line; ``command`` of what it returns names the module that runs."""
    program = _Parser(
        prog="teaser-jax",
        description="Robust registration of 3-D points: of two raw clouds, or of matches.",
        epilog="Exit codes: 0 ok, 1 no trustworthy answer (the status says why), 2 bad input.",
    )
    program.add_argument("--version", action="version", version=f"teaser-jax {__version__}")
    commands = program.add_subparsers(required=True, metavar="COMMAND", dest="command")
    _add_register(commands.add_parser("register", help="find the pose between two clouds, or behind matches"))
    _add_map(commands.add_parser("map", help="register a folder of clouds to one map"))
    _add_demo(
        commands.add_parser("demo", help="register two scans, or a thousand matches, and draw the answer")
    )
    _add_study(
        commands.add_parser("study", help="run the paper's studies: tables and figures of many problems")
    )
    return program


def _add_register(register: argparse.ArgumentParser) -> None:
    register.add_argument(
        "source", metavar="FILE", type=Path,
        help="a cloud (.ply, .pcd, .xyz, .txt, .csv, .npy, .npz, .bin, .las, .laz, .e57, .stl, .obj, .off, "
        ".mat), if a second one follows; alone, a file of matches: .npz with arrays src and dst, maybe also "
        "noise_bound, scale, cbar2, mask, confidence, pairs; or .npy, text or CSV with six columns",
    )  # fmt: skip
    register.add_argument(
        "target", metavar="TARGET", type=Path, nargs="?",
        help="the cloud in whose frame the pose brings the first one",
    )  # fmt: skip
    register.add_argument("--json", action="store_true", help="print the answer as JSON")
    register.add_argument(
        "--plot", type=_picture, metavar="PNG",
        help="write a picture of the answer, good or bad: .png, .pdf, .svg or .jpg",
    )  # fmt: skip
    register.add_argument(
        "-o", "--output", type=_output, metavar="TXT",
        help="write T_dst_src, 4 x 4; if the answer cannot be trusted, an older file is removed instead",
    )  # fmt: skip
    # Options that are not given stay absent: then the file speaks, then the defaults of the function.
    register.add_argument(
        "--scale", type=_scale, default=argparse.SUPPRESS, metavar="S|estimate",
        help="the known scale (default: that in the file of matches, or 1); of matches also: estimate",
    )  # fmt: skip
    _add_matches(register.add_argument_group("of matches"))
    _add_clouds(register.add_argument_group("of two clouds"))


def _add_clouds(register: argparse._ArgumentGroup) -> None:
    absent = argparse.SUPPRESS
    for name, metavar, text in (
        ("voxel-size", "V", "width of the cells that the verdict rests on (default: chosen)"),
        ("tolerance", "L", "how far points of the overlap may be off at the most (default: two voxels)"),
        ("initial-error", "L", "how far the initial pose may have points of the overlap off"),
        ("max-range", "L", "leave out points further from the viewpoint, or the origin"),
        ("seconds", "S", "try no further way to match after so many seconds"),
    ):
        register.add_argument(f"--{name}", type=float, default=absent, metavar=metavar, help=text)
    for name in ("src", "dst"):
        register.add_argument(
            f"--{name}-viewpoint", type=float, nargs=3, default=absent, metavar=("X", "Y", "Z"),
            help=f"where the sensor of the {'first' if name == 'src' else 'second'} cloud stood",
        )  # fmt: skip
    register.add_argument(
        "--initial", type=Path, default=absent, metavar="TXT",
        help="a file with a pose near the answer, 4 x 4: only poses near it are looked for",
    )  # fmt: skip
    _add_reading(register)
    register.add_argument(
        "--html", type=_page, default=absent, metavar="HTML",
        help="write a page to turn and look at the answer from all sides",
    )  # fmt: skip
    register.add_argument(
        "--merged", type=_merged, default=absent, metavar="PLY",
        help="write both clouds in the frame of the second, with their colours and intensity",
    )  # fmt: skip


def _add_map(map_: argparse.ArgumentParser) -> None:
    absent = argparse.SUPPRESS
    map_.add_argument(
        "folder", metavar="FOLDER", type=Path,
        help="its clouds, in the natural order of their names; text counts where there are no other clouds",
    )  # fmt: skip
    map_.add_argument("--json", action="store_true", help="print the map and all pairs as JSON")
    map_.add_argument(
        "-o", "--output", type=_output, metavar="TXT",
        help="write T_map_cloud of each cloud that is placed: .json with names, .tum, .kitti, else 4 x 4",
    )  # fmt: skip
    map_.add_argument(
        "--merged", type=_merged, metavar="PLY",
        help="write all placed clouds in the frame of the map, with their colours and intensity",
    )  # fmt: skip
    map_.add_argument(
        "--work", type=Path, metavar="DIR",
        help="keep answers to pairs there: whatever ends the work, the same command goes on "
        "(default: the name of the output and .pairs)",
    )  # fmt: skip
    map_.add_argument(
        "--pairs", choices=("all", "some"),
        help="which to ask: all, or neighbours in the order and clouds that look alike (default: all of up "
        "to thirty clouds, some of more)",
    )  # fmt: skip
    map_.add_argument(
        "--workers", type=int, default=1, metavar="N", help="how many processes share the pairs (default: 1)"
    )
    map_.add_argument(
        "--engine", choices=("gtsam", "scipy"), help="what optimises the poses (default: gtsam if installed)"
    )
    map_.add_argument(
        "--unordered", dest="ordered", action="store_false",
        help="names do not tell the order in which the clouds were taken: then votes alone decide",
    )  # fmt: skip
    for name, metavar, text in (
        ("seconds", "S", "begin no pair after so many seconds"),
        ("voxel-size", "V", "width of the cells that the verdict on a pair rests on (default: chosen)"),
        ("tolerance", "L", "how far points of an overlap may be off at the most (default: two voxels)"),
        ("max-range", "L", "leave out points further from the viewpoint, or the origin"),
    ):
        map_.add_argument(f"--{name}", type=float, default=absent, metavar=metavar, help=text)
    map_.add_argument(
        "--viewpoint", type=float, nargs=3, default=absent, metavar=("X", "Y", "Z"),
        help="where the sensor of each cloud stood, in its own frame, as 0 0 0",
    )  # fmt: skip
    _add_reading(map_)


def _add_reading(command: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add what is asked of two clouds and of many alike."""
    absent = argparse.SUPPRESS
    command.add_argument(
        "--crop", type=float, nargs=6, default=absent, metavar=("X", "Y", "Z", "X2", "Y2", "Z2"),
        help="leave out points outside this box, in the frame of each cloud",
    )  # fmt: skip
    command.add_argument(
        "--threads", type=int, default=absent, metavar="N",
        help="how many threads to work with; they change no answer (default: one for each core)",
    )  # fmt: skip
    command.add_argument(
        "--align", choices=ALIGNMENTS, default=absent,
        help="how to align at last: by the shape of both clouds, by planes of the second (default: gicp)",
    )  # fmt: skip


def _add_matches(register: argparse._ArgumentGroup) -> None:
    absent = argparse.SUPPRESS
    register.add_argument(
        "--noise-bound", type=float, default=absent, metavar="B",
        help="largest error of a right match, in the unit of the points (default: noise_bound in the file)",
    )  # fmt: skip
    register.add_argument(
        "--cbar2", type=float, default=absent, metavar="C",
        help="truncation of the cost (default: cbar2 in the file, or 1)",
    )  # fmt: skip
    _add_settings(register)
    register.add_argument(
        "--certify", action="store_true", default=absent,
        help="prove how good the rotation is, and say so in the answer",
    )  # fmt: skip


def _add_settings(register: argparse._ArgumentGroup) -> None:
    absent = argparse.SUPPRESS
    register.add_argument(
        "--clique", choices=CLIQUES, default=absent, help="how to prune wrong matches (default: exact)"
    )
    register.add_argument(
        "--rotation", choices=ROTATIONS, default=absent, help="how to find the rotation (default: gnc)"
    )
    register.add_argument(
        "--clique-seconds", type=float, default=absent, metavar="S",
        help="end the exact search for the clique after so many seconds, with the best so far (default: 60)",
    )  # fmt: skip
    register.add_argument(
        "--clique-nodes", type=int, default=absent, metavar="N",
        help="end it after so many branches, which is the same on every machine (default: 100 million)",
    )  # fmt: skip
    register.add_argument(
        "--tim-graph", choices=TIM_GRAPHS, default=absent,
        help="pairs of the clique that the rotation rests on (default: chain)",
    )  # fmt: skip
    register.add_argument(
        "--vote", choices=VOTES, default=absent, help="how scale and translation are voted (default: tls)"
    )
    register.add_argument(
        "--no-refine", dest="refine", action="store_false", default=absent,
        help="end with the paper's plain cascade, without the joint fit",
    )  # fmt: skip


def _add_demo(demo: argparse.ArgumentParser) -> None:
    demo.add_argument(
        "what", nargs="?", choices=("clouds", "matches"), default="clouds",
        help="two partial scans (default), or 1000 matches of which 950 are wrong",
    )  # fmt: skip
    demo.add_argument(
        "--plot", type=_picture, default=Path("demo.png"), metavar="PNG", help="default: demo.png"
    )
    demo.add_argument("--seed", type=_seed, default=0, help="default: 0")


def _add_study(study: argparse.ArgumentParser) -> None:
    folder = Path("studies")
    study.add_argument("name", metavar="NAME", help="list, a study that it names, or all")
    study.add_argument(
        "--folder", type=Path, default=folder, metavar="DIR",
        help=f"of tables and figures (default: {folder})",
    )  # fmt: skip
    study.add_argument("--runs", type=int, metavar="N", help="problems a cell (default: 40 or 100)")
    study.add_argument("--seed", type=int, default=0, metavar="S", help="default: 0")
    study.add_argument(
        "--model", default="procedural", metavar="PATH|procedural",
        help="points or triangles to draw from: .npy, .ply, .obj, .stl, .off (default: procedural, a teapot)",
    )  # fmt: skip
    study.add_argument(
        "--method", action="append", metavar="M", help="one that takes part, again for more (default: all)"
    )
    study.add_argument("--quick", action="store_true", help="a few cells of three runs: two minutes a study")
    study.add_argument(
        "--export", type=Path, metavar="DIR", help="write the problems as .npz shards, and solve nothing"
    )
    study.add_argument(
        "--score", action="append", default=[], type=Path, metavar="NPZ",
        help="answers of another program to the exported problems, one more method in table and figure; "
        "again for more files. Arrays: method (its name), rotation (b, 3, 3), translation (b, 3), scale (b,) "
        "if it is unknown, maybe seconds (b,); and study, seed, model, model_crc32, protocol, value, trial "
        "of the shard. A pose of NaN is no answer. Give --runs, --quick, --seed, --model as with --export",
    )  # fmt: skip
    study.add_argument(
        "--cluster", nargs="?", const="", metavar="HOST:PORT,N,K",
        help="share the work among N processes, of which this is number K; alone, as Slurm or Open MPI say",
    )  # fmt: skip
    # Of the report that this command wrote once: whoever asks for it is told where it went.
    study.add_argument("-o", "--output", type=Path, help=argparse.SUPPRESS)


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


def _page(text: str) -> Path:
    return _ending(text, ".html", "a page")


def _merged(text: str) -> Path:
    return _ending(text, ".ply", "a merged cloud")


def _ending(text: str, suffix: str, what: str) -> Path:
    path = _output(text)
    if path.suffix.lower() != suffix:
        raise argparse.ArgumentTypeError(f"{text}: end the name of {what} in {suffix}")
    return path
