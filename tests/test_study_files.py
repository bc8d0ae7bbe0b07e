"""What studies read and write beside their tables: problems in shards, and models to draw from."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.files import FileError
from teaser_jax.studies import (
    TEAPOT,
    Model,
    Trial,
    draw_trials,
    read_model,
    read_trials,
    save_trials,
    studies,
)


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
        assert (a.value, a.number, a.scale, a.origin) == (b.value, b.number, b.scale, b.origin)
        for name in ("src", "dst", "inliers", "noise_bound"):
            np.testing.assert_array_equal(getattr(a.problem, name), getattr(b.problem, name))
        np.testing.assert_array_equal(a.problem.truth.matrix, b.problem.truth.matrix)
    # A smaller set under the same name leaves nothing of the larger one behind.
    assert save_trials(tmp_path, drawn[:1]) == files[:1]
    assert len(list(read_trials(tmp_path))) == 1


CLOUD = Model("cloud", np.random.default_rng(0).random((60, 3)))


def drawn(study="scale", **known):
    return draw_trials(studies()[study], runs=1, quick=True, **known)


@pytest.mark.parametrize(("seed", "model"), [(0, TEAPOT), (7, CLOUD), (2**80, TEAPOT)])
def test_shards_carry_what_draws_them_again(tmp_path, seed, model):
    (path,) = save_trials(tmp_path, drawn(seed=seed, model=model))
    shard = np.load(path)
    assert int(shard["seed"]) == seed
    assert str(shard["model"]) == model.name
    study = studies()[str(shard["study"])]
    for k, src in enumerate(shard["src"]):
        again = study.trial(int(shard["seed"]), shard["value"][k], int(shard["trial"][k]), model)
        np.testing.assert_array_equal(again.problem.src, src)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"seed": 1}, "of seed 0, and 1 is asked for: name another folder, or remove them"),
        ({"model": CLOUD}, "of model 'teapot', and 'cloud' is asked for"),
        ({"model": Model("teapot", CLOUD.shape)}, "of model crc32 '', and '.{8}' is asked for"),
        ({"study": "translation"}, "of study 'scale', and 'translation' is asked for"),
    ],
)
def test_problems_of_another_origin_overwrite_no_shard(tmp_path, other, said):
    (path,) = save_trials(tmp_path, drawn())
    before = path.read_bytes()
    with pytest.raises(FileError, match=said):
        save_trials(tmp_path, drawn(**other))
    assert path.read_bytes() == before
    assert save_trials(tmp_path / "another", drawn(**other))  # as the error says
    path.unlink()
    assert save_trials(tmp_path, drawn(**other)) == [path]


def test_shards_of_older_versions_are_read_and_not_overwritten(tmp_path):
    older = [Trial(t.value, t.number, t.problem, t.scale) for t in drawn()]
    (path,) = save_trials(tmp_path, older)
    assert "seed" not in np.load(path).files
    assert [t.origin for t in read_trials(path)] == [None] * 4
    with pytest.raises(FileError, match="do not say of which seed and model: name another folder"):
        save_trials(tmp_path, drawn())


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
