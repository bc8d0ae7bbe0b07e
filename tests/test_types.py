"""The records: laws of poses, texts of statuses, and that all of them travel as pytrees."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import problem_of, random_matches, random_pose, solve

import teaser_jax as tj
from teaser_jax.settings import Gnc


def poses(seed: int, batch: tuple[int, ...] = ()) -> tj.Pose:
    """A numpy pose with the given leading axes."""
    rng = np.random.default_rng(seed)
    many = [random_pose(rng, scale=rng.uniform(0.5, 2)) for _ in range(int(np.prod(batch, dtype=int)))]
    return jax.tree.map(lambda *x: np.stack(x).reshape((*batch, *x[0].shape)), *many)


def as_kind(pose: tj.Pose, kind: str) -> tj.Pose:
    return pose if kind == "numpy" else jax.tree.map(jnp.asarray, pose)


BATCHES = [(), (3,), (2, 3)]
both_kinds = pytest.mark.parametrize("kind", ["numpy", "jax"])
batches = pytest.mark.parametrize("batch", BATCHES, ids=str)


@pytest.mark.long
@both_kinds
@batches
def test_composition_applies_the_right_pose_first(kind, batch, x64):
    outer, inner = as_kind(poses(0, batch), kind), as_kind(poses(1, batch), kind)
    points = np.random.default_rng(2).normal(size=(*batch, 7, 3))
    np.testing.assert_allclose((outer @ inner).apply(points), outer.apply(inner.apply(points)), atol=1e-13)
    np.testing.assert_allclose(
        (outer @ inner).matrix, np.asarray(outer.matrix) @ np.asarray(inner.matrix), atol=1e-13
    )


@both_kinds
@batches
def test_inverse_undoes(kind, batch, x64):
    pose = as_kind(poses(3, batch), kind)
    identity = np.broadcast_to(np.eye(4), (*batch, 4, 4))
    np.testing.assert_allclose((pose @ pose.inverse()).matrix, identity, atol=1e-13)
    np.testing.assert_allclose((pose.inverse() @ pose).matrix, identity, atol=1e-13)
    np.testing.assert_allclose(pose.inverse().matrix, np.linalg.inv(pose.matrix), atol=1e-13)


@both_kinds
@batches
def test_matrix_acts_on_columns_as_apply_on_rows(kind, batch, x64):
    pose = as_kind(poses(4, batch), kind)
    points = np.random.default_rng(5).normal(size=(*batch, 7, 3))
    ahead = np.concatenate([points, np.ones((*batch, 7, 1))], axis=-1) @ np.swapaxes(pose.matrix, -1, -2)
    np.testing.assert_allclose(pose.apply(points), ahead[..., :3], atol=1e-13)
    np.testing.assert_array_equal(
        np.asarray(pose.matrix)[..., 3, :], np.broadcast_to([0, 0, 0, 1], (*batch, 4))
    )


@both_kinds
@batches
def test_from_matrix_is_the_inverse_of_matrix(kind, batch, x64):
    pose = as_kind(poses(6, batch), kind)
    again = tj.Pose.from_matrix(pose.matrix)
    for name in ("rotation", "translation", "scale"):
        np.testing.assert_allclose(getattr(again, name), getattr(pose, name), atol=1e-14)
        assert type(getattr(again, name)) is type(getattr(pose, name)) or kind == "numpy"


def test_numpy_poses_stay_float64_without_x64():
    assert not jax.config.jax_enable_x64
    pose = poses(7)
    results = [pose.matrix, pose.quat, pose.apply(np.ones((2, 3))), (pose @ pose.inverse()).matrix]
    results += [tj.Pose.from_matrix(pose.matrix).rotation]
    for result in results:
        assert isinstance(result, np.ndarray)
        assert result.dtype == np.float64
    np.testing.assert_allclose((pose @ pose.inverse()).matrix, np.eye(4), atol=1e-15)


@pytest.mark.long
def test_jax_poses_stay_on_the_device():
    pose = as_kind(poses(8), "jax")
    for result in (pose.matrix, pose.quat, pose.apply(np.ones((2, 3))), pose.inverse().translation):
        assert isinstance(result, jax.Array)


def test_pose_works_under_jit_and_vmap(x64):
    batch = as_kind(poses(9, (4,)), "jax")
    points = np.random.default_rng(10).normal(size=(4, 5, 3))
    there_and_back = jax.jit(jax.vmap(lambda pose, x: (pose.inverse() @ pose).apply(x)))(batch, points)
    np.testing.assert_allclose(there_and_back, points, atol=1e-13)
    rebuilt = jax.jit(lambda pose: tj.Pose.from_matrix(pose.matrix))(batch)
    np.testing.assert_allclose(rebuilt.scale, batch.scale, atol=1e-14)


def test_quat_and_scipy_agree():
    pose = poses(11, (5,))
    quat = pose.as_scipy().as_quat(canonical=True)
    np.testing.assert_allclose(pose.quat, quat, atol=1e-14)
    turned = pose.as_scipy().apply(np.ones((5, 3)))
    np.testing.assert_allclose(turned, np.einsum("kij,j->ki", pose.rotation, np.ones(3)), atol=1e-14)


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1, -1, 1]),
        np.diag([1.0, 2, 1, 1]),
        np.zeros((4, 4)),
        np.full((4, 4), np.nan),
        np.ones((4, 4)),
    ],
    ids=["mirrored", "stretched", "zero", "nan", "ones"],
)
def test_from_matrix_refuses_what_is_no_similarity(matrix):
    with pytest.raises(ValueError, match=r"rotation.*transposed, sheared or mirrored"):
        tj.Pose.from_matrix(matrix)


def test_from_matrix_refuses_a_transposed_matrix():
    matrix = poses(12).matrix
    with pytest.raises(ValueError, match="transposed"):
        tj.Pose.from_matrix(matrix.T)


def test_from_matrix_checks_each_of_a_batch():
    # A large pose must not hide a small one that is no rotation.
    small_shear = np.eye(4)
    small_shear[:3, :3] = 1e-3 * np.diag([1, 2, 0.5])
    with pytest.raises(ValueError, match="rotation"):
        tj.Pose.from_matrix(np.stack([np.diag([100.0, 100, 100, 1]), small_shear]))


@pytest.mark.parametrize("shape", [(3, 3), (4,), (3, 4), (2, 4, 3)], ids=str)
def test_from_matrix_says_the_shape_it_wants(shape):
    with pytest.raises(ValueError, match=r"shape \(4, 4\), received"):
        tj.Pose.from_matrix(np.zeros(shape))


@pytest.mark.parametrize("status", list(tj.Status))
def test_each_status_has_a_sentence_of_its_own(status):
    assert status.advice.endswith(".")
    assert len(status.advice) > 40
    assert [s.advice for s in tj.Status].count(status.advice) == 1


def test_only_zero_is_ok():
    assert [s for s in tj.Status if s == 0] == [tj.Status.OK]
    assert all(isinstance(np.int32(s), np.int32) for s in tj.Status)


def test_settings_keep_choices_static_and_numbers_traced():
    leaves, structure = jax.tree.flatten(tj.Settings())
    assert sorted(leaves) == sorted([1.4, 1e-6, 0.0, float("inf"), 100_000_000, 60.0])
    other = jax.tree.structure(dataclasses.replace(tj.Settings(), clique="greedy"))
    assert other != structure
    assert jax.tree.structure(tj.Settings(rotation=Gnc(factor=2))) == structure


def test_unknown_scale_is_structure():
    matches = random_matches(0)
    known, unknown = problem_of(matches), problem_of(matches, scale=None)
    assert jax.tree.structure(known) != jax.tree.structure(unknown)
    assert jax.tree.structure(known) == jax.tree.structure(problem_of(matches, scale=2.0))


def test_records_are_pytrees(x64):
    problem = problem_of(random_matches(0))
    solution = solve(problem)
    for record in (problem, solution, solution.pose, solution.selection, tj.Settings()):
        leaves, structure = jax.tree.flatten(record)
        again = jax.tree.unflatten(structure, leaves)
        assert type(again) is type(record)
        assert all(a is b for a, b in zip(leaves, jax.tree.leaves(again), strict=True))
        jax.tree.unflatten(structure, [object()] * len(leaves))  # JAX does this: it must not validate
        through = jax.jit(lambda x: x)(record)
        assert jax.tree.structure(through) == structure
        jax.tree.map(np.testing.assert_array_equal, through, record)


def test_records_are_immutable():
    with pytest.raises(dataclasses.FrozenInstanceError):
        poses(0).scale = 2.0
    with pytest.raises(dataclasses.FrozenInstanceError):
        tj.Settings().refine = False


def test_ok_is_the_status_and_nothing_else(x64):
    solution = solve(problem_of(random_matches(0)))
    assert bool(dataclasses.replace(solution, status=jnp.int32(tj.Status.OK)).ok)
    proved = dataclasses.replace(solution, clique_is_maximum=jnp.bool_(True))
    assert not bool(dataclasses.replace(proved, status=jnp.int32(tj.Status.DEGENERATE)).ok)
