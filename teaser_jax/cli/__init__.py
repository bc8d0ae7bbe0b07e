"""The command line: ``teaser-jax register``, ``teaser-jax map``, ``teaser-jax demo``, ``teaser-jax study``.

Exit codes: 0, the answer can be trusted; 1, there is no trustworthy answer and the status says
why; 2, bad input, with one line on stderr that says what is wrong and what to do. With 2 no file
has changed.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib import import_module

from teaser_jax.cli.arguments import parser
from teaser_jax.cli.endings import BAD_INPUT, SIGINT, SIGPIPE, BadInput
from teaser_jax.ground.io import FileError, one_line


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code.

    Args:
        argv: Arguments without the program's name; None: those of the process.
    """
    try:
        arguments = parser().parse_args(argv)
        command = import_module(
            f"teaser_jax.cli.{arguments.command}"
        )  # which loads what it needs, and no more
        code: int = command.run(arguments)
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
