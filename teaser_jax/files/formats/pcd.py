"""Clouds from PCD, the files of the Point Cloud Library: text, binary and compressed.

The header has to be read here in any case, since what it declares is checked against the size of the file;
numpy reads what follows it. ``lzf``, on which readers of PCD rest, unpacks.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from teaser_jax.files.cloud_file import CloudFile, from_columns
from teaser_jax.ground.extras import needed
from teaser_jax.ground.io import FileError, check_room, check_unpacked, or_file_error, visible

LONGEST_HEADER = 2**16  # bytes
SIZES = {"F": (4, 8), "U": (1, 2, 4, 8), "I": (1, 2, 4, 8)}
PACKED = ("rgb", "rgba")
CHANNELS = {"red": 16, "green": 8, "blue": 0}  # bits that stand below each
AT_THE_ORIGIN = ["0", "0", "0", "1", "0", "0", "0"]


class Field(NamedTuple):
    """A field of each point: its name, its kind for numpy, and how many numbers it has."""

    name: str
    kind: str
    numbers: int


class Header(NamedTuple):
    """What the header declares, and how long it is."""

    fields: list[Field]
    points: int
    data: str
    viewpoint: list[str]
    length: int


def read_pcd(path: Path) -> CloudFile:
    """Read the points of a PCD file, with colours and intensity if it has them.

    Raises:
        FileError: If it is broken, or holds no points.
        ImportError: If it is compressed, and the library that unpacks it is missing.
    """
    with path.open("rb") as file:
        header = _header(path, file)
        if header.points == 0:
            raise FileError(f"{path}: holds no points: its header declares none.")
        file.seek(header.length)
        room = path.stat().st_size - header.length
        read = {"ascii": _text, "binary": _binary, "binary_compressed": _compressed}[header.data]
        columns = read(path, file, header, room)
    cloud = from_columns(path, _with_colours(columns))
    if header.viewpoint == AT_THE_ORIGIN:
        return cloud
    seen = visible(" ".join(header.viewpoint), 80)
    return replace(cloud, ignored=(*cloud.ignored, f"not applied: the viewpoint of the header, {seen}"))


def _header(path: Path, file: BinaryIO) -> Header:
    start, lines, length = file.read(LONGEST_HEADER), {}, 0
    while "DATA" not in lines:
        end = start.find(b"\n", length)
        if end < 0:
            raise FileError(f"{path}: its header has no end ('DATA'): it is cut off, or no PCD.")
        words = start[length:end].decode("ascii", "replace").split("#")[0].split()
        if words:
            lines[words[0].upper()] = words[1:]
        length = end + 1
    lines.setdefault("FIELDS", lines.get("COLUMNS", []))  # of version 0.5
    names = lines["FIELDS"]
    lines.setdefault("COUNT", ["1"] * len(names))
    columns = [lines.get(key, []) for key in ("SIZE", "TYPE", "COUNT")]
    if not names or any(len(column) != len(names) for column in columns):
        raise FileError(f"{path}: its header does not give SIZE, TYPE and COUNT for each of its FIELDS.")
    fields = [_field(path, *words) for words in zip(names, *columns, strict=True)]
    shape = [*lines.get("WIDTH", []), *lines.get("HEIGHT", ["1"])]
    numbers = lines.get("POINTS") or shape
    if not numbers or not all(word.isdecimal() for word in numbers):
        raise FileError(f"{path}: its header does not say how many POINTS there are.")
    points = int(np.prod([int(word) for word in numbers], dtype=object))
    data = " ".join(lines["DATA"]).lower()
    if data not in ("ascii", "binary", "binary_compressed"):
        raise FileError(
            f"{path}: its header names '{visible(data)}' as DATA: expected ascii, binary or "
            "binary_compressed."
        )
    return Header(fields, points, data, lines.get("VIEWPOINT", AT_THE_ORIGIN), length)


def _field(path: Path, name: str, size: str, kind: str, count: str) -> Field:
    known = size.isdecimal() and int(size) in SIZES.get(kind, ())
    if not known or not count.isdecimal() or not 1 <= int(count) <= 10_000:
        words = visible(f"{name}: {size} {kind} {count}")
        raise FileError(f"{path}: its header declares a field that no PCD has ({words}).")
    return Field(name, f"<{kind.lower()}{size}", int(count))


def _with_colours(columns: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Unpack red, green and blue of one number of four bytes; empty fields go."""
    found = {name: column for name, column in columns.items() if name != "_"}
    for name in PACKED:
        if name in found and found[name].ndim == 1 and found[name].itemsize == 4:
            number = np.ascontiguousarray(found.pop(name)).view("<u4")
            found |= {c: (number >> s & 255).astype(np.uint8) for c, s in CHANNELS.items()}
    return found


def _text(path: Path, file: BinaryIO, header: Header, room: int) -> dict[str, np.ndarray]:
    width = sum(field.numbers for field in header.fields)
    check_room(path, header.points, 2 * width, room + 1)  # a digit and a separator at least
    try:
        rows = np.loadtxt(file, max_rows=header.points, ndmin=2, comments=None, encoding="ascii")
    except ValueError as error:
        raise FileError(f"{path}: its points cannot be read: {visible(str(error), 120)}.") from None
    if len(rows) < header.points or rows.shape[1] != width:
        raise FileError(
            f"{path}: declares {header.points} points of {width} numbers and holds {len(rows)} of "
            f"{rows.shape[1]}: it is cut off, or its header is wrong."
        )
    columns, first = {}, 0
    for field in header.fields:
        block = rows[:, first] if field.numbers == 1 else rows[:, first : first + field.numbers]
        columns[field.name] = block.astype(field.kind) if field.name in PACKED else block
        first += field.numbers
    return columns


def _binary(path: Path, file: BinaryIO, header: Header, room: int) -> dict[str, np.ndarray]:
    row = _row(header)
    check_room(path, header.points, row.itemsize, room)
    table = np.fromfile(file, row, header.points)
    return {field.name: table[str(k)] for k, field in enumerate(header.fields)}


def _compressed(path: Path, file: BinaryIO, header: Header, room: int) -> dict[str, np.ndarray]:
    """Unpack the fields, which follow one another, each with its values for all points."""
    lzf = needed("lzf", "compressed PCD needs python-neo-lzf", "clouds")
    if room < 8:
        raise FileError(f"{path}: ends where its points begin: it is cut off.")
    packed, unpacked = (int(size) for size in np.fromfile(file, "<u4", 2))
    check_room(path, packed, 1, room - 8, item="packed bytes")
    row = _row(header)
    if unpacked != header.points * row.itemsize:
        raise FileError(
            f"{path}: declares {header.points} points of {row.itemsize} bytes, packed from {unpacked} bytes: "
            "these do not fit together."
        )
    check_unpacked(path, unpacked, packed)
    what = "its points cannot be unpacked"
    data = or_file_error(path, what, lambda: lzf.decompress(file.read(packed), unpacked), quoting=False)
    if data is None or len(data) != unpacked:
        raise FileError(f"{path}: {what}: it is damaged.")
    columns, first = {}, 0
    for field in header.fields:
        block = np.frombuffer(data, field.kind, header.points * field.numbers, first)
        columns[field.name] = block if field.numbers == 1 else block.reshape(-1, field.numbers)
        first += block.nbytes
    return columns


def _row(header: Header) -> np.dtype:
    """Lay out a point; names may repeat, so that numbers stand for them."""
    shapes = [() if field.numbers == 1 else (field.numbers,) for field in header.fields]
    return np.dtype([(str(k), f.kind, shapes[k]) for k, f in enumerate(header.fields)])
