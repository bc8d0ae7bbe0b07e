"""What studies read and write beside their tables: problems in shards, and models to draw from."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.files import FileError
from teaser_jax.studies import draw_trials, read_model, read_trials, save_trials, studies


def test_problems_come_back_from_shards_bit_for_bit(tmp_path):
    drawn = [
        *draw_trials(studies()["unknown-scale"], runs=3, quick=True),
        *draw_trials(studies()["scale"], runs=2, quick=True),
    ]
    files = save_trials(tmp_path, drawn, shard_bytes=15_000)
    assert len(files) > 3
    back = list(read_trials(tmp_path))
    assert len(back) == len(drawn)
    for a, b in zip(drawn, back, strict=True):
        assert (a.value, a.number, a.scale) == (b.value, b.number, b.scale)
        for name in ("src", "dst", "inliers", "noise_bound"):
            np.testing.assert_array_equal(getattr(a.problem, name), getattr(b.problem, name))
        np.testing.assert_array_equal(a.problem.truth.matrix, b.problem.truth.matrix)
    # A smaller set under the same name leaves nothing of the larger one behind.
    assert save_trials(tmp_path, drawn[:1]) == files[:1]
    assert len(list(read_trials(tmp_path))) == 1


def test_shards_that_are_none(tmp_path):
    with pytest.raises(FileError, match="holds no shard"):
        list(read_trials(tmp_path))
    with pytest.raises(FileError, match="no such file"):
        list(read_trials(tmp_path / "x.npz"))
    (tmp_path / "x.npz").write_bytes(b"PK\x03\x04 no archive")
    with pytest.raises(FileError, match="is no .npz archive"):
        list(read_trials(tmp_path / "x.npz"))
    np.savez(tmp_path / "x.npz", src=np.zeros((2, 3)))
    with pytest.raises(FileError, match="it lacks dst, inliers"):
        list(read_trials(tmp_path / "x.npz"))


def test_models_from_files(tmp_path):
    import trimesh

    box = trimesh.creation.box()
    box.export(tmp_path / "box.ply")
    mesh = read_model(tmp_path / "box.ply")
    assert mesh.name == "box"
    assert isinstance(mesh.shape, tj.synthetic.Triangles)
    assert len(mesh.shape.faces) == 12
    trimesh.PointCloud(box.sample(300)).export(tmp_path / "points.ply")
    assert read_model(tmp_path / "points.ply").shape.shape == (300, 3)
    np.save(tmp_path / "points.npy", box.sample(150))
    problem = studies()["known-scale"].trial(0, 0.5, 0, read_model(tmp_path / "points.npy")).problem
    assert problem.src.shape == (100, 3)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (None, "no such file"),
        (b"nothing", "cannot be read as a model"),
        (np.zeros((5, 2)), "expected .m, 3. points"),
        (np.full((5, 3), np.nan), "not finite"),
    ],
)
def test_models_that_are_none(tmp_path, content, said):
    path = tmp_path / "m.npy"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        np.save(path, content)
    with pytest.raises(FileError, match=said):
        read_model(path)
