"""A table that grows row by row and survives whatever ends the program.

Rows go to the end of a CSV file in one write each and are on the disk before the next is computed. A file
whose last line is broken, as a killed program can leave it, loses that line when it is opened to go on.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, BinaryIO

from teaser_jax.files import FileError

TEXT = ("method", "error")


class Table:
    """A CSV file open for more rows; a context manager that no second program can enter meanwhile.

    Raises:
        FileError: If the file holds other columns, or another program writes it.
    """

    def __init__(self, path: Path, columns: Sequence[str]):
        self.path, self.columns = path, tuple(columns)
        self._file: BinaryIO = path.open("a+b")
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
        """Write rows and wait until the disk has them."""
        self._write([[_text(row.get(column)) for column in self.columns] for row in rows])

    def _mend(self) -> None:
        """Cut what a killed program left of a row; write the header of a new file."""
        self._file.seek(0)
        content = self._file.read()
        whole = content[: content.rfind(b"\n") + 1]
        if len(whole) < len(content):
            self._file.truncate(len(whole))
        if not whole:
            self._write([self.columns])
        elif whole.splitlines()[0].decode(errors="replace") != ",".join(self.columns):
            raise FileError(f"{self.path}: holds other columns than this study writes: name another folder.")

    def _write(self, lines: Sequence[Sequence[str]]) -> None:
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerows(lines)
        self._file.write(text.getvalue().encode())
        self._file.flush()
        os.fsync(self._file.fileno())


def read_table(path: str | Path) -> list[dict[str, Any]]:
    """The rows of a study's table: numbers as float, absent ones left out.

    A broken last line, as a running or killed study may leave it, is no row.

    Raises:
        FileError: If there is no such file, or a row does not fit its header.
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
    rows = []
    for number, line in enumerate(lines, 2):
        if len(line) != len(header):
            raise FileError(
                f"{path}: line {number} has {len(line)} fields, the header {len(header)}: mend or remove it."
            )
        try:
            rows.append(
                {c: x if c in TEXT else float(x) for c, x in zip(header, line, strict=True) if x != ""}
            )
        except ValueError as error:
            raise FileError(f"{path}: line {number}: {error}: mend or remove it.") from None
    return rows


def _text(value: Any) -> str:
    if value is None:
        return ""
    if isinstance(value, str):
        return " ".join(value.split())  # a row is a line
    return written(float(value))


def written(number: float) -> str:
    """A number as tables hold it, so that what is read can be compared with what was meant."""
    return f"{number:.7g}"


def _lock(file: BinaryIO, path: Path) -> None:
    """One writer at a time, where the system can say so; the lock ends with the program, however it ends."""
    try:
        import fcntl
    except ImportError:  # Windows
        return
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise FileError(f"{path}: another program is writing it: wait, or name another folder.") from None
