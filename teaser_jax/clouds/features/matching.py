"""Which points of two clouds look alike: candidates for matches, most of them wrong."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.clouds.features.fpfh import Descriptors
from teaser_jax.clouds.sizes import rows_for
from teaser_jax.ground.arrays import AnyArray
from teaser_jax.ground.checks import whole_number

ROWS_AT_ONCE = 16  # of a table of distances: it stays in the innermost cache


class Nearest(NamedTuple):
    """What lies nearest to each row among the rows of another table.

    Attributes:
        row: The nearest row.
        distance: How far it is, squared.
        second: How far the second nearest is, squared.
        back: For each row of the other table the nearest one of these.
    """

    row: Int[AnyArray, " n"]
    distance: Float[AnyArray, " n"]
    second: Float[AnyArray, " n"]
    back: Int[AnyArray, " m"]


class Matched(NamedTuple):
    """Matches between two clouds, the clearest first.

    Attributes:
        rows: Row of the source and row of the target.
        ratio: Distance of the match over that of the next best, squared [-]: the smaller, the clearer.
    """

    rows: Int[np.ndarray, "m 2"]
    ratio: Float[np.ndarray, " m"]


@jax.jit
def nearest(
    a: Float[Array, "n d"], b: Float[Array, "m d"], valid_a: Bool[Array, " n"], valid_b: Bool[Array, " m"]
) -> Nearest:
    """Find the nearest row of ``b`` for each row of ``a``, and back, by one table of distances.

    Works under jit and vmap, on CPU and GPU; the table is never held as a whole. Of rows equally near the
    first counts. Rows that are not valid are never found; what is found for them means nothing.

    Args:
        a, b: Descriptors of two clouds; of one length, when learned ones are to be told by their angle.
        valid_a, valid_b: Rows that can be used.

    Gradients: none for the rows; exact for the distances.
    """
    n, m = a.shape[0], b.shape[0]
    missing = -n % ROWS_AT_ONCE
    usable = jnp.pad(valid_a, (0, missing)).reshape(-1, ROWS_AT_ONCE)
    # |a|^2 + |b|^2 - 2 a b as one product: the table is written once, and complete.
    long_a = jnp.stack([jnp.sum(a * a, axis=1), jnp.ones_like(a[:, 0])], axis=1)
    long_b = jnp.stack([jnp.ones_like(b[:, 0]), jnp.where(valid_b, jnp.sum(b * b, axis=1), jnp.inf)], axis=1)
    a_rows = jnp.pad(jnp.concatenate([-2 * a, long_a], axis=1), ((0, missing), (0, 0)))
    a_rows = a_rows.reshape(-1, ROWS_AT_ONCE, a_rows.shape[1])
    b_columns = jnp.concatenate([b, long_b], axis=1).T
    columns = jnp.arange(m, dtype=jnp.int32)

    def compare(state: tuple[Array, Array, Array], rows: tuple[Array, Array]) -> tuple:
        best, back, start = state
        some, used = rows
        table = jnp.matmul(some, b_columns, precision=lax.Precision.HIGHEST)
        # The smallest number, then where it stands: two passes of vectors beat one of pairs.
        least = jnp.min(table, axis=1)
        where = jnp.min(jnp.where(table == least[:, None], columns[None], m), axis=1)
        second = jnp.min(jnp.where(columns[None] == where[:, None], jnp.inf, table), axis=1)
        table = jnp.where(used[:, None], table, jnp.inf)
        lowest = jnp.min(table, axis=0)
        row = start + jnp.arange(ROWS_AT_ONCE, dtype=jnp.int32)
        lowest_row = jnp.min(jnp.where(table == lowest[None], row[:, None], n + missing), axis=0)
        closer = lowest < best
        state = jnp.where(closer, lowest, best), jnp.where(closer, lowest_row, back), start + ROWS_AT_ONCE
        return state, (where, least, second)

    begin = jnp.full(m, jnp.inf, a.dtype), jnp.zeros(m, jnp.int32), jnp.int32(0)
    rows: Any
    (_, back, _), rows = lax.scan(compare, begin, (a_rows, usable))
    where, least, second = jax.tree.map(lambda x: x.reshape(-1)[:n], rows)
    return Nearest(jnp.minimum(where, m - 1), jnp.maximum(least, 0), jnp.maximum(second, 0), back)


def match(src: Descriptors, dst: Descriptors, *, mutual: bool = True, most: int = 5000) -> Matched:
    """Match the points of two clouds by their descriptors, the clearest matches first.

    Args:
        src, dst: Descriptors of the points of each cloud, of one kind and length; learned ones alike.
        mutual: Whether a match counts only if each is the other's nearest. Without, there are two to three
            times as many right ones, and more wrong ones.
        most: How many to return at most.

    Raises:
        ValueError: If the two are not of one length, or ``most`` is below 1.
    """
    whole_number("most", most, 1, what="how many matches to return at most")
    if src.values.shape[1:] != dst.values.shape[1:]:
        raise ValueError(
            f"the descriptors have {src.values.shape[1]} and {dst.values.shape[1]} numbers a point: "
            "expected two of one kind."
        )
    found = nearest_of(src, dst)
    return chosen(found, np.asarray(src.valid), np.asarray(dst.valid), mutual=mutual, most=most)


def nearest_of(src: Descriptors, dst: Descriptors) -> Nearest:
    """Find the nearest points of both clouds by their descriptors, in numpy.

    Clouds are filled up to few sizes, for which programs are compiled.
    """
    counts = len(src.valid), len(dst.valid)
    rows = []
    for each, count in zip((src, dst), counts, strict=True):
        missing = rows_for(count) - count
        rows.append((np.pad(each.values, ((0, missing), (0, 0))), np.pad(each.valid, (0, missing))))
    (a, valid_a), (b, valid_b) = rows
    found = jax.device_get(nearest(a, b, valid_a, valid_b))
    n, m = counts
    return Nearest(
        np.minimum(found.row[:n], m - 1),
        found.distance[:n],
        found.second[:n],
        np.minimum(found.back[:m], n - 1),
    )


def chosen(
    found: Nearest, valid_src: Bool[np.ndarray, " n"], valid_dst: Bool[np.ndarray, " m"],
    *, mutual: bool, most: int,
) -> Matched:  # fmt: skip
    """Choose matches from one table of nearest rows, the clearest first."""
    own = np.arange(len(found.row))
    usable = valid_src & valid_dst[found.row]
    if mutual:
        usable = usable & (found.back[found.row] == own)
    with np.errstate(invalid="ignore", divide="ignore"):
        ratio = np.where(found.second > 0, found.distance / found.second, 1)
    ratio = np.where(np.isfinite(ratio), ratio, 0)  # no other row at all
    rows = np.flatnonzero(usable)
    rows = rows[np.argsort(ratio[rows], kind="stable")][:most]
    return Matched(np.stack([rows, found.row[rows]], axis=1), ratio[rows])
