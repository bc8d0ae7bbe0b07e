"""The projection on the dual matrices that annihilate the candidate."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float


def project_dual(w: Float[Array, "n4 n4"], exists: Float[Array, " n"]) -> Float[Array, "n4 n4"]:
    """Find the nearest Delta of the family (``dual.py``) with Delta x = 0 at the candidate x = (e4, ..., e4).

    In closed form: off-diagonal 3x3 parts keep their skew half, diagonal ones lose their mean, and the last
    columns u_ij become y_ij = w_ij - (g_i - g_j) with w the antisymmetric half and g_i = (sum_j w_ij +
    u_ii) / (n + 2), the diagonal taking what is left. O(n^2), and equal to the sparse inverse that was
    published.

    Args:
        w: Symmetric, in blocks of four.
        exists: 1 for blocks that exist, 0 for padding, which stays zero.
    """
    n = w.shape[0] // 4
    count, index = jnp.sum(exists), jnp.arange(n)
    blocks = w.reshape(n, 4, n, 4) * (exists[:, None] * exists[None])[:, None, :, None]
    diagonal = blocks[index, :, index, :]

    columns = blocks[:, :3, :, 3]  # u_ij at [i, :, j]
    anti = 0.5 * (columns - jnp.transpose(columns, (2, 1, 0)))
    g = (jnp.sum(anti, axis=2) + diagonal[:, :3, 3]) / (count + 2)
    y = anti - (g[:, :, None] - g.T[None, :, :])
    y = y * (exists[:, None] * exists[None])[:, None, :]
    y = y.at[index, :, index].set(0)
    y = y.at[index, :, index].set(-jnp.sum(y, axis=2))

    top = blocks[:, :3, :, :3]
    top = 0.5 * (top - jnp.transpose(top, (0, 3, 2, 1)))
    mean = jnp.sum(diagonal[:, :3, :3], axis=0) / count
    top = top.at[index, :, index, :].set((diagonal[:, :3, :3] - mean[None]) * exists[:, None, None])

    found = jnp.zeros_like(blocks)
    found = found.at[:, :3, :, :3].set(top)
    found = found.at[:, :3, :, 3].set(y)
    found = found.at[:, 3, :, :3].set(jnp.transpose(y, (2, 0, 1)))
    return found.reshape(4 * n, 4 * n)
