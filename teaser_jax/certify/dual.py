"""Dual matrices: any of them bounds the cost of every rotation from below.

For symmetric Delta with (i) skew 4x4 blocks off the diagonal, (ii) symmetric blocks on it that (iii) sum to
zero, and M = Q - mu J + Delta with mu the cost of the candidate, every rotation costs at least
mu + (K + 1) min(0, smallest eigenvalue of M). Nothing else is needed for that: no convergence, no
stationarity. A ``Dual`` holds the free numbers of Delta, from which that structure follows by construction.

The first guess here, which spreads the torques of the residuals over pairs of inliers, makes M positive
semidefinite for most candidates that rest on right matches: the proof exists before the first iteration.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Float

from teaser_jax.ground.arrays import AnyArray
from teaser_jax.stages.rotation.quadratic_form import COLUMNS, ROWS, Measurements, cost_blocks, cost_matrix

HIGHEST = lax.Precision.HIGHEST


class Dual(NamedTuple):
    """The free numbers of Delta, in the candidate's frame with theta taken out.

    Attributes:
        skew: Blocks (i, j), i < j, by the entries (0,1), (0,2), (1,2), (0,3), (1,3), (2,3).
            What stands at i >= j is not read.
        diagonal: Blocks (k, k) of the measurements, symmetric. Block (0, 0) is minus their sum.
    """

    skew: Float[AnyArray, "... n n 6"]
    diagonal: Float[AnyArray, "... k 4 4"]


def existing(m: Measurements) -> Float[Array, " n"]:
    """Write 1 for the block of the quaternion and those of measurements that exist, and 0 for padding."""
    return jnp.concatenate([jnp.ones(1, m.src.dtype), m.mask.astype(m.src.dtype)])


def dual_matrix(m: Measurements, dual: Dual) -> Float[Array, "n4 n4"]:
    """Build M = Q - mu J + Delta from the free numbers of Delta."""
    n = dual.skew.shape[0]
    upper = jnp.where(jnp.triu(jnp.ones((n, n), bool), 1)[:, :, None], dual.skew, 0)
    skew = upper - jnp.swapaxes(upper, 0, 1)
    # Entry (r, c) of all blocks at once, as planes that are copied: scattered entries take twice as long.
    planes = [[jnp.zeros((n, n), skew.dtype) for _ in range(4)] for _ in range(4)]
    for value, (row, column) in enumerate(zip(ROWS, COLUMNS, strict=True)):
        planes[row][column], planes[column][row] = skew[:, :, value], -skew[:, :, value]
    blocks = jnp.stack([jnp.stack(row, axis=-1) for row in planes], axis=1)
    symmetric = 0.5 * (dual.diagonal + jnp.swapaxes(dual.diagonal, 1, 2))
    corner = -jnp.sum(symmetric, axis=0) - m.cost * jnp.eye(4, dtype=symmetric.dtype)
    index = jnp.arange(n)
    blocks = blocks.at[index, :, index, :].set(jnp.concatenate([corner[None], symmetric]))
    return cost_matrix(m) + blocks.reshape(4 * n, 4 * n)


def dual_of(m: Measurements, matrix: Float[Array, "n4 n4"]) -> Dual:
    """Read the free numbers of Delta off a matrix M; what does not belong to the family is dropped."""
    n = matrix.shape[0] // 4
    blocks = (matrix - cost_matrix(m)).reshape(n, 4, n, 4)
    skew = 0.5 * (blocks - jnp.transpose(blocks, (0, 3, 2, 1)))
    free = jnp.stack([skew[:, r, :, c] for r, c in zip(ROWS, COLUMNS, strict=True)], axis=-1)
    index = jnp.arange(1, n)
    diagonal = blocks[index, :, index, :]
    return Dual(free, 0.5 * (diagonal + jnp.swapaxes(diagonal, 1, 2)))


def reference_guess(m: Measurements) -> Dual:
    """Make the published initial guess, which has no coupling between measurements.

    References: Yang, Shi, Carlone, T-RO 2021, Algorithm 3 and its supplement.
    """
    plus, minus = cost_blocks(m)
    r2 = jnp.where(m.inliers, jnp.sum(m.residuals**2, axis=1), 0)
    eye = jnp.eye(3, dtype=m.src.dtype)
    top = 0.5 * plus[:, :3, :3] - 0.5 * r2[:, None, None] * eye[None]
    return Dual(_no_coupling(m), _with_last_column(m, top, minus) - plus)


def coupled_guess(m: Measurements, *, correct_outliers: bool | Bool[Array, ""]) -> Dual:
    """Route the torque of each residual through the pairs of inliers, a guess that often is a proof.

    For inliers j and k the last column of block (j, k) is beta_jk a_j x a_k with beta_jk = p_j . a_k +
    p_k . a_j, such that the sum over k is minus half the torque of residual j. It is orthogonal to both, so
    it does not push along the soft directions of either. The p_j follow from one 9 x 9 system.

    Args:
        m: The measurements; at a stationary candidate M then annihilates it.
        correct_outliers: Take out the one negative direction that each outlier within 90 degrees has, at
            the price of curvature in block (0, 0): good for few outliers, bad for many.
    """
    plus, minus = cost_blocks(m)
    # The published guess takes r^2 / 2 from the blocks of inliers, which makes those with a residual of more
    # than 0.7 c indefinite along their vector, and nothing asks for it.
    top = 0.5 * plus[:, :3, :3]
    top = top + jnp.where(correct_outliers, _outlier_correction(m), 0)
    y = _coupling(m)
    last = -jnp.sum(y, axis=1)
    diagonal = _with_last_column(m, top, minus) - plus
    diagonal = diagonal.at[:, :3, 3].add(last).at[:, 3, :3].add(last)
    skew = _no_coupling(m).at[1:, 1:, 3:].set(y)
    return Dual(skew, diagonal)


def _no_coupling(m: Measurements) -> Float[Array, "n n 6"]:
    """Fill the skew blocks with zeros: measurements do not act on each other."""
    n = m.src.shape[0] + 1
    return jnp.zeros((n, n, 6), m.src.dtype)


def _with_last_column(
    m: Measurements, top: Float[Array, "k 3 3"], minus: Float[Array, "k 4 4"]
) -> Float[Array, "k 4 4"]:
    """Complete blocks (k, k) of M by a last column that makes up for that of block (0, k): M x = 0."""
    theta = jnp.where(m.inliers, 1, -1).astype(top.dtype)
    column = -0.5 * theta[:, None] * minus[:, :, 3]
    rows = jnp.concatenate([top, column[:, :3, None]], axis=2)
    return jnp.concatenate([rows, column[:, None, :]], axis=1)


def _coupling(m: Measurements) -> Float[Array, "k k 3"]:
    """Find the last columns y_jk of the blocks between inliers in ``coupled_guess``."""
    inlier = m.inliers[:, None].astype(m.src.dtype)
    a, xi = m.src * inlier, m.residuals * inlier
    eye = jnp.eye(3, dtype=a.dtype)
    spread = jnp.matmul(a.T, a, precision=HIGHEST)
    size = jnp.trace(spread)
    # A plane or a line through zero leaves it singular: a ridge keeps the guess finite, and it stays valid.
    inverse = jnp.linalg.inv(spread + (1e-9 * size + jnp.where(size > 0, 0, 1)) * eye)
    reduced = jnp.matmul(a, inverse, precision=HIGHEST)
    along = jnp.sum(reduced * a, axis=1)
    along = jnp.where(along > jnp.finfo(a.dtype).tiny, along, 1)
    project = inverse[None] - reduced[:, :, None] * reduced[:, None, :] / along[:, None, None]
    project = project * inlier[:, :, None]
    # N^T + sum_k project_k N a_k a_k^T = sum_k project_k xi_k a_k^T / 2, for N as a vector of nine.
    system = jnp.einsum("kip,kq,kj->ijpq", project, a, a, precision=HIGHEST)
    system = system + jnp.einsum("iq,jp->ijpq", eye, eye)
    known = 0.5 * jnp.einsum("kip,kp,kj->ij", project, xi, a, precision=HIGHEST)
    solved = jnp.matmul(jnp.linalg.pinv(system.reshape(9, 9), rtol=1e-8), known.reshape(9), precision=HIGHEST)
    p = jnp.einsum("kij,kj->ki", project, 0.5 * xi - jnp.matmul(a, solved.reshape(3, 3).T, precision=HIGHEST))
    beta = jnp.matmul(p, a.T, precision=HIGHEST)
    beta = (beta + beta.T) * inlier * inlier.T
    return beta[:, :, None] * jnp.cross(a[:, None], a[None])


def _outlier_correction(m: Measurements) -> Float[Array, "k 3 3"]:
    """Find what turns c^2 I / 2 in the block of an outlier into (n n^T + p p^T / sin^2(phi / 2)) c^2 / 2.

    n halves the angle phi between the two vectors and p is normal to both. For others the correction is zero.
    """
    eye = jnp.eye(3, dtype=m.src.dtype)

    def directions(x: Array) -> tuple[Array, Array]:
        """Compute unit vectors along the rows, and tell which rows are long enough to have one."""
        length = jnp.sqrt(jnp.sum(x * x, axis=1))
        some = length > 1e-6
        return x / jnp.where(some, length, 1)[:, None], some

    (a, some_a), (b, some_b) = directions(m.src), directions(m.dst)
    (bisector, some_n), (normal, some_p) = directions(a + b), directions(jnp.cross(a, b))
    sine2 = jnp.maximum(0.5 * (1 - jnp.sum(a * b, axis=1)), 1e-3)
    shape = bisector[:, :, None] * bisector[:, None, :]
    shape += normal[:, :, None] * normal[:, None, :] / sine2[:, None, None]
    good = m.mask & ~m.inliers & some_a & some_b & some_n & some_p
    return jnp.where(good[:, None, None], 0.5 * m.cbar2 * (shape - eye[None]), 0)
