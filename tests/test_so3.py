"""Rotations: the projection against LAPACK, its derivative against differences, and round trips."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random_rotation
from scipy.spatial.transform import Rotation

from teaser_jax import so3

nearest = jax.jit(jax.vmap(so3.nearest_rotation))
frames = jax.jit(jax.vmap(so3.singular_frames))
derivative = jax.jit(jax.vmap(lambda h, d: jax.jvp(so3.nearest_rotation, (h,), (d,))[1]))
jacobian = jax.jit(jax.vmap(jax.jacrev(so3.nearest_rotation)))

TOLERANCE = {"float64": 1e-13, "float32": 2e-5}


def with_spectrum(rng, n: int, values) -> np.ndarray:
    """n matrices with the given singular values between random *proper* rotations."""
    left, right = (np.stack([random_rotation(rng) for _ in range(n)]) for _ in range(2))
    return left * np.asarray(values) @ right


def kinds_of_matrices() -> dict[str, np.ndarray]:
    """500 of each kind: one shape, one compilation."""
    rng = np.random.default_rng(0)
    corners = [np.diag(d) for d in ([1.0, 2, 3], [0, 0, 1], [-1, -1, 1], [0, -1, 0])]
    return {
        "random": rng.normal(size=(500, 3, 3)),
        "huge": 1e12 * rng.normal(size=(500, 3, 3)),
        "small": 1e-12 * rng.normal(size=(500, 3, 3)),
        "few equal entries": rng.integers(-1, 2, (500, 3, 3)).astype(float),
        "thin": with_spectrum(rng, 500, [1, 1e-3, 1e-6]),
        "rank two": with_spectrum(rng, 500, [1, 0.5, 0]),
        "rank one": with_spectrum(rng, 500, [1, 0, 0]),
        "equal": with_spectrum(rng, 500, [1, 1, 1]),
        "two equal": with_spectrum(rng, 500, [2, 1, 1]),
        "reflected": with_spectrum(rng, 500, [3, 2, -1]),
        "evenly reflected": with_spectrum(rng, 500, [1, 1, -1]),
        "zero": np.zeros((500, 3, 3)),
        "diagonal": np.tile(np.stack(corners), (125, 1, 1)),
    }


KINDS = kinds_of_matrices()


def best_trace(matrix: np.ndarray) -> np.ndarray:
    """The maximum of tr(R^T H) over rotations: s_1 + s_2 + sign(det) s_3."""
    left, values, right = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(left) * np.linalg.det(right))
    return values[:, 0] + values[:, 1] + sign * values[:, 2]


def check_nearest(matrix: np.ndarray, dtype: str) -> None:
    matrix = matrix.astype(dtype)
    found = np.asarray(nearest(matrix))
    assert found.dtype == dtype
    found, matrix = found.astype(float), matrix.astype(float)
    tolerance = TOLERANCE[dtype]
    np.testing.assert_allclose(
        found @ found.swapaxes(1, 2), np.tile(np.eye(3), (len(matrix), 1, 1)), atol=tolerance
    )
    np.testing.assert_allclose(np.linalg.det(found), 1, atol=tolerance)
    size = np.maximum(np.abs(matrix).max(axis=(1, 2)), np.finfo(dtype).tiny)
    reached = np.sum(found * matrix, axis=(1, 2))
    np.testing.assert_allclose(reached / size, best_trace(matrix) / size, atol=10 * tolerance)


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_rotation_is_a_rotation_of_largest_trace(kind, x64):
    check_nearest(KINDS[kind], "float64")


@pytest.mark.parametrize("kind", KINDS)
def test_nearest_rotation_in_float32(kind):
    check_nearest(KINDS[kind], "float32")


def test_nearest_rotation_recovers_a_rotation(x64):
    rng = np.random.default_rng(1)
    rotations = np.stack([random_rotation(rng) for _ in range(500)])
    np.testing.assert_allclose(nearest(rotations), rotations, atol=1e-14)
    np.testing.assert_allclose(nearest(1e-3 * rotations), rotations, atol=1e-14)


def test_thin_geometry_survives_float32():
    # Quaternion eigenvectors are off by 90 degrees here.
    rng = np.random.default_rng(2)
    left, right = random_rotation(rng), random_rotation(rng)
    thin = (left * np.array([1, 1e-3, 1e-5])) @ right
    found = np.asarray(nearest(thin[None].astype(np.float32)))[0]
    angle = so3.rotation_angle(found.astype(float) @ (left @ right).T)
    assert angle < 1e-2


@pytest.mark.parametrize("kind", KINDS)
def test_singular_frames_rebuild_the_matrix(kind, x64):
    matrix = KINDS[kind]
    left, values, right = (np.asarray(x) for x in frames(matrix))
    size = np.maximum(np.abs(matrix).max(axis=(1, 2)), np.finfo(float).tiny)[:, None, None]
    rebuilt = left * values[:, None, :] @ right.swapaxes(1, 2)
    np.testing.assert_allclose(rebuilt / size, matrix / size, atol=1e-13)
    for frame in (left, right):
        np.testing.assert_allclose(np.linalg.det(frame), 1, atol=1e-13)
        np.testing.assert_allclose(
            frame @ frame.swapaxes(1, 2), np.tile(np.eye(3), (len(matrix), 1, 1)), atol=1e-13
        )
    slack = 1e-13 * size[:, 0, 0]
    assert np.all(values[:, 0] >= values[:, 1] - slack)
    assert np.all(values[:, 1] >= np.abs(values[:, 2]) - slack)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["random", "equal", "two equal", "rank two", "reflected"])
def test_forward_reverse_and_central_differences_agree(kind, x64):
    matrix = KINDS[kind]
    direction = np.random.default_rng(3).normal(size=matrix.shape)
    forward = np.asarray(derivative(matrix, direction))
    reverse = np.einsum("nijkl,nkl->nij", jacobian(matrix), direction)
    ahead, behind = (np.asarray(nearest(matrix + sign * 1e-6 * direction)) for sign in (1, -1))
    values = np.asarray(frames(matrix)[1])
    clear = values[:, 1] + values[:, 2] > 0.2  # the derivative goes like the inverse of this sum
    assert clear.sum() > 300
    np.testing.assert_allclose(reverse[clear], forward[clear], atol=1e-12)
    np.testing.assert_allclose(forward[clear], ((ahead - behind) / 2e-6)[clear], atol=1e-6)


def test_derivative_keeps_the_rotation_a_rotation(x64):
    matrix = KINDS["random"]
    turned = np.einsum("nji,njk->nik", nearest(matrix), derivative(matrix, np.ones_like(matrix)))
    np.testing.assert_allclose(turned, -turned.swapaxes(1, 2), atol=1e-9)


@pytest.mark.parametrize("kind", ["zero", "rank one", "evenly reflected"])
def test_derivative_is_zero_where_the_rotation_is_ambiguous(kind, x64):
    matrix = KINDS[kind]
    assert np.all(np.asarray(derivative(matrix, np.ones_like(matrix))) == 0)
    assert np.all(np.asarray(jacobian(matrix)) == 0)


@pytest.mark.parametrize("kind", KINDS)
def test_derivative_is_finite_everywhere(kind, x64):
    matrix = KINDS[kind]
    assert np.all(np.isfinite(jacobian(matrix)))


def special_rotations() -> np.ndarray:
    """Identity, half turns about axes and between them, tiny and almost half turns, random ones."""
    rng = np.random.default_rng(4)
    axes = np.concatenate(
        [np.eye(3), -np.eye(3), rng.normal(size=(40, 3)), [[1, 1, 0], [1, 1, 1], [0, 1, -1]]]
    )
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    angles = [0, 1e-9, 1e-4, 1, np.pi / 2, np.pi - 1e-4, np.pi - 1e-9, np.pi]
    return np.concatenate([Rotation.from_rotvec(angle * axes).as_matrix() for angle in angles])


@pytest.mark.long
@pytest.mark.parametrize("xp", [np, jnp])
def test_quaternions_are_scipys_and_return(xp, x64):
    rotations = special_rotations()
    quat = np.asarray(so3.quat_from_rotation(xp.asarray(rotations)))
    np.testing.assert_allclose(np.linalg.norm(quat, axis=1), 1, atol=1e-15)
    assert np.all(quat[:, 3] >= 0)
    scipys = Rotation.from_matrix(rotations).as_quat()
    np.testing.assert_allclose(np.abs(np.sum(quat * scipys, axis=1)), 1, atol=1e-14)
    np.testing.assert_allclose(so3.rotation_from_quat(xp.asarray(quat)), rotations, atol=1e-14)


def test_quaternion_is_scalar_last():
    quarter_about_z = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(so3.quat_from_rotation(quarter_about_z), [0, 0, np.sqrt(0.5), np.sqrt(0.5)])


def test_quaternion_length_does_not_matter():
    quat = np.random.default_rng(5).normal(size=(20, 4))
    np.testing.assert_allclose(so3.rotation_from_quat(7 * quat), so3.rotation_from_quat(quat), atol=1e-14)
    np.testing.assert_allclose(so3.rotation_from_quat(-quat), so3.rotation_from_quat(quat), atol=1e-14)


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-8, 1e-3, 1, 3, np.pi - 1e-3, np.pi - 1e-8, np.pi])
def test_rotation_angle_is_accurate_at_both_ends(angle):
    axes = np.random.default_rng(6).normal(size=(50, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    found = so3.rotation_angle(Rotation.from_rotvec(angle * axes).as_matrix())
    np.testing.assert_allclose(found, angle, atol=3e-15, rtol=1e-15)


def test_hat_is_the_cross_product(x64):
    v, x = np.random.default_rng(7).normal(size=(2, 3))
    np.testing.assert_allclose(so3.hat(jnp.asarray(v)) @ x, np.cross(v, x), atol=1e-15)


def test_rotate_maps_rows():
    rng = np.random.default_rng(8)
    rotation, points = random_rotation(rng), rng.normal(size=(5, 3))
    np.testing.assert_allclose(so3.rotate(rotation, points), points @ rotation.T, atol=1e-15)
    assert isinstance(so3.rotate(rotation, points), np.ndarray)
    np.testing.assert_allclose(so3.rotate(jnp.asarray(rotation), points), points @ rotation.T, atol=1e-6)


def test_random_rotations_are_uniform(x64):
    keys = jax.random.split(jax.random.key(0), 20_000)
    rotations = np.asarray(jax.jit(jax.vmap(so3.random_rotation))(keys))
    np.testing.assert_allclose(np.linalg.det(rotations), 1, atol=1e-12)
    # Entries of a uniform rotation have mean 0 and variance 1/3: five standard errors.
    np.testing.assert_allclose(rotations.mean(axis=0), 0, atol=5 / np.sqrt(3 * 20_000))
    np.testing.assert_allclose((rotations**2).mean(axis=0), 1 / 3, atol=5 * 0.3 / np.sqrt(20_000))
    # The angle has density (1 - cos) / pi, so its mean is pi / 2 + 2 / pi.
    assert abs(so3.rotation_angle(rotations).mean() - (np.pi / 2 + 2 / np.pi)) < 0.03


def test_largest_eigenvalue_is_that_of_lapack(x64):
    rng = np.random.default_rng(0)
    square = rng.normal(size=(300, 3, 3))
    symmetric = square + square.swapaxes(1, 2)
    symmetric[:3] = np.zeros((3, 3)), np.eye(3), np.diag([1.0, 1.0, -2.0])
    found = jax.jit(jax.vmap(so3.largest_eigenvalue))(symmetric)
    np.testing.assert_allclose(found, np.linalg.eigvalsh(symmetric)[:, -1], atol=1e-12)
