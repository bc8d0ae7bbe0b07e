"""The pose: a similarity from the frame of the source to that of the target."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Float

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray, Placeholder, as_array, namespace

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Pose:
    """The similarity ``b = s R a + t`` from the source to the target frame, ``T_dst_src``.

    Fields may be numpy or JAX arrays, with leading batch axes; results are of the same kind. As a Jacobian it
    has the axes of the input behind its own.
    """

    rotation: Float[AnyArray, "... 3 3"] | Float[AnyArray, "3 3 ..."] | Placeholder
    translation: Float[AnyArray, "... 3"] | Float[AnyArray, "3 ..."] | Placeholder
    scale: Float[AnyArray, "..."] | Placeholder

    def __post_init__(self) -> None:
        """Take plain numbers and lists, too: Pose(rotation, [1, 2, 3], 1)."""
        for name in ("rotation", "translation", "scale"):
            value = getattr(self, name)
            if isinstance(value, (int, float, list, tuple)) and not isinstance(value, np.floating):
                object.__setattr__(self, name, np.asarray(value, np.float64))

    @classmethod
    def from_matrix(cls, matrix: Any) -> Pose:
        """Make a pose from ``[s R, t; 0, 1]``. Raises ValueError if a concrete s R is no scaled rotation."""
        matrix = as_array(matrix, "the pose matrix")
        xp = namespace(matrix)
        if matrix.shape[-2:] != (4, 4) or matrix.dtype.kind not in "fiu":
            raise ValueError(
                f"a pose matrix has shape (4, 4), received {matrix.shape} of {matrix.dtype}: give real "
                "numbers, [s R, t; 0, 1]."
            )
        if matrix.dtype.kind != "f":
            matrix = matrix.astype(float)
        if not isinstance(matrix, jax.core.Tracer):
            _check_similarity(np.asarray(matrix, np.float64))
        size, block = _unit_block(matrix, xp)
        root = xp.cbrt(xp.linalg.det(block))
        return cls(block / root[..., None, None], matrix[..., :3, 3], size * root)

    @property
    def matrix(self) -> Float[AnyArray, "*batch 4 4"]:
        """``T_dst_src = [s R, t; 0, 1]``."""
        xp = namespace(self.rotation, self.translation, self.scale)
        scaled = self.scale[..., None, None] * self.rotation
        top = xp.concatenate([scaled, self.translation[..., None]], axis=-1)
        bottom = xp.broadcast_to(xp.asarray([0, 0, 0, 1], top.dtype), (*top.shape[:-2], 1, 4))
        return xp.concatenate([top, bottom], axis=-2)

    @property
    def quat(self) -> Float[AnyArray, "*batch 4"]:
        """Unit quaternion of the rotation, scalar last."""
        return so3.quat_from_rotation(self.rotation)

    def apply(self, points: Any) -> Float[AnyArray, "... n 3"]:
        """Carry source points (rows) to the target frame. Raises ValueError unless they are (..., n, 3)."""
        points = as_array(points, "points")
        if points.dtype.kind in "OSUMmbc" or points.dtype.names:
            raise ValueError(f"points have dtype {points.dtype}: expected real numbers.")
        if points.dtype.kind in "iu":
            points = points.astype(float)
        if points.ndim < 2 or points.shape[-1] != 3:
            raise ValueError(f"points have shape {points.shape}: expected (n, 3), one point a row.")
        rotated = so3.rotate(self.rotation, points)
        return self.scale[..., None, None] * rotated + self.translation[..., None, :]

    def inverse(self) -> Pose:
        """Compute the pose from the target to the source frame, ``T_src_dst``."""
        xp = namespace(self.rotation, self.translation, self.scale)
        transposed = xp.swapaxes(self.rotation, -1, -2)
        scale: AnyArray = 1 / self.scale
        moved = so3.rotate(transposed, self.translation[..., None, :])[..., 0, :]
        return Pose(transposed, -scale[..., None] * moved, scale)

    # numpy asks __rmatmul__ below instead of multiplying entries.
    __array_ufunc__ = None

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        """Return the matrix, for numpy."""
        return np.array(self.matrix, dtype)

    def __rmatmul__(self, other: Any) -> Pose:
        """Compose a pose, or its matrix, with this one."""
        return as_pose(other) @ self

    def __matmul__(self, other: Pose | Any) -> Pose:
        """Compose two poses: ``(T_c_b @ T_b_a).apply(p) == T_c_b.apply(T_b_a.apply(p))``; or a matrix."""
        other = as_pose(other)
        moved = self.apply(other.translation[..., None, :])[..., 0, :]
        rotation = so3.rotate(self.rotation, other.rotation.swapaxes(-1, -2)).swapaxes(-1, -2)
        return Pose(rotation, moved, self.scale * other.scale)

    def as_scipy(self) -> Rotation:
        """Return the rotation as ``scipy.spatial.transform.Rotation``."""
        from scipy.spatial.transform import Rotation

        return Rotation.from_matrix(np.asarray(self.rotation))


def as_pose(value: Any) -> Pose:
    """Read a pose: a ``Pose``, an answer that has one, or a matrix ``[s R, t; 0, 1]`` of (4, 4) or (3, 4).

    Raises:
        ValueError: If it is none of them.
    """
    if isinstance(value, Pose):
        return value
    if isinstance(getattr(value, "pose", None), Pose):
        return value.pose
    try:
        axes = np.ndim(value)
    except ValueError:  # lists of different lengths
        axes = 0
    if axes < 2:
        raise ValueError(
            f"received {type(value).__name__} for a pose: give a Pose, the answer of register, or a matrix "
            "[s R, t; 0, 1] of shape (4, 4)."
        )
    matrix = as_array(value, "the pose matrix")
    xp = namespace(matrix)
    if matrix.shape[-2:] == (3, 4):  # as KITTI writes them
        last = xp.broadcast_to(xp.asarray([0, 0, 0, 1], matrix.dtype), (*matrix.shape[:-2], 1, 4))
        matrix = xp.concatenate([matrix, last], axis=-2)
    return Pose.from_matrix(matrix)


def _unit_block(matrix: AnyArray, xp: Any) -> tuple[AnyArray, AnyArray]:
    """Return the largest entry of s R, and s R in units of it: tiny and huge scales have no cube."""
    block = matrix[..., :3, :3]
    largest = xp.max(xp.abs(block), axis=(-2, -1))
    size = xp.where(largest > 0, largest, xp.ones_like(largest))
    return size, block / size[..., None, None]


def _check_similarity(matrix: np.ndarray) -> None:
    """Raise ValueError unless each matrix is [s R, t; 0, 1] with s above 0, to one in a thousand."""
    with np.errstate(invalid="ignore"):  # entries that are not finite are refused below
        _, block = _unit_block(matrix, np)
        scale2 = np.cbrt(np.linalg.det(block))[..., None, None] ** 2
        error = np.abs(np.swapaxes(block, -1, -2) @ block - scale2 * np.eye(3))
        proper = np.all(error <= 1e-3 * scale2) and np.all(np.linalg.det(block) > 0)
        bottom = np.allclose(matrix[..., 3, :], [0, 0, 0, 1])
    if not (proper and bottom and np.all(np.isfinite(matrix))):
        raise ValueError(
            "the matrix is not [s R, t; 0, 1] with a positive scale and a rotation: is it transposed, "
            "sheared or mirrored?"
        )
