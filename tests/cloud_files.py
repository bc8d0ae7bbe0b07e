"""Good files of clouds of every kind, written by other libraries where there are some."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

RNG = np.random.default_rng(0)
N = 200
POINTS = RNG.normal(size=(N, 3)).astype(np.float32).astype(np.float64)
COLOURS = RNG.integers(0, 256, (N, 3)).astype(np.uint8)
INTENSITY = RNG.random(N).astype(np.float32).astype(np.float64)
UTM = np.round(RNG.uniform(0, 100, (N, 3)) + [691_000, 5_334_000, 520], 3)  # to the millimetre [m]
CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]


def ply(form: str = "ascii", points: np.ndarray = POINTS, kind: str = "double", extra: bool = True) -> bytes:
    """A PLY with normals that nobody reads, an element before the vertices, and colours."""
    order = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}[form]
    size = {"double": "f8", "float": "f4"}[kind]
    fields = [(axis, order + size) for axis in "xyz"]
    lines = ["ply", f"format {form} 1.0", "comment made by hand", "element camera 1", "property float f"]
    lines += [f"element vertex {len(points)}", *(f"property {kind} {axis}" for axis in "xyz")]
    if extra:
        fields += [("nx", order + "f4"), *((c, "u1") for c in ("red", "green", "blue")), ("i", order + "f4")]
        lines += ["property float nx", *(f"property uchar {c}" for c in ("red", "green", "blue"))]
        lines += ["property float intensity"]
    table = np.zeros(len(points), fields)
    for k, axis in enumerate("xyz"):
        table[axis] = points[:, k]
    if extra:
        table["red"], table["green"], table["blue"] = COLOURS.T
        table["i"] = INTENSITY
    head = "\n".join([*lines, "element face 0", "property list uchar int vertex_indices", "end_header\n"])
    if form == "ascii":
        rows = "".join(" ".join(repr(x.item()) for x in row) + "\n" for row in table)
        return (head + "0.5\n" + rows).encode()
    return head.encode() + struct.pack(order + "f", 0.5) + table.tobytes()


def pcd(data: str = "ascii", points: np.ndarray = POINTS) -> bytes:
    """A PCD by pypcd4, with packed colours and an intensity."""
    from pypcd4 import Encoding, PointCloud

    packed = (COLOURS.astype(np.uint32) * np.array([65536, 256, 1], np.uint32)).sum(1, dtype=np.uint32)
    columns = [*points.T, packed.view(np.float32), INTENSITY]
    kinds = (np.float64, np.float64, np.float64, np.float32, np.float32)
    cloud = PointCloud.from_points(columns, ("x", "y", "z", "rgb", "intensity"), kinds)
    if data == "ascii":  # of which pypcd4 writes ten digits behind the point
        rows = "".join(" ".join(repr(x.item()) for x in row) + "\n" for row in cloud.pc_data)
        return (cloud.metadata.compose_header(Encoding.ASCII) + rows).encode()
    buffer = io.BytesIO()
    cloud.save(buffer, Encoding(data))
    return buffer.getvalue()


def las(suffix: str = ".las", points: np.ndarray = POINTS, kind: int = 7, scale: float = 1e-6) -> bytes:
    """A LAS or LAZ by laspy."""
    import laspy

    made = laspy.LasData(laspy.LasHeader(point_format=kind, version="1.4" if kind > 5 else "1.2"))
    made.header.offsets, made.header.scales = np.floor(points.min(axis=0)), np.full(3, scale)
    made.x, made.y, made.z = points.T
    made.intensity = np.arange(N, dtype=np.uint16)
    if "red" in made.point_format.dimension_names:
        made.red, made.green, made.blue = COLOURS.T.astype(np.uint16) * 257
    buffer = io.BytesIO()
    made.write(buffer, do_compress=suffix == ".laz")
    return buffer.getvalue()


def e57(path: Path, scans: list[tuple[np.ndarray, list[float], list[float]]], **more: np.ndarray) -> bytes:
    """An E57 by pye57: the points of each scan in its own frame, with its rotation and translation."""
    import pye57

    with pye57.E57(str(path), mode="w") as file:
        for points, rotation, translation in scans:
            columns = {f"cartesian{axis}": column for axis, column in zip("XYZ", points.T, strict=True)}
            file.write_scan_raw(
                columns | more, rotation=np.array(rotation), translation=np.array(translation)
            )
    return path.read_bytes()


def fine_e57(path: Path, points: np.ndarray, colours: np.ndarray) -> None:
    """An E57 with coordinates in double precision and colours of 16 bits, which ``e57`` cannot write."""
    import pye57
    from pye57 import libe57

    with pye57.E57(str(path), mode="w") as file:
        image = file.image_file
        row, buffers = libe57.StructureNode(image), libe57.VectorSourceDestBuffer()
        columns = {f"cartesian{axis}": column for axis, column in zip("XYZ", points.T, strict=True)}
        columns |= {f"color{c}": colours[:, k] for k, c in enumerate(("Red", "Green", "Blue"))}
        columns = {name: np.ascontiguousarray(column) for name, column in columns.items()}
        for name, column in columns.items():
            double = column.dtype == np.float64
            limits = float(column.min()), float(column.max())
            node = libe57.FloatNode(image, limits[0], libe57.E57_DOUBLE, *limits) if double else None
            row.set(name, node or libe57.IntegerNode(image, 0, 0, 2**16 - 1))
            buffers.append(libe57.SourceDestBuffer(image, name, column, len(column), True, True))
        scan = libe57.StructureNode(image)
        scan.set("guid", libe57.StringNode(image, "{1}"))
        table = libe57.CompressedVectorNode(image, row, libe57.VectorNode(image, True))
        scan.set("points", table)
        file.data3d.append(scan)
        writer = table.writer(buffers)
        writer.write(len(points))
        writer.close()


def npz(**arrays: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def npy(array: np.ndarray) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def mat(**arrays: np.ndarray) -> bytes:
    from scipy.io import savemat

    buffer = io.BytesIO()
    savemat(buffer, arrays, do_compression=True)
    return buffer.getvalue()


def text(delimiter: str = " ", header: str = "", columns: np.ndarray = POINTS) -> bytes:
    buffer = io.StringIO()
    np.savetxt(buffer, columns, delimiter=delimiter, header=header, comments="", fmt="%.17g")
    return buffer.getvalue().encode()


def kitti() -> bytes:
    return np.column_stack([POINTS, INTENSITY]).astype("<f4").tobytes()


def mesh(kind: str, vertices: np.ndarray = CORNERS, faces: list | np.ndarray = FACES) -> bytes:
    """A tetrahedron or whatever is given, by trimesh."""
    import trimesh

    made = trimesh.Trimesh(vertices, faces, process=False).export(file_type=kind)
    return made.encode() if isinstance(made, str) else made


ALL = np.column_stack([POINTS, COLOURS, INTENSITY])
NAMED = "x{0}y{0}z{0}red{0}green{0}blue{0}intensity"
GOOD: Mapping[str, tuple[str, Callable[[], bytes]]] = {
    "ply in text": ("a.ply", lambda: ply()),
    "ply, little-endian": ("a.ply", lambda: ply("binary_little_endian")),
    "ply, big-endian, single": ("a.PLY", lambda: ply("binary_big_endian", kind="float")),
    "ply, lines of Windows": ("a.ply", lambda: ply().replace(b"\n", b"\r\n")),
    "pcd in text": ("a.pcd", lambda: pcd()),
    "pcd, binary": ("a.pcd", lambda: pcd("binary")),
    "pcd, compressed": ("a.pcd", lambda: pcd("binary_compressed")),
    "npz": ("a.npz", lambda: npz(points=POINTS, colours=COLOURS, intensity=INTENSITY)),
    "npz, other names": ("a.npz", lambda: npz(xyz=POINTS, colors=COLOURS, intensity=INTENSITY, T=np.eye(4))),
    "mat": ("a.mat", lambda: mat(points=POINTS, rgb=COLOURS, intensity=INTENSITY)),
    "csv with names": ("a.csv", lambda: text(",", NAMED.format(","), ALL)),
    "txt with names in a comment": ("a.txt", lambda: text(" ", "# by hand\n# " + NAMED.format(" "), ALL)),
    "xyz of CloudCompare": ("a.xyz", lambda: text(" ", "//X Y Z R G B Scalar_Intensity", ALL)),
    "tsv, other columns first": (
        "a.tsv", lambda: text("\t", "id\t" + NAMED.format("\t"), np.column_stack([np.arange(N), ALL])),
    ),
    "las": ("a.las", lambda: las()),
    "laz": ("a.laz", lambda: las(".laz")),
    "las 1.2": ("a.las", lambda: las(kind=3)),
}  # fmt: skip
BARE: Mapping[str, tuple[str, Callable[[], bytes]]] = {
    "txt": ("a.txt", lambda: text()),
    "csv": ("a.csv", lambda: text(",")),
    "dat with decimal commas": ("a.dat", lambda: text(";").replace(b".", b",")),
    "decimal commas between blanks": ("a.txt", lambda: text("  ").replace(b".", b",")),
    "pts": ("a.pts", lambda: b"%d\n" % N + text()),
    "more columns": ("a.asc", lambda: text(columns=ALL)),
    "npy": ("a.npy", lambda: npy(POINTS)),
    "npy, column-major": ("a.npy", lambda: npy(np.asfortranarray(POINTS))),
    "npy of records": ("a.npy", lambda: npy(np.rec.fromarrays(POINTS.T, names="x,y,z"))),
    "npz with one array": ("a.npz", lambda: npz(arr_0=POINTS)),
    "mat with one": ("a.mat", lambda: mat(scan=POINTS)),
    "kitti": ("a.bin", kitti),
    "nuScenes": ("a.pcd.bin", lambda: np.column_stack([POINTS, ALL[:, 5:]]).astype("<f4").tobytes()),
    "ply without more": ("a.ply", lambda: ply(extra=False)),
    "obj without faces": ("a.obj", lambda: b"".join(b"v %r %r %r\n" % tuple(p) for p in POINTS.tolist())),
    "las without colours": ("a.las", lambda: las(kind=0)),
}  # fmt: skip
