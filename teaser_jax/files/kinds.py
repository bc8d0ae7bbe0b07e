"""Kinds of files of clouds, told by how a file begins, and by its name where that tells nothing."""

from __future__ import annotations

from pathlib import Path

from teaser_jax.files.tables import TEXT
from teaser_jax.ground.io import FileError, visible

LOOKED_AT = 1024  # bytes

# What these are called by their suffix.
SUFFIXES = {
    ".ply": "PLY", ".pcd": "PCD", ".las": "LAS", ".laz": "LAS", ".e57": "E57", ".npz": "NPZ", ".npy": "NPY",
    ".mat": "MAT", ".bin": "KITTI", ".stl": "STL", ".obj": "OBJ", ".off": "OFF",
    **dict.fromkeys((*TEXT, ".asc", ".pts"), "text"),
}  # fmt: skip

# How they begin. A file that begins so is read as what it is, whatever its name.
STARTS = {
    "PLY": (b"ply\n", b"ply\r"),
    "PCD": (b"# .PCD", b"VERSION ", b"FIELDS "),
    "LAS": (b"LASF",),
    "E57": (b"ASTM-E57",),
    "NPZ": (b"PK\x03\x04", b"PK\x05\x06"),
    "NPY": (b"\x93NUMPY",),
    "MAT": (b"MATLAB ",),
    "OFF": (b"OFF", b"COFF"),
}
UNSIGNED = {"KITTI", "STL", "OBJ", "text"}  # nothing tells what these are but their names

# What else is found under the name of a cloud.
FOREIGN = {
    "is packed with gzip: unpack it first, with gunzip": (b"\x1f\x8b",),
    "is packed with bzip2: unpack it first": (b"BZh",),
    "is packed with xz: unpack it first": (b"\xfd7zXZ",),
    "is packed with zstd: unpack it first": (b"\x28\xb5\x2f\xfd",),
    "is an archive: unpack it first": (b"7z\xbc\xaf", b"Rar!"),
    "is a page of HTML and no data: the download gave a page in place of the file": (b"<!doctype", b"<html"),
    "is XML and no cloud": (b"<?xml",),
    "is a pointer of Git LFS and not the file itself: fetch that with git lfs pull": (b"version https://git-",),
    "is HDF5: save the points in it as .npz, with h5py and numpy.savez(path, points=points)": (b"\x89HDF",),
    "is a bag of ROS: export the clouds in it as .pcd": (b"#ROSBAG", b"\x89MCAP"),
    "is a pickle of Python, which may run code when it is read: save it as .npz": (
        b"\x80\x02", b"\x80\x03", b"\x80\x04", b"\x80\x05",
    ),
    "is a picture": (b"\x89PNG", b"\xff\xd8\xff", b"GIF8", b"II*\x00", b"MM\x00*"),
    "is a document": (b"%PDF", b"{\\rtf"),
    "is glTF: save it as .ply, .obj or .stl": (b"glTF",),
    "is JSON: save the points in it as .npz or .csv": (b"{",),
}  # fmt: skip


def kind_of(path: Path) -> str:
    """Tell the kind of a file.

    Raises:
        FileError: If it is empty, of a kind that cannot be read, or no cloud at all.
        OSError: If it cannot be read.
    """
    with path.open("rb") as file:
        start = file.read(LOOKED_AT)
    if not start:
        raise FileError(f"{path}: is empty.")
    for kind, signs in STARTS.items():
        if start.startswith(signs):
            return kind
    plain = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    for what, signs in FOREIGN.items():
        if start.startswith(signs) or plain.lower().startswith(signs):
            raise FileError(f"{path}: {what}.")
    named = SUFFIXES.get(path.suffix.lower())
    if named is None:
        known = ", ".join(SUFFIXES)
        raise FileError(f"{path}: unknown extension '{path.suffix}': give clouds as one of {known}.")
    if named not in UNSIGNED and not (named == "OFF" and b"OFF" in plain):  # a comment may stand before it
        begins = "numbers in text" if _is_text(start) and not plain[:1].isalpha() else f"'{_shown(start)}'"
        raise FileError(f"{path}: is no {named} file, which its name says: it begins with {begins}.")
    if not start.strip(b"\0"):
        raise FileError(f"{path}: holds nothing but zeros where it begins: a copy of it was broken off.")
    if named == "KITTI" and _is_text(start):
        raise FileError(f"{path}: is text, and scans of KITTI are binary: call it .txt, if it is a table.")
    return named


def _is_text(start: bytes) -> bool:
    return all(32 <= byte < 127 or byte in b"\t\r\n" for byte in start)


def _shown(start: bytes) -> str:
    return visible(start[:16].decode("latin-1"))
