"""Clouds and meshes from PLY: text, and binary of both byte orders.

The header has to be read here in any case, since what it declares is checked against the size of the file.
What follows is one table, and numpy reads that.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np
from jaxtyping import Float

from teaser_jax.files.cloud_file import CloudFile, from_columns
from teaser_jax.files.formats.meshes import is_a_model, sampled
from teaser_jax.files.models import read_shape
from teaser_jax.ground.io import FileError, check_room, visible
from teaser_jax.synthetic.models import Triangles

LONGEST_HEADER = 2**16  # bytes
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
KINDS = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


class Element(NamedTuple):
    """A table of the file: its name, its number of rows, and the kind of each column; None: a list."""

    name: str
    rows: int
    columns: dict[str, str | None]


class Header(NamedTuple):
    """What the header declares: the byte order, "" for text, the tables, and where they begin."""

    order: str
    elements: list[Element]
    length: int


def read_ply(path: Path) -> CloudFile:
    """Read the vertices of a PLY file, or points drawn from its triangles if it is clearly a model.

    Scans that were meshed have vertices wherever they have a surface, and those are the cloud. A file is a
    model if few large triangles make most of its surface, or if it has fewer than 5000 vertices.

    Raises:
        FileError: If it is broken, or holds no vertices.
        ImportError: If it has triangles, and trimesh is missing.
    """
    with path.open("rb") as file:
        header = _header(path, file)
        room = path.stat().st_size - header.length
        cloud = from_columns(path, _vertices(path, file, header, room))
    faces = next((x for x in header.elements if x.name == "face" and x.rows), None)
    if faces is None or not np.isfinite(cloud.points).all():
        return cloud
    check_room(path, faces.rows, 2 if header.order == "" else 1, room, item="faces")
    shape = read_shape(path, kind="ply")
    if not isinstance(shape, Triangles) or not is_a_model(shape):
        return cloud
    lost = cloud.colours is not None or cloud.intensity is not None
    drawn = sampled(path, shape)
    return replace(drawn, ignored=("not read: colours of the vertices",)) if lost else drawn


def _header(path: Path, file: BinaryIO) -> Header:
    order, elements = None, []
    start = file.read(LONGEST_HEADER)
    end = start.find(b"end_header")
    after = start.find(b"\n", end)
    if end < 0 or after < 0:
        raise FileError(f"{path}: its header has no end ('end_header'): it is cut off, or no PLY.")
    for line in start[:end].decode("ascii", "replace").splitlines()[1:]:
        words = line.split()
        match words:
            case [] | ["comment" | "obj_info", *_]:
                pass
            case ["format", name, *_] if name in ORDERS:
                order = ORDERS[name]
            case ["element", name, count] if count.isdecimal():
                elements.append(Element(name, int(count), {}))
            case ["property", "list", lengths, kind, name] if elements and {lengths, kind} <= KINDS.keys():
                elements[-1].columns[name] = None
            case ["property", kind, name] if elements and kind in KINDS:
                elements[-1].columns[name] = KINDS[kind]
            case _:
                raise FileError(f"{path}: its header has a line that no PLY has: '{visible(line)}'.")
    if order is None:
        raise FileError(f"{path}: its header has no line 'format': it is no PLY, or is broken.")
    return Header(order, elements, after + 1)


def _vertices(path: Path, file: BinaryIO, header: Header, room: int) -> dict[str, np.ndarray]:
    """Read the columns of the vertices, which come before all lists."""
    names = [element.name for element in header.elements]
    if "vertex" not in names:
        raise FileError(f"{path}: has no vertices (found: {visible(', '.join(names), 80) or 'nothing'}).")
    before = header.elements[: names.index("vertex")]
    vertex = header.elements[len(before)]
    if any(None in element.columns.values() for element in (*before, vertex)):
        raise FileError(
            f"{path}: has lists before or among its vertices: save it once more, for instance with MeshLab."
        )
    if vertex.rows == 0:
        raise FileError(f"{path}: holds no points: its header declares none.")
    if header.order == "":
        size = 2 * len(vertex.columns)  # a digit and a separator at least
        check_room(path, vertex.rows + sum(x.rows for x in before), max(size, 1), room + 1)
        file.seek(header.length)
        rows = _text_rows(path, file, sum(x.rows for x in before), vertex)
        return dict(zip(vertex.columns, rows.T, strict=True))
    kinds = [np.dtype([(n, f"{header.order}{k}") for n, k in x.columns.items()]) for x in (*before, vertex)]
    skipped = sum(x.rows * kind.itemsize for x, kind in zip(before, kinds, strict=False))
    check_room(path, vertex.rows, max(kinds[-1].itemsize, 1), room - skipped)
    file.seek(header.length + skipped)
    table = np.fromfile(file, kinds[-1], vertex.rows)
    return {name: table[name] for name in vertex.columns}


def _text_rows(path: Path, file: BinaryIO, skipped: int, vertex: Element) -> Float[np.ndarray, "n k"]:
    """Read the vertices of a text file, a row each."""
    width = len(vertex.columns)
    try:
        rows = np.loadtxt(
            file, skiprows=skipped, max_rows=vertex.rows, usecols=range(width), ndmin=2, comments=None,
            encoding="ascii",
        )  # fmt: skip
    except ValueError as error:
        raise FileError(f"{path}: its vertices cannot be read: {visible(str(error), 120)}.") from None
    if len(rows) < vertex.rows:
        raise FileError(f"{path}: declares {vertex.rows} points and holds {len(rows)}: it is cut off.")
    return rows
