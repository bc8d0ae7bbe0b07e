"""A pose is what people hold: a record, a matrix of numpy or JAX, or an answer that has one."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random_pose

import teaser_jax as tj
from teaser_jax.files import write_pose
from teaser_jax.pose import Pose, as_pose
from teaser_jax.uncertainty import pose_difference


@pytest.fixture
def two() -> tuple[Pose, Pose]:
    rng = np.random.default_rng(0)
    return random_pose(rng, 1.3), random_pose(rng, 0.8)


@pytest.mark.long
def test_a_matrix_stands_for_a_pose(two, solved, tmp_path):
    a, b = two
    forms = (np.asarray, lambda p: p.matrix, lambda p: p.matrix[:3], lambda p: p.matrix.tolist())
    for form in forms:
        for found in (form(a) @ b, a @ form(b)):
            assert isinstance(found, Pose)
            np.testing.assert_allclose(found.matrix, a.matrix @ b.matrix, atol=1e-12)
        assert tj.metrics.errors(form(a), b) == pytest.approx(tj.metrics.errors(a, b))
        np.testing.assert_allclose(pose_difference(form(a), b), pose_difference(a, b), atol=1e-5)
        write_pose(tmp_path / "pose.txt", form(a))
        np.testing.assert_allclose(np.loadtxt(tmp_path / "pose.txt"), a.matrix, atol=1e-12)
    on_device = jnp.asarray(b.matrix, jnp.float32)
    assert isinstance(on_device @ b, Pose)
    assert isinstance(b @ on_device, Pose)
    assert tj.metrics.rotation_error(solved, solved.pose) == pytest.approx(0, abs=1e-9)
    assert tj.metrics.rotation_error(solved.solution, solved) == pytest.approx(0, abs=1e-9)
    write_pose(tmp_path / "pose.txt", solved)


def test_numpy_reads_the_matrix(two):
    np.testing.assert_array_equal(np.asarray(two[0]), two[0].matrix)
    assert np.asarray(two[0], np.float32).dtype == np.float32
    inverse = np.linalg.inv(np.asarray(two[0]))
    np.testing.assert_allclose(inverse, two[0].inverse().matrix, atol=1e-12)


def test_points_may_be_a_list_or_whole_numbers(two):
    for points in ([[1, 2, 3]], [[1.0, 2.0, 3.0]], np.array([[1, 2, 3]])):
        np.testing.assert_allclose(two[0].apply(points), two[0].apply(np.array([[1.0, 2, 3]])))
    for points in ("x", [["a", "b", "c"]], [[1j, 0, 0]], np.zeros((2, 3), object)):
        with pytest.raises(ValueError, match="points (cannot be read|have)"):
            two[0].apply(points)


@pytest.mark.parametrize("scale", [1e-300, 1e-150, 1e150, 1e300])
def test_a_scale_of_any_size_comes_back_from_its_matrix(two, scale):
    pose = Pose(two[0].rotation, two[0].translation, np.asarray(scale))
    found = Pose.from_matrix(pose.matrix)
    np.testing.assert_allclose(found.scale, scale)
    np.testing.assert_allclose(found.rotation, pose.rotation, atol=1e-12)


@pytest.mark.parametrize(
    ("value", "said"),
    [
        ("x", "received str for a pose"), (None, "received NoneType for a pose"),
        (np.eye(3), r"received \(3, 3\)"), (np.diag([1.0, 1, -1, 1]), "mirrored"),
        (np.eye(4, dtype=complex), "real numbers"), (np.ones((2, 2)), "shape"),
        ([1, [2, 3]], "received list"),
    ],
    ids=str,
)  # fmt: skip
def test_what_is_no_pose_is_named(two, value, said, tmp_path):
    for ask in (as_pose, lambda x: two[0] @ x, lambda x: tj.metrics.errors(x, two[0])):
        with pytest.raises(ValueError, match=said):
            ask(value)
    with pytest.raises(ValueError, match=said):
        write_pose(tmp_path / "pose.txt", value)
    assert not (tmp_path / "pose.txt").exists()


def test_whole_numbers_make_a_pose():
    assert Pose.from_matrix(np.eye(4, dtype=int)).translation.dtype == np.float64


def test_plain_numbers_make_a_pose():
    pose = tj.Pose(np.eye(3).tolist(), (1, 2, 3), 2)
    np.testing.assert_array_equal(pose.apply([[1, 1, 1]]), [[3, 4, 5]])
    np.testing.assert_array_equal((pose @ pose.inverse()).matrix, np.eye(4))
