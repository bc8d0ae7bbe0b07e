"""Files of matches, whole and broken."""

from __future__ import annotations

import io

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

import teaser_jax as tj
from teaser_jax.files import FileError, read_matches, write_pose
from teaser_jax.files.matches import TEXT
from teaser_jax.ground.io import one_line

RNG = np.random.default_rng(0)
SRC, DST = RNG.normal(size=(2, 5, 3))
TABLE = np.hstack([SRC, DST])
POSE = tj.Pose(tj.synthetic.draw_rotation(RNG), RNG.normal(size=3), np.asarray(1.7))


def archive(**arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def text(delimiter: str, header: str = "", comments: str = "") -> str:
    buffer = io.StringIO()
    np.savetxt(buffer, TABLE, delimiter=delimiter, header=header, comments=comments)
    return buffer.getvalue()


WHOLE = archive(src=SRC, dst=DST)


def reason(path) -> str:
    """Why the file cannot be read: one line that names it."""
    with pytest.raises(FileError) as caught:
        read_matches(path)
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert len(message.splitlines()) == 1
    return message


def complaint(path) -> str:
    """Why the file cannot be read, or nothing; any other exception is a crash."""
    try:
        read_matches(path)
    except FileError as error:
        return str(error)
    return ""


def test_archives_hold_points_and_what_is_known(tmp_path):
    path = tmp_path / "m.npz"
    known = {"noise_bound": np.full(5, 0.1), "confidence": np.arange(5.0), "mask": np.ones(5, bool)}
    known |= {"scale": 2.0, "cbar2": 0.5}
    np.savez(path, src=SRC, dst=DST, T_dst_src=POSE.matrix, something_else=1, **known)
    matches = read_matches(str(path))
    np.testing.assert_array_equal(matches.src, SRC)
    np.testing.assert_array_equal(matches.dst, DST)
    assert matches.known.keys() == known.keys()
    np.testing.assert_allclose(matches.truth.matrix, POSE.matrix)


@pytest.mark.parametrize("suffix", TEXT)
@pytest.mark.parametrize("delimiter", [" ", ",", ";", "\t", "|", ", ", "  "])
@pytest.mark.parametrize(("header", "comments"), [("", ""), ("x y z u v w", "# "), ("ax,ay,az,bx,by,bz", "")])
def test_text_in_any_dress(tmp_path, suffix, delimiter, header, comments):
    path = tmp_path / f"m{suffix.upper()}"
    if comments == "":
        header = header.replace(",", delimiter)
    path.write_text("\ufeff" + text(delimiter, header, comments) + "\n\n# end\n", encoding="utf-8")
    matches = read_matches(path)
    np.testing.assert_array_equal(matches.src, SRC)
    np.testing.assert_array_equal(matches.dst, DST)
    assert matches.truth is None


def test_quotes_and_missing_numbers(tmp_path):
    path = tmp_path / "m.csv"
    path.write_text('"a","b","c","d","e","f"\n"1","2","3","4","5","6"\nnan,2,3,4,5,inf\n')
    np.testing.assert_array_equal(read_matches(path).src, [[1, 2, 3], [np.nan, 2, 3]])


@pytest.mark.parametrize("header", ["0,1,2,3,4,5", '"0","1","2","3","4","5"'])
def test_the_default_header_of_pandas_is_no_match(tmp_path, header):
    path = tmp_path / "m.csv"
    path.write_text(f"{header}\n0,1,2,3,4,5\n6,7,8,9,10,11\n")
    np.testing.assert_array_equal(read_matches(path).src, [[0, 1, 2], [6, 7, 8]])
    path.write_text("0.0,1,2,3,4,5\n")
    assert len(read_matches(path).src) == 1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("m.npz", b"", "is no .npz archive, or is broken"),
        ("m.npz", b"1 2 3 4 5 6\n", "is no .npz archive, or is broken (it does not begin as a zip file"),
        ("m.npz", b"PK\x03\x04 and then nothing", "is no .npz archive, or is broken"),
        ("m.npz", WHOLE[:200], "is no .npz archive, or is broken"),
        ("m.npz", WHOLE[:-30], "is no .npz archive, or is broken"),
        ("m.npz", archive(a=SRC, b=DST), "no array 'src' (found: a, b)"),
        ("m.npz", archive(src=SRC), "no array 'dst'"),
        ("m.npz", archive(src=np.array([{}, None]), dst=DST), "Object arrays cannot be loaded"),
        ("m.npz", archive(src=SRC, dst=DST, T_dst_src=np.eye(3)), "T_dst_src is no pose"),
        ("m.npz", archive(src=SRC, dst=DST, T_dst_src=np.full((4, 4), np.nan)), "T_dst_src is no pose"),
        ("m.npz", archive(src=SRC, dst=DST, T_dst_src="far"), "T_dst_src is no pose"),
        ("m.txt", b"", "holds no match"),
        ("m.txt", b"# only\n\n# comments\n", "holds no match"),
        ("m.txt", b"x y z u v w\n", "holds no match"),
        ("m.txt", b"\xff\xfe\x00binary\x9f", "is not text"),
        ("m.txt", b"1 2 3\n4 5 6\n", "line 1 has 3 columns: expected six"),
        ("m.csv", b"1,2,3,4,5,6,7\n", "line 1 has 7 columns: expected six"),
        ("m.csv", b"1,2,,4,5,6\n", "line 1 has nothing in column 3"),
        ("m.csv", b"x,y,z,u,v,w\n# why\n\n1,2,3,4,5,6\n1,2,3\n", "line 5 has 3 columns: expected six"),
        ("m.csv", b"1,2,3,4,5,6\n1,2,3,4,5,six\n", "line 2 holds 'six' in column 6: expected six numbers"),
        ("m.csv", b"a,2,3,4,5,6\n1,2,3,4,5,6\n", "line 1 holds 'a'"),
        ("m.ply", b"ply\n", "is a cloud: name a second one after it"),
        ("m.odd", b"1\n", "unknown extension '.odd'"),
        ("matches", b"1 2 3 4 5 6\n", "unknown extension ''"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_in_one_line(tmp_path, name, content, message):
    path = tmp_path / name
    path.write_bytes(content)
    assert message in reason(path)


def test_one_array_is_no_archive(tmp_path):
    path = tmp_path / "m.npz"
    with path.open("wb") as file:
        np.save(file, SRC)
    assert "one array without a name" in reason(path)


def test_no_file_and_no_file_but_a_folder(tmp_path):
    assert "no such file" in reason(tmp_path / "m.npz")
    (tmp_path / "f.npz").mkdir()
    assert "is a folder" in reason(tmp_path / "f.npz")
    assert "is a folder" in reason(tmp_path)
    assert "cannot be read" in reason(tmp_path / ("x" * 300 + ".npz"))


@pytest.mark.long
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    content=st.binary(max_size=300) | st.text(max_size=200).map(str.encode),
    suffix=st.sampled_from(["npz", "csv", "txt"]),
)
@example(content=b'"', suffix="csv")  # blank, but for a quote
def test_noise_is_refused_or_read_but_never_crashes(tmp_path, content, suffix):
    path = tmp_path / f"m.{suffix}"
    path.write_bytes(content)
    assert len(complaint(path).splitlines()) <= 1


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damaged_archives_are_refused_or_read_but_never_crash(tmp_path, data):
    content = bytearray(WHOLE)
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(content)))
    path = tmp_path / "m.npz"
    path.write_bytes(bytes(content[:cut]))
    assert len(complaint(path).splitlines()) <= 1


def test_poses_are_written_exactly_and_whole(tmp_path):
    path = tmp_path / "T.txt"
    path.write_text("an older one")
    write_pose(path, POSE)
    np.testing.assert_array_equal(np.loadtxt(path), POSE.matrix)
    assert [p.name for p in tmp_path.iterdir()] == ["T.txt"]
    with pytest.raises(OSError, match="nowhere"):
        write_pose(tmp_path / "nowhere" / "T.txt", POSE)


def test_one_line_of_bearable_length():
    assert one_line("a\nb\t c\x00d\u2028e") == "a b c d e"
    assert len(one_line("x" * 1000)) == 300


def test_only_what_is_needed_is_read_and_the_rest_is_named(tmp_path):
    path = tmp_path / "m.npz"
    others = dict(weights=np.ones(4), noise_bounds=0.1, odd=np.array([{}, None], dtype=object))
    np.savez(path, src=SRC, dst=DST, **others)
    found = read_matches(path)
    np.testing.assert_array_equal(found.src, SRC)
    assert found.known == {}
    assert found.ignored == (
        "array 'weights' is ignored: call it 'confidence' to have it read",
        "array 'noise_bounds' is ignored: call it 'noise_bound' to have it read",
        "array 'odd' is ignored",
    )


def test_an_array_of_six_columns_holds_matches(tmp_path):
    path = tmp_path / "m.npy"
    np.save(path, np.concatenate([SRC, DST], axis=1))
    np.testing.assert_array_equal(read_matches(path).dst, DST)
    np.save(path, SRC)
    assert "expected matches, (n, 6)" in reason(path)
    path.write_bytes(b"x")
    assert "is no .npy array, or is broken" in reason(path)


def test_poses_of_three_rows_and_decimal_commas_are_understood(tmp_path):
    path = tmp_path / "m.npz"
    np.savez(path, src=SRC, dst=DST, T_dst_src=np.eye(4)[:3])
    np.testing.assert_array_equal(read_matches(path).truth.matrix, np.eye(4))
    for separator, name in ((";", "m.csv"), (" ", "m.txt"), ("\t", "m.tsv")):
        path = tmp_path / name
        rows = (separator.join(f"{x:.3f}".replace(".", ",") for x in row) for row in np.c_[SRC, DST])
        path.write_text("\n".join(rows))
        np.testing.assert_allclose(read_matches(path).src, SRC, atol=1e-3)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1,2,,4,5,6", "line 1 has nothing in column 3: leave the row out, or write nan there"),
        ("?,?,?,?,?,?", "line 1 holds '?' in column 1"),
        ("1 2 3 4 5 6\n1 2 3 4 5 6\x00", r"line 2 holds '6\x00' in column 6"),
        ("1;2;3;4;5;6\n1;2;3;4;5;6\u200b", r"line 2 holds '6\u200b' in column 6"),
    ],
)
def test_the_error_names_the_line_and_shows_what_stands_there(tmp_path, text, said):
    path = tmp_path / "m.csv"
    path.write_text(text)
    assert said in reason(path)


def test_shards_and_files_of_matlab_are_sent_where_they_belong(tmp_path):
    path = tmp_path / "shard.npz"
    np.savez(path, src=SRC[None], dst=DST[None], rotation=np.eye(3)[None], translation=0, inliers=0)
    assert "is a shard of a study, 1 problem(s): read them with teaser_jax" in reason(path)
    (tmp_path / "m.mat").write_bytes(b"MATLAB")
    assert "numpy.savez('m.npz', **scipy.io.loadmat('m.mat'))" in reason(tmp_path / "m.mat")
