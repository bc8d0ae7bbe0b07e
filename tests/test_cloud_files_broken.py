"""Files of clouds that are broken, cut off, renamed or made to do harm: one line says what is wrong."""

from __future__ import annotations

import io
import os
import struct
import tracemalloc
import zipfile
import zlib

import cloud_files as good
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teaser_jax.files import FileError, read_cloud

HUGE = 10**12


def reason(path) -> str:
    """Why the file cannot be read: one line that names it."""
    with pytest.raises(FileError) as caught:
        read_cloud(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    assert len(message) < len(str(path)) + 420
    return message


def complaint(path) -> str:
    """Why the file cannot be read, or nothing; any other exception is a crash."""
    try:
        read_cloud(path)
    except FileError as error:
        return str(error)
    return ""


def header(form: str, vertices: int, *lines: str) -> bytes:
    wanted = lines or ("property float x", "property float y", "property float z")
    return "\n".join(
        ["ply", f"format {form} 1.0", f"element vertex {vertices}", *wanted, "end_header\n"]
    ).encode()


def pcd(data: str, points: int, body: bytes = b"", **lines: str) -> bytes:
    found = {"VERSION": "0.7", "FIELDS": "x y z", "SIZE": "4 4 4", "TYPE": "F F F", "COUNT": "1 1 1"}
    found |= {"WIDTH": str(points), "HEIGHT": "1", "POINTS": str(points)} | lines | {"DATA": data}
    return "".join(f"{key} {value}\n" for key, value in found.items()).encode() + body


def las(**changes: tuple[str, int, int]) -> bytes:
    """A LAS whose header says something else: the format, the place and the value of each change."""
    data = bytearray(good.las())
    for form, place, value in changes.values():
        struct.pack_into(form, data, place, value)
    return bytes(data)


def laz(chunks: int) -> bytes:
    """A LAZ whose table declares so many chunks: lazrs ends the process if it cannot have the memory."""
    data = bytearray(good.las(".laz"))
    (first,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, first)
    struct.pack_into(
        "<I", data, (table if table >= 0 else struct.unpack_from("<q", data, len(data) - 8)[0]) + 4, chunks
    )
    return bytes(data)


def npy(shape: str) -> bytes:
    told = f"{{'descr': '<f8', 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(told)) + told + bytes(100)


def zipped(**members: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name.replace("_npy", ".npy"), content)
    return buffer.getvalue()


def bomb() -> bytes:
    """An archive of a quarter of a GB of zeros in a quarter of a MB."""
    return good.npz(points=np.zeros((11_000_000, 3)))


BINARY = "binary_little_endian"
CUT = good.ply(BINARY)[:-50]
LZF = struct.pack("<II", 12, 12 * 10**6) + bytes(12)
BOMB = struct.pack("<II", 12, 12 * 10**8) + bytes(12)
TABLE = [
    # empty, renamed, and no cloud at all
    ("a.ply", b"", "is empty"),
    ("a.las", b"", "is empty"),
    ("a.odd", b"1 2 3\n", "unknown extension '.odd': give clouds as one of .ply, .pcd"),
    ("a.ply", b"1 2 3\n4 5 6\n", "is no PLY file, which its name says: it begins with numbers in text"),
    ("a.pcd", bytes(range(200, 250)), "is no PCD file, which its name says"),
    ("a.ply", b"\x1f\x8b\x08\0\0", "is packed with gzip: unpack it first"),
    ("a.las", b"BZh91AY&SY", "is packed with bzip2"),
    ("a.pcd", b"\xfd7zXZ\0\0", "is packed with xz"),
    ("a.ply", b"7z\xbc\xaf\x27\x1c", "is an archive"),
    ("a.pcd", b"<!DOCTYPE html>\n<html>", "is a page of HTML and no data"),
    ("a.npz", b"\n <html><head>", "is a page of HTML and no data"),
    ("a.e57", b'<?xml version="1.0"?>', "is XML"),
    ("a.ply", b"version https://git-lfs.github.com/spec/v1\noid", "is a pointer of Git LFS"),
    ("a.bin", b"version https://git-lfs.github.com/spec/v1\noid", "is a pointer of Git LFS"),
    ("a.npy", b"\x80\x04\x95\x0b\0\0\0\0", "is a pickle of Python, which may run code"),
    ("a.xyz", b"\x89PNG\r\n\x1a\n", "is a picture"),
    ("a.txt", b"%PDF-1.4", "is a document"),
    ("a.txt", b'{"points": [[1, 2, 3]]}', "is JSON"),
    ("a.bag", b"#ROSBAG V2.0\n", "is a bag of ROS: export the clouds in it as .pcd"),
    ("a.mat", b"\x89HDF\r\n\x1a\n" + bytes(99), "is HDF5"),
    ("a.mat", b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(512), "is of Matlab 7.3: save it there"),
    ("a.bin", b"1.5 2.5 3.5\n" * 16, "is text, and scans of KITTI are binary: call it .txt"),
    ("a.bin", bytes(1600), "holds nothing but zeros"),
    # PLY
    ("a.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "its header has no end"),
    ("a.ply", b"ply\nelement vertex 3\nend_header\n", "its header has no line 'format'"),
    ("a.ply", header("binary_middle_endian", 3), "a line that no PLY has: 'format binary_middle_endian 1.0'"),
    ("a.ply", header("ascii", 3, "property quad x"), "a line that no PLY has: 'property quad x'"),
    ("a.ply", header("ascii", 3, "element vertex -3"), "a line that no PLY has: 'element vertex -3'"),
    ("a.ply", header("ascii", 0), "holds no points: its header declares none"),
    ("a.ply", b"ply\nformat ascii 1.0\nelement face 1\nend_header\n3 0 1 2\n", "has no vertices (found: f"),
    ("a.ply", header("ascii", 1, "property float x", "property float y") + b"1 2\n", "has no column z"),
    ("a.ply", header("ascii", 2) + b"1 2 3\n", "declares 2 points and "),
    ("a.ply", header("ascii", 3) + b"1.5 2.5 3.5\n" * 2, "declares 3 points and holds 2: it is cut off"),
    ("a.ply", header("ascii", 2) + b"1 2 3\n4 5 six\n", "its vertices cannot be read"),
    ("a.ply", header("ascii", 2) + b"1.5 2.5 3.5\n4 5\n", "its vertices cannot be read"),
    ("a.ply", header("ascii", HUGE) + b"1 2 3\n", "declares 1000000000000 points and has room for"),
    ("a.ply", header(BINARY, HUGE) + bytes(900), "declares 1000000000000 points and has room for 75"),
    ("a.ply", header(BINARY, 10**40) + bytes(900), "room for 75: it is cut off, or its header is wrong"),
    ("a.ply", CUT, "declares 200 points and has room for 198"),
    ("a.ply", header(BINARY, 3, "property list uchar int x") + bytes(99), "has lists before or among"),
    # PCD
    ("a.pcd", b"# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\n", "its header has no end"),
    ("a.pcd", pcd("ascii", 1, b"1 2 3\n", SIZE="4 4"), "does not give SIZE, TYPE and COUNT for each"),
    ("a.pcd", pcd("ascii", 1, b"1 2 3\n", SIZE="4 4 3"), "a field that no PCD has (z: 3 F 1)"),
    ("a.pcd", pcd("ascii", 1, b"1 2 3\n", COUNT=f"1 1 {HUGE}"), "a field that no PCD has (z: 4 F 10000"),
    ("a.pcd", pcd("ascii", 1, b"1 2 3\n", POINTS="many"), "does not say how many POINTS"),
    ("a.pcd", pcd("ascii", 0), "holds no points"),
    ("a.pcd", pcd("zipped", 1, b"1 2 3\n"), "names 'zipped' as DATA"),
    ("a.pcd", pcd("ascii", 1, b"1 2 3\n", FIELDS="x y t"), "has no column z (found: x, y, t)"),
    ("a.pcd", pcd("ascii", 2, b"1.25 2.25 3.25\n"), "declares 2 points of 3 numbers and holds 1"),
    ("a.pcd", pcd("ascii", 1, b"1 two 3\n"), "its points cannot be read"),
    ("a.pcd", pcd("ascii", HUGE, b"1 2 3\n"), "has room for"),
    ("a.pcd", pcd("binary", HUGE, bytes(600)), "declares 1000000000000 points and has room for 50"),
    ("a.pcd", pcd("binary", 51, bytes(600)), "declares 51 points and has room for 50"),
    ("a.pcd", pcd("binary_compressed", 5, b"\1\2\3"), "ends where its points begin"),
    ("a.pcd", pcd("binary_compressed", 10**6, LZF[:-3]), "declares 12 packed bytes and has room for 9"),
    ("a.pcd", pcd("binary_compressed", 10, LZF), "these do not fit together"),
    ("a.pcd", pcd("binary_compressed", 10**8, BOMB), "which no cloud is"),
    ("a.pcd", pcd("binary_compressed", 10**6, LZF), "its points cannot be unpacked"),
    # arrays
    ("a.npz", b"PK\x03\x04 and then nothing", "is no .npz archive, or is broken"),
    ("a.npz", good.npz(points=good.POINTS)[:300], "is no .npz archive, or is broken"),
    ("a.npz", zipped(), "no array of three columns or more (found: nothing)"),
    ("a.npz", zipped(readme=b"hello"), "is no .npz archive, or is broken"),
    ("a.npz", good.npz(a=good.POINTS, b=good.POINTS), "several arrays that may be points (found: a (200"),
    ("a.npz", good.npz(T=np.eye(4)), "no array of three columns or more (found: T (4, 4))"),
    ("a.npz", good.npz(points=np.array([{}, None])), "Object arrays cannot be loaded"),
    ("a.npz", good.npz(points=good.POINTS.T), "save its transpose"),
    ("a.npz", zipped(points_npy=npy(f"({HUGE}, 3)")), "declares 3000000000000 numbers and has room for 12"),
    ("a.npz", bomb(), "which no cloud is"),
    ("a.npy", npy(f"({HUGE}, 3)"), "is no .npy array, or is broken"),
    ("a.npy", good.npy(good.POINTS)[:-1], "is no .npy array, or is broken"),
    ("a.npy", good.npy(good.POINTS[:, :2]), "holds an array of shape (200, 2) of float64: expected (n, 3)"),
    ("a.npy", good.npy(good.POINTS.astype(str)), "holds an array of shape (200, 3) of <U"),
    ("a.npy", good.npy(good.POINTS[:0]), "holds an array of shape (0, 3)"),
    ("a.mat", good.mat(points=good.POINTS)[:200], "cannot be read"),
    ("a.mat", b"MATLAB 5.0 MAT-file" + bytes(range(256)) * 2, "is no Matlab file, or is broken"),
    ("a.mat", good.mat(name="text"), "no array of three columns or more (found: name"),
    # text
    ("a.txt", b"\xff\xfe1\0 \x002\0", "is not text: expected at least three columns of numbers"),
    ("a.txt", b"# nothing\n\n", "holds no point: expected at least three numbers a row"),
    ("a.csv", b"x,y,z\n", "holds no point"),
    ("a.txt", b"1 2\n3 4\n", "line 1 has 2 columns: expected at least three, x y z"),
    ("a.csv", b"1,2,3\n4,5,6,7\n", "line 2 has 4 columns: expected 3, as in the first row"),
    ("a.csv", b"x,y,z\n1,2,3\n4,,6\n", "line 3 has nothing in column 2"),
    ("a.csv", b"1;2;3\n4;5;six\n", "line 2 holds 'six' in column 3: expected at least three numbers"),
    # scans
    ("a.bin", good.kitti()[:-3], "has 3197 bytes, which are no scan of 4 numbers"),
    ("a.bin", np.random.default_rng(0).bytes(16_000), "holds no coordinates"),
    ("a.las", good.las()[:100], "ends within its header"),
    ("a.las", las(points=("<Q", 247, HUGE)), "declares 1000000000000 points and has room for 200"),
    ("a.las", good.las()[:-1], "declares 200 points and has room for 199"),
    ("a.las", las(records=("<I", 100, 2**32 - 1)), "declares 4294967295 records and has room for"),
    ("a.las", las(length=("<H", 105, 3)), "declares points of 3 bytes"),
    ("a.las", las(points=("<Q", 247, 0)), "holds no points"),
    ("a.laz", good.las(".laz")[:-300], "has no table of its chunks: it is cut off"),
    ("a.laz", laz(2**32 - 1), "declares 4294967295 chunks and has room for"),
    ("a.e57", b"ASTM-E57" + bytes(8), "ends within its header"),
    ("a.e57", b"ASTM-E57" + struct.pack("<II", 1, 0) + struct.pack("<QQQQ", 2048, 0, 0, 1024), "2048 bytes"),
    # meshes
    ("a.stl", b"solid nothing\nendsolid\n", "cannot be read as a model"),
    ("a.stl", good.mesh("stl")[:-10], "cannot be read as a model"),
    ("a.stl", bytes(80) + struct.pack("<I", 10**9) + bytes(50), "cannot be read as a model"),
    ("a.obj", b"v 1 2\nf 1 2 3\n", "cannot be read as a model"),
    ("a.off", b"OFF\n1000000000000 4 0\n0 0 0\n", "cannot be read as a model"),
    ("a.off", b"0 0 0\n", "is no OFF file"),
    ("a.off", good.mesh("off", np.zeros((4, 3))), "its triangles have no area"),
]  # fmt: skip


@pytest.mark.parametrize(("name", "content", "message"), TABLE)
def test_what_is_wrong_is_said_in_one_line(tmp_path, capfd, name, content, message):
    if name == "a.e57" and b"ASTM" in content:
        pytest.importorskip("pye57")
    path = tmp_path / name
    path.write_bytes(content)
    assert message in reason(path)
    assert "".join(capfd.readouterr()) == ""


def test_the_table_is_long_enough():
    assert len(TABLE) >= 40


def test_broken_e57(tmp_path, capfd):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    whole = good.e57(path, [(good.POINTS, [1.0, 0, 0, 0], [0.0, 0, 0])])
    path.write_bytes(whole[:-10])
    assert "it is cut off" in reason(path)
    middle = len(whole) // 2
    path.write_bytes(whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :])
    assert "is no E57 file, or is broken" in reason(path)
    assert "".join(capfd.readouterr()) == ""


def test_what_a_header_declares_takes_no_memory(tmp_path):
    import scipy.io  # noqa: F401  what is imported takes some

    declared = [row for row in TABLE if str(HUGE) in row[2] or "which no cloud is" in row[2]]
    assert len(declared) >= 6
    for name, content, _ in declared:
        (tmp_path / name).write_bytes(content)
        tracemalloc.start()
        reason(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 5e6
        tracemalloc.stop()


def test_a_matlab_file_that_would_unpack_without_end(tmp_path):
    """A matrix that declares 8 TB."""
    path = tmp_path / "a.mat"
    content = good.mat(points=good.POINTS)
    packed = bytearray(zlib.decompress(content[136:]))
    place = packed.index(struct.pack("<II", 200, 3))
    struct.pack_into("<II", packed, place, 2**31 - 1, 512)
    body = zlib.compress(bytes(packed))
    path.write_bytes(content[:128] + struct.pack("<II", 15, len(body)) + body)
    assert "which no cloud is" in reason(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes with names")
def test_what_is_no_ordinary_file(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    assert "is no ordinary file" in reason(tmp_path / "a.ply")
    assert "cannot be read" in reason(tmp_path / ("x" * 300 + ".ply"))


WHOLE = {
    f"{k}.{name.split('.', 1)[1]}": make()
    for k, (name, make) in enumerate([*good.GOOD.values(), *good.BARE.values()])
}
WHOLE |= {f"m.{kind}": good.mesh(kind) for kind in ("ply", "stl", "obj", "off")}


@pytest.mark.long
@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_files_are_refused_or_read_but_never_crash(tmp_path, data):
    name = data.draw(st.sampled_from(sorted(WHOLE)))
    content = bytearray(WHOLE[name])
    for _ in range(data.draw(st.integers(0, 4))):
        reach = data.draw(st.sampled_from([len(content), min(400, len(content))]))  # headers are short
        content[data.draw(st.integers(0, reach - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content))) :]
    path = tmp_path / name
    path.write_bytes(content)
    assert len(complaint(path).splitlines()) <= 1
