"""A table that grows row by row and survives whatever ends the program.

Rows go to the end of a CSV file in one write each and are on the disk before the next is computed. A file
whose last line is broken, as a killed program can leave it, loses that line when it is opened to go on.
"""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterable, Sequence
from io import FileIO
from pathlib import Path
from types import TracebackType
from typing import Any

from teaser_jax.ground.arrays import Number
from teaser_jax.ground.io import FileError

TEXT = ("method", "error")


class Table:
    """A ``Table`` is a CSV file open for more rows, which no second program can open meanwhile.

    As a context manager it closes the file at the end.

    Attributes:
        rows: The rows that it held when it was opened.

    Raises:
        FileError: If the file holds other columns, or another program writes it.
    """

    def __init__(self, path: Path, columns: Sequence[str]):
        self.path, self.columns = path, tuple(columns)
        self._file = path.open("a+b", buffering=0)
        try:
            _lock(self._file, path)
            self._mend()
            self.rows = read_table(path)
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> Table:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()

    def append(self, rows: Iterable[dict[str, Any]]) -> None:
        """Write rows and wait until the disk has them.

        Args:
            rows: Values by column; absent ones and None are left empty.

        Raises:
            FileError: If they cannot be written; the rows before are safe.
        """
        self._write([self.fields(row) for row in rows])

    def fields(self, row: dict[str, Any]) -> list[str]:
        """Write the values of a row as the fields of the table, in its order."""
        return [_text(row.get(column)) for column in self.columns]

    def _mend(self) -> None:
        """Cut what a killed program left of a row; write the header of a new file."""
        self._file.seek(0)
        content = self._file.read()
        header = ",".join(self.columns).encode()
        first, newline, _ = content.partition(b"\n")
        # Somebody else's file is left as it is: also one of a single line, which might be half a header.
        if first.rstrip(b"\r") != header if newline else not header.startswith(first):
            raise FileError(f"{self.path}: holds other columns than this study writes: name another folder.")
        whole = content.rfind(b"\n") + 1
        if whole < len(content):
            self._file.truncate(whole)
        if not whole:
            self._write([self.columns])

    def _write(self, lines: Sequence[Sequence[str]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(lines)
        left = memoryview(text.getvalue().encode())
        try:
            while left:
                left = left[self._file.write(left) :]
            os.fsync(self._file.fileno())
        except OSError as error:
            reason = error.strerror or error
            raise FileError(f"{self.path}: cannot be written: {reason}: the rows before are safe.") from error


def read_table(path: str | Path) -> list[dict[str, Any]]:
    """Read the rows of a study's table: numbers as float, absent ones left out.

    A broken last line, as a running or killed study may leave it, is no row.

    Args:
        path: ``table.csv`` in the folder of a study.

    Raises:
        FileError: If there is no such file, or a row does not fit its header or says not which run it is.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileError(f"{path}: no such table: run the study first.") from None
    except (OSError, UnicodeDecodeError) as error:
        raise FileError(f"{path}: cannot be read as a table ({error}).") from error
    lines = csv.reader(text[: text.rfind("\n") + 1].splitlines())
    header = next(lines, [])
    return [_row(path, number, header, line) for number, line in enumerate(lines, 2)]


def _row(path: Path, number: int, header: list[str], line: list[str]) -> dict[str, Any]:
    """Read one line of a table, or raise FileError with its number."""
    if len(line) != len(header):
        raise FileError(
            f"{path}: line {number} has {len(line)} fields, the header {len(header)}: mend or remove it."
        )
    try:
        row: dict[str, Any] = {
            c: x if c in TEXT else float(x) for c, x in zip(header, line, strict=True) if x != ""
        }
    except ValueError as error:
        raise FileError(f"{path}: line {number}: {error}: mend or remove it.") from None
    value, trial = (float(row.get(column, math.nan)) for column in (*header[:1], "trial"))
    if "method" not in row or not (math.isfinite(value) and trial >= 0 and trial % 1 == 0):
        raise FileError(f"{path}: line {number} does not say which cell, trial and method it is of: mend it.")
    return row


def _text(value: Any) -> str:
    """Make the field of a table from a number, a text or nothing."""
    if value is None:
        return ""
    if isinstance(value, str):
        return " ".join(value.split())  # a row is a line
    return written(float(value))


def written(number: Number) -> str:
    """Write a number as tables hold it, so that what is read can be compared with what was meant."""
    return f"{number:.7g}"


def _lock(file: FileIO, path: Path) -> None:
    """Let one writer in at a time, where the system can; the lock ends with the program, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise FileError(f"{path}: another program is writing it: wait, or name another folder.") from None
