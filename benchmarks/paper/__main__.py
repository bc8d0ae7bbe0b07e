"""``python -m benchmarks.paper STUDIES_FOLDER -o PAPER.md`` writes the report of the paper."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from benchmarks.paper.report import write_report
from teaser_jax.files import FileError


def main(argv: list[str] | None = None) -> int:
    """Write the report and return the exit code: 0, or 2 after one line that says what is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.paper",
        description="Write the report on the paper from the tables of the studies.",
    )
    parser.add_argument(
        "folder", type=Path, metavar="STUDIES_FOLDER", help="where teaser-jax study put the studies"
    )
    parser.add_argument(
        "-o", "--output", type=Path, metavar="PAPER.md", help="default: PAPER.md in the folder"
    )
    arguments = parser.parse_args(argv)
    try:
        print(write_report(arguments.folder, arguments.output or arguments.folder / "PAPER.md"))
    except FileError as error:
        print(f"benchmarks.paper: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
