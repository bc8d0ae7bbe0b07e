"""The robust rotation problem as a quadratic form in a quaternion and its clones (problem (19)).

With q the quaternion of a rotation, scalar last, and theta_k = +1 for an inlier and -1 for an outlier,
the cost sum_k min(|b_k - R a_k|^2, c^2) is x^T Q x at x = [q; theta_1 q; ...; theta_K q]. Everything here
is written in the frame of a candidate, a_k against R^T b_k, in which the candidate is the identity and
its quaternion (0, 0, 0, 1). Measurements are in units of their noise bounds, so that c is one number.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from teaser_jax import so3
from teaser_jax.ground.arrays import AnyArray

# The positions of the six free numbers of a skew 4x4 block, each with its negative mirrored.
ROWS, COLUMNS = (0, 0, 1, 0, 1, 2), (1, 2, 2, 3, 3, 3)


class Measurements(NamedTuple):
    """Vector pairs in the frame of a candidate rotation, in units of their noise bounds.

    Attributes:
        src: a_k.
        dst: R^T b_k.
        cbar2: Truncation of the squared residual [-].
        mask: Measurements that exist; the others hold zeros.
    """

    src: Float[AnyArray, "k 3"]
    dst: Float[AnyArray, "k 3"]
    cbar2: Float[AnyArray, ""]
    mask: Bool[AnyArray, " k"]

    @property
    def residuals(self) -> Float[AnyArray, "k 3"]:
        """The residuals R^T b_k - a_k."""
        return self.dst - self.src

    @property
    def inliers(self) -> Bool[Array, " k"]:
        """The measurements where theta is +1: those within the truncation."""
        return self.mask & (jnp.sum(self.residuals**2, axis=1) <= self.cbar2)

    @property
    def cost(self) -> Float[Array, ""]:
        """The truncated cost of the candidate [-]."""
        r2 = jnp.sum(self.residuals**2, axis=1)
        return jnp.sum(jnp.where(self.mask, jnp.minimum(r2, self.cbar2), 0))

    def turned(self, rotation: Float[AnyArray, "3 3"]) -> Measurements:
        """Write the measurements in the frame of another candidate, ``rotation`` away from this one."""
        return self._replace(dst=so3.rotate(rotation.T, self.dst))


class Framed(NamedTuple):
    """Measurements in the frame of a rotation, and what was set apart."""

    measurements: Measurements
    frame: Float[Array, "3 3"]  # that rotation
    constant: Float[Array, ""]  # cost of the measurements that no rotation changes [-]


def in_frame_of(
    rotation: Any, src: Any, dst: Any, *, noise_bound: Any, cbar2: Any, mask: Any, dtype: Any = jnp.float64
) -> Framed:
    """Write vector pairs in units of their bounds and in the frame of a rotation.

    Rows that are not finite or whose bound is not above zero are left out. A vector of no length has the
    same residual under every rotation: it is left out, too, and its cost kept.

    Args:
        rotation: (3, 3), projected on SO(3) first.
        src, dst: (k, 3).
        noise_bound: One or (k,).
        cbar2: Truncation [-].
        mask: (k,).
        dtype: Of the result.
    """
    src, dst, rotation, noise_bound, cbar2 = (
        jnp.asarray(x).astype(dtype) for x in (src, dst, rotation, noise_bound, cbar2)
    )
    bound = jnp.broadcast_to(noise_bound, src.shape[:1])
    usable = mask & jnp.all(jnp.isfinite(src), axis=1) & jnp.all(jnp.isfinite(dst), axis=1)
    usable &= jnp.isfinite(bound) & (bound > 0) & jnp.isfinite(cbar2) & (cbar2 > 0)
    bound = jnp.where(usable, bound, 1)[:, None]
    src, dst = (jnp.where(usable[:, None], x, 0) / bound for x in (src, dst))
    eye = jnp.eye(3, dtype=dtype)
    frame = so3.nearest_rotation(jnp.where(jnp.all(jnp.isfinite(rotation)), rotation, eye))
    length2 = jnp.sum(src**2, axis=1), jnp.sum(dst**2, axis=1)
    turns = usable & (length2[0] > 0) & (length2[1] > 0)
    rest = usable & ~turns
    constant = jnp.sum(jnp.where(rest, jnp.minimum(length2[0] + length2[1], cbar2), 0))
    src, dst = (jnp.where(turns[:, None], x, 0) for x in (src, dst))
    return Framed(Measurements(src, so3.rotate(frame.T, dst), cbar2, turns), frame, constant)


def pair_matrix(src: Float[AnyArray, "k 3"], dst: Float[AnyArray, "k 3"]) -> Float[Array, "k 4 4"]:
    """Make the symmetric P with q^T P q = b . R(q) a for every unit quaternion q, scalar last."""
    outer = dst[:, :, None] * src[:, None, :]
    inner = jnp.trace(outer, axis1=1, axis2=2)
    top = outer + jnp.swapaxes(outer, 1, 2) - inner[:, None, None] * jnp.eye(3, dtype=src.dtype)[None]
    cross = jnp.cross(src, dst)
    top = jnp.concatenate([top, cross[:, :, None]], axis=2)
    bottom = jnp.concatenate([cross, inner[:, None]], axis=1)[:, None, :]
    return jnp.concatenate([top, bottom], axis=1)


def cost_blocks(m: Measurements) -> tuple[Float[Array, "k 4 4"], Float[Array, "k 4 4"]]:
    """Make H+ and H-, with q^T H q = (r^2 +- c^2) / 2; zero for measurements that do not exist.

    The cost of a measurement is q^T H+ q + theta q^T H- q.
    """
    size = 0.5 * (jnp.sum(m.src**2, axis=1) + jnp.sum(m.dst**2, axis=1))
    eye = jnp.eye(4, dtype=m.src.dtype)[None]
    both = size[:, None, None] * eye - pair_matrix(m.src, m.dst)
    exists, half = m.mask[:, None, None], 0.5 * m.cbar2 * eye
    return jnp.where(exists, both + half, 0), jnp.where(exists, both - half, 0)


def cost_matrix(m: Measurements) -> Float[Array, "n4 n4"]:
    """Make the cost matrix Q, gauge-fixed: the clones are theta_k q, so the blocks (0, k) carry theta_k."""
    plus, minus = cost_blocks(m)
    k = plus.shape[0]
    theta = jnp.where(m.inliers, 1, -1).astype(m.src.dtype)[:, None, None]
    index = jnp.arange(1, k + 1)
    blocks = jnp.zeros((k + 1, 4, k + 1, 4), m.src.dtype)
    blocks = blocks.at[index, :, index, :].set(plus)
    blocks = blocks.at[0, :, index, :].set(0.5 * theta * minus)
    blocks = blocks.at[index, :, 0, :].set(0.5 * theta * minus)
    return blocks.reshape(4 * k + 4, 4 * k + 4)
