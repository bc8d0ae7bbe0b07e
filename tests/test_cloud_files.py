"""Files of clouds: whole ones of every kind, and what is read from them."""

from __future__ import annotations

import logging
import subprocess
import sys

import cloud_files as good
import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.files import FileError, read_cloud, write_cloud
from teaser_jax.files.formats.meshes import DRAWN

ROUNDED = {".las": 1e-6, ".laz": 1e-6}  # by those who write them


def written(folder, name: str, content: bytes):
    path = folder / name
    path.write_bytes(content)
    return path


@pytest.mark.parametrize("case", good.GOOD)
def test_points_colours_and_intensity(tmp_path, capfd, case):
    name, make = good.GOOD[case]
    cloud = read_cloud(str(written(tmp_path, name, make())))
    np.testing.assert_allclose(cloud.points, good.POINTS, atol=ROUNDED.get(name[-4:], 0), rtol=0)
    np.testing.assert_array_equal(cloud.colours, good.COLOURS)
    expected = np.arange(good.N) if name.endswith(("las", "laz")) else good.INTENSITY
    np.testing.assert_allclose(cloud.intensity, expected, rtol=1e-7)
    assert cloud.triangles == 0
    assert "".join(capfd.readouterr()) == ""


@pytest.mark.parametrize("case", good.BARE)
def test_points_alone(tmp_path, case):
    name, make = good.BARE[case]
    cloud = read_cloud(written(tmp_path, name, make()))
    np.testing.assert_allclose(cloud.points, good.POINTS, atol=ROUNDED.get(name[-4:], 0), rtol=0)
    assert cloud.colours is None
    assert (cloud.intensity is not None) == name.endswith(("bin", "las"))


@pytest.mark.parametrize(
    ("name", "content", "sentence"),
    [
        ("a.ply", lambda: good.ply(), "not read: nx"),
        ("a.txt", lambda: good.text(columns=good.ALL), "not read: the columns behind the third"),
        ("a.tsv", lambda: good.GOOD["tsv, other columns first"][1](), "not read: id"),
        ("a.npz", lambda: good.npz(points=good.POINTS, T=np.eye(4)), "not read: T"),
        ("a.npy", lambda: good.npy(good.ALL), "not read: the 4 column(s) behind x, y, z"),
        ("a.pcd", lambda: good.ply(), "the extension '.pcd' is ignored: the file begins as PLY does"),
        ("a.txt", lambda: good.pcd("binary"), "the extension '.txt' is ignored"),
        ("a.xyz", lambda: good.las(".laz"), "the extension '.xyz' is ignored"),
        ("a", lambda: good.npy(good.POINTS), "the extension '' is ignored"),
        (
            "a.pcd",
            lambda: good.pcd().replace(b"VIEWPOINT 0.0 0.0 0.0", b"VIEWPOINT 1 2 3"),
            "not applied: the viewpoint of the header, 1 2 3 1.0 0.0 0.0 0.0",
        ),
    ],
)
def test_what_is_not_read_is_said(tmp_path, name, content, sentence):
    cloud = read_cloud(written(tmp_path, name, content()))
    np.testing.assert_allclose(cloud.points, good.POINTS, atol=1e-6)
    assert any(sentence in told for told in cloud.ignored), cloud.ignored


def test_several_scans_of_e57_stand_in_the_frame_of_the_file(tmp_path, capfd):
    pytest.importorskip("pye57")
    turn = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]  # w x y z: a quarter about z
    scans = [(good.POINTS, [1.0, 0, 0, 0], [0.0, 0, 0]), (good.POINTS, turn, [691_000.125, 5_334_000.5, 7])]
    path = tmp_path / "a.e57"
    colours = {f"color{c}": good.COLOURS[:, k] for k, c in enumerate(("Red", "Green", "Blue"))}
    good.e57(path, scans, intensity=good.INTENSITY.astype(np.float32), **colours)
    cloud = read_cloud(path)
    x, y, z = good.POINTS.T
    moved = np.stack([691_000.125 - y, 5_334_000.5 + x, 7 + z], axis=1)
    np.testing.assert_allclose(cloud.points, np.vstack([good.POINTS, moved]), atol=1e-9 * 5e6)
    np.testing.assert_array_equal(cloud.colours, np.vstack([good.COLOURS] * 2))
    np.testing.assert_array_equal(cloud.intensity, np.hstack([good.INTENSITY] * 2))
    assert "".join(capfd.readouterr()) == ""


def test_e57_in_double_precision_with_colours_that_pye57_does_not_read(tmp_path):
    pytest.importorskip("pye57")
    path = tmp_path / "a.e57"
    good.fine_e57(path, good.UTM, good.COLOURS.astype(np.uint16) * 257)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, good.UTM)
    assert cloud.colours is None
    assert cloud.ignored == ("not read: colours, which not all scans have as bytes",)


def test_invalid_points_of_e57_are_counted(tmp_path):
    pytest.importorskip("pye57")
    invalid = np.zeros(good.N, np.int8)
    invalid[:5] = 1
    path = tmp_path / "a.e57"
    good.e57(path, [(good.POINTS, [1.0, 0, 0, 0], [0.0, 0, 0])], cartesianInvalidState=invalid)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, good.POINTS[5:])
    assert cloud.ignored == ("not read: 5 point(s) marked invalid",)


FAR = [691_000.0, 5_334_000.0, 520.0]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.las", lambda path: good.las(points=good.UTM, scale=0.001)),
        ("a.laz", lambda path: good.las(".laz", good.UTM, scale=0.001)),
        ("a.ply", lambda path: good.ply("binary_little_endian", good.UTM)),
        ("a.ply", lambda path: good.ply(points=good.UTM)),
        ("a.pcd", lambda path: good.pcd(points=good.UTM)),
        ("a.pcd", lambda path: good.pcd("binary_compressed", good.UTM)),
        ("a.txt", lambda path: good.text(columns=good.UTM)),
        ("a.csv", lambda path: good.text(";", columns=good.UTM).replace(b".", b",")),
        ("a.npz", lambda path: good.npz(points=good.UTM)),
        ("a.mat", lambda path: good.mat(points=good.UTM)),
        ("a.obj", lambda path: b"".join(b"v %.3f %.3f %.3f\n" % tuple(p) for p in good.UTM.tolist())),
        ("a.e57", lambda path: good.e57(path, [(good.UTM - FAR, [1.0, 0, 0, 0], FAR)])),
    ],
)
def test_coordinates_of_utm_are_kept_to_the_millimetre(tmp_path, name, content):
    if name == "a.e57":
        pytest.importorskip("pye57")
    path = written(tmp_path, name, content(tmp_path / name))
    np.testing.assert_allclose(read_cloud(path).points, good.UTM, rtol=0, atol=1e-5)


ODD = good.POINTS.copy()
ODD[3], ODD[7], ODD[8] = np.nan, 0, ODD[9]


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.ply", lambda: good.ply("binary_little_endian", ODD)),
        ("a.ply", lambda: good.ply(points=ODD)),
        ("a.pcd", lambda: good.pcd("binary", ODD)),
        ("a.pcd", lambda: good.pcd("binary_compressed", ODD)),
        ("a.csv", lambda: good.text(",", columns=ODD)),
        ("a.npy", lambda: good.npy(ODD)),
        ("a.bin", lambda: np.pad(ODD, ((0, 0), (0, 1))).astype("<f4").tobytes()),
    ],
)
def test_the_reader_leaves_nothing_out(tmp_path, name, content):
    np.testing.assert_array_equal(read_cloud(written(tmp_path, name, content())).points, ODD)


@pytest.mark.parametrize("kind", ["ply", "stl", "stl_ascii", "obj", "off"])
def test_models_are_sampled_evenly_and_always_alike(tmp_path, kind):
    path = written(tmp_path, f"a.{kind.split('_')[0]}", good.mesh(kind))
    cloud = read_cloud(path)
    assert (len(cloud), cloud.triangles) == (DRAWN, 4)
    np.testing.assert_array_equal(cloud.points, read_cloud(path).points)
    outside = np.maximum(0, -cloud.points.min(axis=1)) + np.maximum(0, cloud.points.sum(axis=1) - 1)
    assert outside.max() < 1e-6
    slanted = np.isclose(cloud.points.sum(axis=1), 1, atol=1e-6).mean()
    assert slanted == pytest.approx(np.sqrt(3) / (3 + np.sqrt(3)), abs=0.01)


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    a = np.arange(side**2).reshape(side, side)[:-1, :-1].ravel()
    faces = np.vstack([np.stack([a, a + 1, a + side], 1), np.stack([a + 1, a + side + 1, a + side], 1)])
    return np.stack([x.ravel(), y.ravel(), np.sin(x.ravel() / 9)], axis=1), faces


def test_the_vertices_of_a_meshed_scan_are_the_cloud(tmp_path):
    vertices, faces = grid(80)
    cloud = read_cloud(written(tmp_path, "a.ply", good.mesh("ply", vertices, faces)))
    assert (len(cloud), cloud.triangles) == (6400, 0)
    far = np.array([[0, 0, -9], [900.0, 0, -9], [0, 900, -9]])  # one large triangle: a model on a table
    vertices, faces = np.vstack([vertices, far]), np.vstack([faces, 6400 + np.arange(3)])
    cloud = read_cloud(written(tmp_path, "b.ply", good.mesh("ply", vertices, faces)))
    assert (len(cloud), cloud.triangles) == (DRAWN, len(faces))


def test_ply_is_written_as_it_is_read(tmp_path):
    path = tmp_path / "a.ply"
    write_cloud(path, good.POINTS, colours=good.COLOURS, intensity=good.INTENSITY)
    cloud = read_cloud(path)
    np.testing.assert_array_equal(cloud.points, good.POINTS)
    np.testing.assert_array_equal(cloud.colours, good.COLOURS)
    np.testing.assert_array_equal(cloud.intensity, good.INTENSITY)
    assert cloud.ignored == ()
    assert b"property float x" in path.read_bytes()
    write_cloud(path, good.UTM, colours=good.COLOURS / 255)
    np.testing.assert_array_equal(read_cloud(path).points, good.UTM)
    np.testing.assert_array_equal(read_cloud(path).colours, good.COLOURS)
    import trimesh

    np.testing.assert_array_equal(trimesh.load(path).vertices, good.UTM)


@pytest.mark.parametrize(
    ("name", "points", "more", "message"),
    [
        ("a.pcd", good.POINTS, {}, "give a name that ends in .ply"),
        ("a.ply", good.POINTS[:, :2], {}, "points has shape"),
        ("a.ply", good.POINTS, {"colours": good.COLOURS[1:]}, "colours has shape"),
        ("a.ply", good.POINTS, {"intensity": good.COLOURS}, "intensity has shape"),
        ("a.ply", [["a", "b", "c"]], {}, "expected real numbers"),
    ],
)
def test_what_cannot_be_written_changes_nothing(tmp_path, name, points, more, message):
    path = written(tmp_path, name, b"before")
    with pytest.raises(ValueError, match=message):
        write_cloud(path, points, **more)
    assert path.read_bytes() == b"before"
    assert list(tmp_path.iterdir()) == [path]


def test_who_set_up_logging_receives_what_libraries_say(tmp_path):
    """Handlers that keep the terminal quiet do not stay."""
    before = list(logging.getLogger("trimesh").handlers)
    read_cloud(written(tmp_path, "a.obj", good.mesh("obj")))
    assert logging.getLogger("trimesh").handlers == before


@pytest.mark.parametrize(
    ("name", "content", "module", "extra"),
    [
        ("a.laz", lambda: good.las(".laz"), "lazrs", "clouds"),
        ("a.las", lambda: good.las(), "laspy", "clouds"),
        ("a.pcd", lambda: good.pcd("binary_compressed"), "lzf", "clouds"),
        ("a.stl", lambda: good.mesh("stl"), "trimesh", "clouds"),
        ("a.e57", lambda: b"ASTM-E57" + bytes(100), "pye57", "files"),
    ],
)
def test_a_missing_library_is_named_with_what_installs_it(
    tmp_path, monkeypatch, name, content, module, extra
):
    path = written(tmp_path, name, content())
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=rf"pip install 'teaser-jax\[{extra}\]'"):
        read_cloud(path)


@pytest.mark.long
def test_libraries_load_when_a_file_of_their_kind_is_read():
    code = (
        "import sys, teaser_jax.files; "
        "print(*{'trimesh', 'laspy', 'lazrs', 'pye57', 'lzf', 'scipy.io'} & set(sys.modules))"
    )
    told = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout
    assert told.split() == []


def test_a_folder_and_nothing_at_all(tmp_path):
    for path, message in ((tmp_path, "is a folder"), (tmp_path / "a.ply", "no such file")):
        with pytest.raises(FileError, match=message):
            read_cloud(path)


def test_real_files(data_dir):
    bunny = read_cloud(data_dir / "models" / "bunny.ply")
    assert bunny.triangles > 0
    scan = read_cloud(data_dir / "scans" / "source.ply")
    assert (len(scan), scan.triangles) == (69_792, 0)
    assert tj.files.read_cloud is read_cloud
