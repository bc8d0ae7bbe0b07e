"""Tables of numbers in text: separators, headers, comments and decimal commas as people write them."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from jaxtyping import Float

from teaser_jax.ground.io import FileError, one_line, visible

TEXT = (".txt", ".csv", ".tsv", ".dat", ".xyz")
SEPARATORS = ";,\t|"
DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")


class Layout(NamedTuple):
    """What a table holds, for its errors.

    Attributes:
        item: What a row is.
        numbers: How many numbers it has, in words.
        columns: The same with their meaning.
        fewest, most: How many columns there may be.
    """

    item: str
    numbers: str
    columns: str
    fewest: int
    most: int | None = None


class Table(NamedTuple):
    """Columns of a table that were read, and their names, where it has any; the names of all others."""

    rows: Float[np.ndarray, "n k"]
    names: tuple[str, ...]
    others: tuple[str, ...] = ()


def read_table(
    path: Path, layout: Layout, choose: Callable[[Sequence[str]], Sequence[int] | None] | None = None
) -> Table:
    """Read a table whose rows all have as many columns as the first one.

    Columns are separated by white space, commas, semicolons, tabs or bars; decimal commas are understood
    where commas separate nothing. One line of column names (also 0, 1, 2 and so on, which pandas writes), a
    line that only tells how many rows follow, and ``#`` comments are skipped.

    Args:
        path: The file.
        layout: What is expected.
        choose: Tells from the names of the columns, in lower case, which to read; None: all, which is also
            what becomes of columns without names. Those that are not read may hold anything.

    Raises:
        FileError: If it is no such table, with the line and the column.
        OSError: If it cannot be read.
    """
    rows, comment = _rows(path, layout)
    if len(rows) > 1 and rows[0][1].strip() == str(len(rows) - 1):
        rows = rows[1:]
    delimiter = _delimiter(rows[0][1]) if rows else None
    names: list[str] = []
    if rows and _is_header(_fields(rows[0][1], delimiter)):
        names = _fields(rows[0][1], delimiter)
        rows = rows[1:]
        delimiter = _delimiter(rows[0][1]) if rows else None
    if rows and _has_decimal_commas(rows[0][1], delimiter, layout):
        delimiter = None if delimiter == "," else delimiter
        rows = [(number, line.replace(",", ".")) for number, line in rows]
    if not rows:
        raise FileError(f"{path}: holds no {layout.item}: expected {layout.numbers} a row.")
    width = len(_fields(rows[0][1], delimiter))
    names = [name.lstrip("/ ").lower() for name in names or re.split(rf"[{SEPARATORS}\s]+", comment)]
    names = names if len(names) == width else []
    columns = choose(names) if choose and names else None
    table = _numbers(path, layout, rows, delimiter, columns)
    columns = range(width) if columns is None else columns
    others = tuple(name for k, name in enumerate(names) if k not in columns)
    return Table(table, tuple(names[k] for k in columns) if names else (), others)


def _rows(path: Path, layout: Layout) -> tuple[list[tuple[int, str]], str]:
    """Read the lines that hold something, with their numbers, and the last comment before them."""
    try:
        lines = path.read_text(encoding="utf-8-sig").replace('"', "").splitlines()
    except UnicodeDecodeError:
        count = layout.numbers.removesuffix(" numbers")
        raise FileError(f"{path}: is not text: expected {count} columns of numbers.") from None
    numbered = ((number, line.partition("#")[0]) for number, line in enumerate(lines, 1))
    rows = [(number, line) for number, line in numbered if line.strip()]
    before = lines[: rows[0][0] - 1] if rows else []
    comments = [line.strip("# \t") for line in before if line.strip("# \t")]
    return rows, comments[-1] if comments else ""


def _numbers(
    path: Path,
    layout: Layout,
    rows: list[tuple[int, str]],
    delimiter: str | None,
    columns: Sequence[int] | None,
) -> Float[np.ndarray, "n k"]:
    reason = ""
    try:
        lines = [line for _, line in rows]
        table = np.loadtxt(lines, delimiter=delimiter, usecols=columns, ndmin=2)
    except ValueError as error:
        table, reason = np.empty((0, 0)), str(error)
    enough = 1 if columns else layout.fewest
    if reason or table.shape[1] < enough or (layout.most is not None and table.shape[1] > layout.most):
        _raise_for(path, layout, rows, delimiter, columns, reason)
    return table


def _raise_for(
    path: Path,
    layout: Layout,
    rows: list[tuple[int, str]],
    delimiter: str | None,
    columns: Sequence[int] | None,
    reason: str,
) -> NoReturn:
    """Find the line that is wrong, and say what is wrong with it."""
    width = len(_fields(rows[0][1], delimiter))
    for number, line in rows:
        where, fields = f"{path}: line {number}", _fields(line, delimiter)
        if len(fields) < layout.fewest or (layout.most is not None and len(fields) > layout.most):
            raise FileError(f"{where} has {len(fields)} columns: expected {layout.columns}.")
        if len(fields) != width:
            raise FileError(f"{where} has {len(fields)} columns: expected {width}, as in the first row.")
        for column in range(width) if columns is None else columns:
            if not fields[column]:
                raise FileError(
                    f"{where} has nothing in column {column + 1}: leave the row out, or write nan there."
                )
            if not _is_number(fields[column]):
                raise FileError(
                    f"{where} holds '{visible(fields[column])}' in column {column + 1}: "
                    f"expected {layout.numbers}."
                )
    raise FileError(f"{path}: cannot be read ({one_line(reason)}): expected {layout.numbers} a row.")


def _delimiter(line: str) -> str | None:
    return next((d for d in SEPARATORS if d in line), None)


def _fields(line: str, delimiter: str | None) -> list[str]:
    return [field.strip() for field in line.split(delimiter)]


def _is_header(fields: list[str]) -> bool:
    """Tell whether a first row holds column names: anything else that is no number is an error instead."""
    of_pandas = [str(k) for k in range(len(fields))]  # the names in a table that was given none
    named = all(any(c.isalpha() for c in field) and not _is_number(field) for field in fields)
    return named or (len(fields) > 2 and fields == of_pandas)


def _has_decimal_commas(line: str, delimiter: str | None, layout: Layout) -> bool:
    """Tell whether commas are decimal points: numbers with commas, and something else between them."""
    fields = _fields(line, None if delimiter == "," else delimiter)
    right = layout.fewest <= len(fields) <= (layout.most or len(fields))
    return "," in line and right and all(DECIMAL_COMMA.fullmatch(field) for field in fields)


def _is_number(field: str) -> bool:
    try:
        float(field)
    except ValueError:
        return False
    return True
