"""What two clouds say of poses between them, in numbers: of one pose or thousands, under jit and vmap."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from teaser_jax import so3
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.prepared import as_prepared, threads_or_all
from teaser_jax.clouds.trust.judge import CELLS, MOST_CELLS
from teaser_jax.clouds.trust.observability import seen_by
from teaser_jax.clouds.trust.pairing import NEAR, compared, direction_weights
from teaser_jax.clouds.trust.space import sight
from teaser_jax.clouds.trust.table import Table, nearest_cell, table_of
from teaser_jax.ground.arrays import AnyArray, as_array, is_traced
from teaser_jax.pose import Pose
from teaser_jax.reading import positive_number

AT_ONCE = 16  # poses side by side


class Support(NamedTuple):
    """What two clouds say of a pose; with the axes of the poses in front.

    Pairs of numbers are of the source on the target, and of the target on the source.

    Attributes:
        overlap: Which share of the cells has one of the other cloud within three cells [-].
        fit: Which part of the overlap fits, every direction of normals counting the same [-].
        share: Which share of the cells fits [-].
        normals: Mean cosine between the normals in the overlap; without its sign, unless both viewpoints
            are known [-].
        in_front: Which share of the cells that lie where the other sensor saw something lies in front of it,
            where it looked through [-]; NaN: no viewpoint is known, or nothing lies there.
        hidden: Which share of these lies behind, where it could see nothing [-]; NaN likewise.
        visible: Which share of each of six motions the normals see, the least visible first [-]; 0: free.
        residual: How far the surfaces lie apart along their normals where the source fits, root mean
            square [length]; NaN: nothing fits.
    """

    overlap: Float[AnyArray, "*k 2"]
    fit: Float[AnyArray, "*k 2"]
    share: Float[AnyArray, "*k 2"]
    normals: Float[AnyArray, "*k 2"]
    in_front: Float[AnyArray, "*k 2"]
    hidden: Float[AnyArray, "*k 2"]
    visible: Float[AnyArray, "*k 6"]
    residual: Float[AnyArray, "*k"]


def support(
    pose: Any,
    src: Any,
    dst: Any,
    *,
    src_viewpoint: Any = None,
    dst_viewpoint: Any = None,
    voxel_size: float | None = None,
    threads: int | None = None,
) -> Support:
    """Tell what two clouds say of poses between them: the numbers that a verdict rests on.

    The clouds are read on the host; the poses may be traced: works under jit and vmap, for any number of
    them. Gradients are zero: cells are counted. Those of ``residual`` hold while the same cells fit.

    Args:
        pose: From the source to the target frame: a ``Pose`` or ``[R, t; 0, 1]``, (4, 4), or many of them,
            (..., 4, 4). Traced poses of clouds far from the origin lose digits to single precision.
        src, dst: The clouds, as ``register_clouds`` takes them.
        src_viewpoint, dst_viewpoint: Where each sensor stood, (3,), in the frame of its cloud [length].
        voxel_size: Width of the cells; None: as ``register_clouds`` chooses it [length].
        threads: How many threads to ask for neighbours with; None: one for each core.

    Returns:
        A ``Support``, with the axes of the poses in front.

    Raises:
        ValueError: If a cloud cannot be read, or a pose is none.
        ImportError: Without the extra ``clouds``.
    """
    if is_traced(src, dst):
        raise ValueError("support reads clouds on the host: inside jit and vmap only poses may be traced.")
    if voxel_size is not None:
        positive_number(voxel_size, "voxel_size")
    matrix = _matrices(pose)
    one = partial(as_prepared, threads=threads_or_all(threads))
    with jax.ensure_compile_time_eval():  # clouds are read at once, also where poses are traced
        clouds = one(src, "src", viewpoint=src_viewpoint), one(dst, "dst", viewpoint=dst_viewpoint)
        pair = Pair(*clouds, voxel_size=voxel_size)
        surfaces = pair.surfaces(CELLS, MOST_CELLS)
        tables = [table_of(x, image) for x, image in zip(surfaces, pair.images, strict=True)]
    cell = surfaces[1].voxel_size
    rotation = matrix[..., :3, :3]
    shift = so3.rotate(rotation, pair.src.cloud.origin[None])[..., 0, :] - pair.dst.cloud.origin
    flat = jnp.asarray(rotation.reshape(-1, 3, 3), jnp.float32)
    shifts = jnp.asarray(((matrix[..., :3, 3] + shift) / cell).reshape(-1, 3), jnp.float32)
    found = _each(flat, shifts, *tables)
    found = found._replace(residual=found.residual * np.float32(cell))
    return jax.tree.map(lambda x: x.reshape(*matrix.shape[:-2], *x.shape[1:]), found)


@jax.jit
def _each(rotations: Float[Array, "k 3 3"], shifts: Float[Array, "k 3"], src: Table, dst: Table) -> Support:
    one = lambda pose: support_between(pose[0], pose[1], src, dst)
    return lax.map(one, (rotations, shifts), batch_size=AT_ONCE)


def support_between(
    rotation: Float[Array, "3 3"], shift: Float[Array, "3"], src: Table, dst: Table
) -> Support:
    """Tell what two tables of one width of cells say of a pose. A pure function: works under jit and vmap.

    Args:
        rotation, shift: From the source to the target, each about its middle [cells].
        src, dst: The clouds.

    Returns:
        A ``Support`` with lengths in cells.
    """
    inverse = rotation.T
    here = _one_way(rotation, shift, src, dst)
    back = _one_way(inverse, -so3.rotate(inverse, shift[None])[0], dst, src)
    both = jax.tree.map(lambda *ways: jnp.stack(ways), here, back)
    return both._replace(visible=here.visible, residual=here.residual)


def _one_way(rotation: Float[Array, "3 3"], shift: Float[Array, "3"], src: Table, dst: Table) -> Support:
    """Lay the source on the target: a ``Support`` of this way alone."""
    points = so3.rotate(rotation, src.points) + shift[None]
    ours = so3.rotate(rotation, src.normals)
    partner, distance = nearest_cell(points, dst)
    found = compared(points - dst.points[partner], distance, ours, dst.normals[partner], 1)
    near, fits = src.mask & (distance < NEAR), src.mask & found.fits
    number = lambda kind: jnp.sum(kind, dtype=points.dtype)
    count = number(src.mask)
    weight = direction_weights(ours, count)
    of_overlap, of_fit = (jnp.where(kind, weight, 0) for kind in (near, fits))
    overlap, fit = jnp.sum(of_overlap), jnp.sum(of_fit)
    some, mean = fit > 0, of_fit / jnp.where(fit > 0, fit, 1)
    cosine = jnp.where(src.has_viewpoint & dst.has_viewpoint, found.cosine, jnp.abs(found.cosine))
    seen = sight(dst.image, points, src.mask, NEAR)
    return Support(
        overlap=number(near) / count,
        fit=fit / jnp.where(overlap > 0, overlap, 1),
        share=number(fits) / count,
        normals=jnp.sum(of_overlap * cosine) / jnp.where(overlap > 0, overlap, 1),
        in_front=seen.in_front,
        hidden=seen.hidden,
        visible=jnp.where(some, seen_by(points, ours, found.theirs, mean)[0], 0),
        residual=jnp.where(some, jnp.sqrt(jnp.sum(mean * found.residual**2)), jnp.nan),
    )


def _matrices(pose: Any) -> AnyArray:
    """Read one pose or many as matrices without scale."""
    matrix = as_array(pose.matrix if isinstance(pose, Pose) else pose, "pose")
    if matrix.ndim < 2 or matrix.shape[-2:] != (4, 4) or matrix.dtype.kind not in "fiu":
        raise ValueError(f"pose has shape {matrix.shape}: expected a Pose, or matrices, (..., 4, 4).")
    if not is_traced(matrix):
        matrix = np.asarray(matrix, np.float64)
        turns = matrix[..., :3, :3]
        if (
            not np.allclose(turns @ np.swapaxes(turns, -1, -2), np.eye(3), atol=1e-3)
            or not np.isfinite(matrix).all()
        ):
            raise ValueError(
                "pose is no rotation and translation: scale the source beforehand if it has a scale."
            )
    return matrix
