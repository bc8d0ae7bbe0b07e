"""Rotations: the nearest one to a matrix, with its derivative, and the usual forms and angles.

Rotations map column vectors, ``b = R a``; point arrays hold points as rows. Quaternions are
scalar **last**, ``(x, y, z, w)``, as in the paper.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.custom_batching import custom_vmap
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.ground.arrays import rounded_product as times

# One-sided Jacobi converges quadratically: over a million random, thin, rank-one and repeated
# spectra in float64, five sweeps reached rounding; six leave one in reserve.
JACOBI_SWEEPS = 6


def rotate(
    rotation: Float[AnyArray, "... 3 3"], points: Float[AnyArray, "... n 3"]
) -> Float[AnyArray, "... n 3"]:
    """Turn the rows of ``points`` by ``rotation``; full precision on every backend.

    Gradients: exact in both arguments.
    """
    if namespace(rotation, points) is np:
        return np.einsum("...ij,...nj->...ni", rotation, points)
    # Accelerators may multiply float32 matrices in fewer bits unless told not to.
    return jnp.einsum("...ij,...nj->...ni", rotation, points, precision=lax.Precision.HIGHEST)


def hat(vector: Float[AnyArray, "3"]) -> Float[Array, "3 3"]:
    """Make the skew matrix with ``hat(v) @ x = cross(v, x)``."""
    x, y, z = vector
    zero = jnp.zeros_like(x)
    return jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)


def axial(matrix: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Compute ``vee(G - G^T)``: twice the axis vector of the skew part."""
    return jnp.stack([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])


def _unit(vector: Float[Array, "3"], fallback: Float[Array, "3"]) -> Float[Array, "3"]:
    norm2 = _inner(vector, vector)
    safe = norm2 > jnp.finfo(vector.dtype).tiny
    return jnp.where(safe, vector * lax.rsqrt(jnp.where(safe, norm2, 1.0)), fallback)


def _inner(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    products = times(a, b)
    return products[0] + products[1] + products[2]


def _cross(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "3"]:
    return jnp.stack([times(a[i], b[j]) - times(a[j], b[i]) for i, j in ((1, 2), (2, 0), (0, 1))])


def singular_frames(
    matrix: Float[Array, "3 3"],
) -> tuple[Float[Array, "3 3"], Float[Array, "3"], Float[Array, "3 3"]]:
    """Decompose ``matrix = U diag(s) V^T`` with *proper* rotations U, V and s_1 >= s_2 >= |s_3|.

    The third axes come from cross products, so U and V are rotations whatever the rank, and the
    sign of the determinant sits in s_3. LAPACK compiles fastest and is as fast as anything for
    one matrix on a CPU; elsewhere the Jacobi iteration below needs no library.

    Returns:
        U (columns are left axes), signed singular values, V (columns are right axes).

    Gradients: none are defined here; :func:`nearest_rotation` carries the derivative.
    """
    left, right = _leading_axes(matrix)
    left = jnp.stack([left[0], left[1], _cross(left[0], left[1])], axis=1)
    right = jnp.stack([right[0], right[1], _cross(right[0], right[1])], axis=1)
    values = jnp.einsum("ik,ij,jk->k", left, matrix, right, precision=lax.Precision.HIGHEST)
    return left, values, right


Axes: TypeAlias = tuple[Float[Array, "2 3"], Float[Array, "2 3"]]


@custom_vmap
def _axes_of_one(matrix: Float[Array, "3 3"]) -> Axes:
    return lax.platform_dependent(matrix, cpu=_leading_axes_lapack, default=leading_axes_jacobi)


@_axes_of_one.def_vmap
def _axes_of_many(
    size: int, batched: Any, matrices: Float[Array, "k 3 3"]
) -> tuple[tuple[Float[Array, "k 2 3"], Float[Array, "k 2 3"]], tuple[bool, bool]]:
    # LAPACK takes matrices one by one; turns of columns are vector work: a quarter of the time from 64 on.
    # This may be traced after the block that allowed float64 has ended: its numbers must stay what they are.
    with jax.enable_x64(True) if matrices.dtype == jnp.float64 else nullcontext():
        return jax.vmap(leading_axes_jacobi)(matrices), (True, True)


_leading_axes = jax.jit(_axes_of_one)  # traced once, not once a use: half of it is meant for other devices


def _leading_axes_lapack(matrix: Float[Array, "3 3"]) -> Axes:
    left, _, right = jnp.linalg.svd(matrix)
    return left.T[:2], right[:2]


def leading_axes_jacobi(matrix: Float[Array, "3 3"]) -> Axes:
    """Find the two leading left and right axes (rows) by one-sided Jacobi.

    Turns pairs of columns until they are orthogonal. Rolling the columns after each turn visits
    the pairs in order with a loop body of one turn, which keeps the program small.
    """
    dtype = matrix.dtype
    size = jnp.max(jnp.abs(matrix))
    eye = jnp.eye(3, dtype=dtype)
    tiny = jnp.finfo(dtype).tiny

    # Row k holds column k of A and of V: both turn alike.
    def turn(_: Int[Array, ""], rows: Float[Array, "3 6"]) -> Float[Array, "3 6"]:
        x, y = rows[0], rows[1]
        xx, yy, xy = (_inner(u[:3], v[:3]) for u, v in ((x, x), (y, y), (x, y)))
        done = jnp.abs(xy) <= 8 * tiny
        zeta = (yy - xx) / (2 * jnp.where(done, 1, xy))
        tangent = jnp.where(zeta >= 0, 1, -1) / (jnp.abs(zeta) + jnp.sqrt(1 + times(zeta, zeta)))
        tangent = jnp.where(done, 0, tangent)
        cosine = lax.rsqrt(1 + times(tangent, tangent))
        sine = cosine * tangent
        turned = times(sine, x) + times(cosine, y), times(cosine, x) - times(sine, y)
        return jnp.stack([turned[0], rows[2], turned[1]])

    start = jnp.concatenate([(matrix / jnp.where(size > 0, size, 1)).T, eye], axis=1)
    rows = lax.fori_loop(0, 3 * JACOBI_SWEEPS, turn, start)
    # Written out: argmax is lowered after the block that allows float64, and would lose half of its digits.
    x, y, z = (_inner(row[:3], row[:3]) for row in rows)
    zero, one, two = jnp.int32(0), jnp.int32(1), jnp.int32(2)
    first = jnp.where((x >= y) & (x >= z), zero, jnp.where(y >= z, one, two))
    third = jnp.where((z <= x) & (z <= y), two, jnp.where(y <= x, one, zero))  # never `first`
    second = 3 - first - third
    u1 = _unit(rows[first, :3], eye[0])
    # A second axis of rounding noise only: any direction across the first will do.
    across = _reject(jnp.where(jnp.abs(u1[0]) < 0.9, eye[0], eye[1]), u1)
    u2 = _unit(_reject(rows[second, :3], u1), _unit(across, eye[1]))
    u2 = _unit(_reject(u2, u1), u2)
    return jnp.stack([u1, u2]), jnp.stack([rows[first, 3:], rows[second, 3:]])


def _reject(vector: Float[Array, "3"], axis: Float[Array, "3"]) -> Float[Array, "3"]:
    return vector - times(_inner(vector, axis), axis)


def largest_eigenvalue(matrix: Float[Array, "3 3"]) -> Float[Array, ""]:
    """Compute the largest eigenvalue of a symmetric matrix, in closed form (Smith, Comm. ACM 1961).

    Gradients: none worth having where eigenvalues meet.
    """
    mean = jnp.trace(matrix) / 3
    rest = matrix - mean * jnp.eye(3, dtype=matrix.dtype)
    spread = jnp.sqrt(jnp.sum(rest * rest) / 6)
    unit = rest / jnp.where(spread > 0, spread, 1)
    determinant = jnp.sum(unit[0] * _cross(unit[1], unit[2]))
    return mean + 2 * spread * jnp.cos(jnp.arccos(jnp.clip(determinant / 2, -1, 1)) / 3)


@jax.custom_jvp
def nearest_rotation(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Find the rotation R that maximises tr(R^T H), the solution of Wahba's problem.

    Args:
        matrix: H = sum_k w_k b_k a_k^T for pairs b_k ~ R a_k.

    Gradients: exact, forward and reverse, by one closed formula (below). Where the maximiser is
    not unique (rank one, a reflection with equal smallest singular values) the derivative is
    zero. Differentiating an SVD instead gives NaN at equal singular values and finite but wrong
    numbers at two equal ones.

    References: Yang, Shi, Carlone, T-RO 2021, eq. (12) without truncation; Horn 1987.
    """
    left, right = _leading_axes(matrix)
    third = times(_cross(left[0], left[1])[:, None], _cross(right[0], right[1])[None])
    return times(left[0][:, None], right[0][None]) + times(left[1][:, None], right[1][None]) + third


@nearest_rotation.defjvp
def _nearest_rotation_jvp(primals: tuple, tangents: tuple) -> tuple:
    # R^T H = M is symmetric at the optimum. Perturbing both with R' = R [w]x keeps it symmetric:
    #     (tr(M) I - M) w = vee(R^T dH - dH^T R).
    (matrix,), (d_matrix,) = primals, tangents
    high = lax.Precision.HIGHEST
    rotation = nearest_rotation(matrix)
    turned = jnp.einsum("ji,jk->ik", rotation, d_matrix, precision=high)
    inverse, _ = _inverse(matrix, rotation)
    omega = jnp.einsum("ij,j->i", inverse, axial(turned), precision=high)
    return rotation, jnp.einsum("ij,jk->ik", rotation, hat(omega), precision=high)


def _inverse(
    matrix: Float[Array, "3 3"], rotation: Float[Array, "3 3"]
) -> tuple[Float[Array, "3 3"], Bool[Array, ""]]:
    """Invert tr(M) I - M, for M = R^T H, and tell whether there is no inverse; it is zero then."""
    # Third powers follow: in units of the matrix none of them overflows.
    size = lax.stop_gradient(jnp.max(jnp.abs(matrix)))
    size = jnp.where(size > 0, size, 1)
    product = jnp.einsum("ji,jk->ik", rotation, matrix / size, precision=lax.Precision.HIGHEST)
    product = 0.5 * (product + product.T)
    trace = jnp.trace(product)
    system = trace * jnp.eye(3, dtype=matrix.dtype) - product
    c0, c1, c2 = system[:, 0], system[:, 1], system[:, 2]
    adjugate = jnp.stack([_cross(c1, c2), _cross(c2, c0), _cross(c0, c1)])
    determinant = jnp.sum(c0 * adjugate[0])
    ambiguous = determinant <= 64 * jnp.finfo(matrix.dtype).eps * jnp.abs(trace) ** 3
    return jnp.where(ambiguous, 0, adjugate / jnp.where(ambiguous, 1, determinant)) / size, ambiguous


def is_ambiguous(matrix: Float[Array, "3 3"], rotation: Float[Array, "3 3"]) -> Bool[Array, ""]:
    """Tell whether more than one rotation maximises tr(R^T H), to rounding: points on a line, a mirroring.

    Args:
        matrix: H.
        rotation: Its nearest rotation.
    """
    return _inverse(*lax.stop_gradient((matrix, rotation)))[1]


def rotation_angle(rotation: Float[AnyArray, "... 3 3"]) -> Float[AnyArray, "..."]:
    """Measure the angle of a rotation in [0, pi] [rad], accurate near 0 and near pi.

    Gradients: use only away from 0 and pi, where the angle has kinks.
    """
    xp = namespace(rotation)
    trace = xp.trace(rotation, axis1=-2, axis2=-1)
    skew = xp.stack(
        [
            rotation[..., 2, 1] - rotation[..., 1, 2],
            rotation[..., 0, 2] - rotation[..., 2, 0],
            rotation[..., 1, 0] - rotation[..., 0, 1],
        ],
        axis=-1,
    )
    return xp.arctan2(xp.sqrt(xp.sum(skew * skew, axis=-1)), trace - 1)


def quat_from_rotation(rotation: Float[AnyArray, "... 3 3"]) -> Float[AnyArray, "... 4"]:
    """Compute the unit quaternion (x, y, z, w), w >= 0, of a rotation matrix.

    The four classic branches are all evaluated and the best conditioned one is taken, so the
    result is accurate everywhere and has no data-dependent control flow.
    """
    xp = namespace(rotation)
    r = rotation
    xx, yy, zz = r[..., 0, 0], r[..., 1, 1], r[..., 2, 2]
    a, b, c = r[..., 2, 1] - r[..., 1, 2], r[..., 0, 2] - r[..., 2, 0], r[..., 1, 0] - r[..., 0, 1]
    d, e, f = r[..., 0, 1] + r[..., 1, 0], r[..., 0, 2] + r[..., 2, 0], r[..., 1, 2] + r[..., 2, 1]
    rows = xp.stack(  # row k is 4 q_k q: one of them is at least as long as 1
        [
            xp.stack([1 + xx - yy - zz, d, e, a], axis=-1),
            xp.stack([d, 1 - xx + yy - zz, f, b], axis=-1),
            xp.stack([e, f, 1 - xx - yy + zz, c], axis=-1),
            xp.stack([a, b, c, 1 + xx + yy + zz], axis=-1),
        ],
        axis=-2,
    )
    best = xp.argmax(xp.sum(rows * rows, axis=-1), axis=-1)
    quat = xp.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    quat = quat / xp.sqrt(xp.sum(quat * quat, axis=-1, keepdims=True))
    return xp.where(quat[..., 3:] < 0, -quat, quat)


def rotation_from_quat(quat: Float[AnyArray, "... 4"]) -> Float[AnyArray, "... 3 3"]:
    """Compute the rotation matrix of a quaternion (x, y, z, w), which need not have unit length."""
    xp = namespace(quat)
    x, y, z, w = (quat[..., k] / xp.sqrt(xp.sum(quat * quat, axis=-1)) for k in range(4))
    flat = xp.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
            2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
            2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y),
        ],
        axis=-1,
    )  # fmt: skip
    return flat.reshape(*flat.shape[:-1], 3, 3)


def random_rotation(key: Array) -> Float[Array, "3 3"]:
    """Draw a rotation uniformly from SO(3): a normalised Gaussian quaternion."""
    return rotation_from_quat(jax.random.normal(key, (4,)))
