"""Many poses slide to where a scan lies on the part, by looking up the nearest points."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float, Int

from teaser_jax import so3
from teaser_jax.clouds.parts.field import REACH, Field, voxel_of

ROUNDS = 24
# The reach shrinks to a quarter of the field's, or a scan of a corner stays where it was drawn to both sides.
LAST_REACH = 0.25
AT_ONCE = 64  # poses: on a CPU as fast as any number, and enough for a GPU
SOME = 1e-6  # of the weight of a point at its place: where none is within reach, all count alike


@jax.jit
def settle(
    field: Field,
    cells: Float[Array, "m 3"],
    points: Float[Array, "n 3"],
    rotations: Float[Array, "k 3 3"],
    shifts: Float[Array, "k 3"],
) -> tuple[Float[Array, "k 3 3"], Float[Array, "k 3"]]:
    """Align the points of a scan with the nearest cells of a part, from many poses at once.

    Each round matches every point with the nearest cell of the part, weighs the matches by how near they
    are, and finds the best pose for them: iterated closest points, with a table in the place of a tree.

    Args:
        field: Of the part.
        cells: Of the part, as the field numbers them [length].
        points: Of the scan [length].
        rotations, shifts: From the scan to the part, where to begin.

    Returns:
        Rotations and shifts where the rounds ended.
    """
    reach = field.width * jnp.float32(REACH)
    reaches = reach * jnp.geomspace(1.0, LAST_REACH, ROUNDS, dtype=jnp.float32)

    def one(start: tuple[Array, Array]) -> tuple[Array, Array]:
        def again(k: Int[Array, ""], pose: tuple[Array, Array]) -> tuple[Array, Array]:
            rotation, shift = pose
            here = so3.rotate(rotation, points) + shift[None]
            there = cells[field.nearest[voxel_of(field, here)]]
            squared = jnp.sum((here - there) ** 2, axis=1) / reaches[k] ** 2
            weight = jnp.maximum(1 - squared, 0) ** 2 + jnp.float32(SOME)
            weight = weight / jnp.sum(weight)
            mean, goal = weight @ points, weight @ there
            spread = jnp.einsum(
                "n,ni,nj->ij",
                weight,
                there - goal[None],
                points - mean[None],
                precision=lax.Precision.HIGHEST,
            )
            rotation = so3.nearest_rotation(spread)
            return rotation, goal - so3.rotate(rotation, mean[None])[0]

        return lax.fori_loop(jnp.int32(0), jnp.int32(ROUNDS), again, start)

    return lax.map(one, (rotations, shifts), batch_size=AT_ONCE)
