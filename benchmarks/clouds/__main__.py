"""``python -m benchmarks.clouds evaluate``: recall by scene on a public set that you have."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

from benchmarks.clouds import lists
from benchmarks.clouds.evaluate import KINDS, TABLE, as_text, evaluate
from benchmarks.clouds.methods import find_methods
from teaser_jax.files import FileError


def main(argv: list[str] | None = None) -> int:
    """Evaluate, print the table, and return 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.clouds", description=__doc__)
    commands = parser.add_subparsers(dest="command", required=True)
    command = commands.add_parser("evaluate", help="recall by scene", description=lists.__doc__)
    command.add_argument("folder", type=Path, help="where the clouds are")
    command.add_argument("--format", choices=KINDS, required=True, help="whose lists these are")
    command.add_argument(
        "--lists", type=Path, nargs="+", default=[],
        help="3dmatch: the folder of the gt.log files, if not in the same; lidar: the lists",
    )  # fmt: skip
    command.add_argument(
        "-o", "--output", type=Path, default=Path("evaluation"), help="folder of the answers"
    )
    command.add_argument(
        "--methods", nargs="+", metavar="NAME", help="some of ours and the peers; default: all"
    )
    command.add_argument("--most", type=int, metavar="N", help="the first N pairs of each scene only")
    options = parser.parse_args(argv)
    methods, missing = find_methods()
    for package, why in missing.items():
        print(f"left out: {package} ({why})", file=sys.stderr)
    if unknown := set(options.methods or ()) - set(methods):
        parser.error(f"no such method here: {', '.join(sorted(unknown))}; there are {', '.join(methods)}")
    chosen = {name: methods[name] for name in options.methods or methods}
    try:
        rows = evaluate(_first(_listed(options), options.most), KINDS[options.format], chosen, options.output)
    except FileError as error:
        print(f"benchmarks.clouds: {error}", file=sys.stderr)
        return 2
    print(as_text(rows))
    print(options.output / TABLE)
    return 0


def _listed(options: argparse.Namespace) -> list[lists.ListedPair]:
    if options.format == "lidar":
        return lists.lidar(options.folder, options.lists)
    if len(options.lists) > 1:
        raise FileError("--lists: 3dmatch takes one folder.")
    return lists.threedmatch(options.folder, *options.lists)


def _first(listed: list[lists.ListedPair], most: int | None) -> list[lists.ListedPair]:
    """The first pairs of each scene."""
    if most is None:
        return listed
    seen: Counter[str] = Counter()
    kept = []
    for one in listed:
        seen[one.scene] += 1
        if seen[one.scene] <= most:
            kept.append(one)
    return kept


if __name__ == "__main__":
    sys.exit(main())
