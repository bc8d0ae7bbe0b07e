"""Certificates of many problems: the closed form for all at once, the splitting one by one where it fails.

A stack of splittings in step with each other goes on until the slowest one ends, and eigenvectors, which are
their work, are computed one matrix after the other all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import (
    QUICKLY,
    Rows,
    at_once,
    certify_rows,
    closed_form,
    cut,
    go_on,
    padded,
    with_blocks,
)
from teaser_jax.certify.proof import CertifyMethod

CHUNK_BYTES = 256 << 20  # of the matrices of the closed form; some eight of each live at once


def certify_stack(
    items: Sequence[Rows],
    rotations: np.ndarray,
    tolerance: float,
    *,
    iterations: int,
    method: CertifyMethod,
    most: int,
) -> Certificate:
    """A certificate for each item, with a leading axis; those too large or published go one by one."""
    found: dict[int, Certificate] = {}
    together = [i for i, rows in enumerate(items) if method != "reference" and rows.mask.sum() <= most]
    # In fours: a sixth more rows is a half more time.
    size = 4 * -(-max([int(items[i].mask.sum()) for i in together], default=4) // 4)
    step = max(1, CHUNK_BYTES // (8 * (4 * size + 4) ** 2))
    for start in range(0, len(together), step):
        chunk = np.array(together[start : start + step])
        several = at_once(partial(_chunk, items, rotations, chunk, size, tolerance, iterations, method))
        found |= dict(zip(chunk.tolist(), several, strict=True))
    for i in set(range(len(items))) - found.keys():
        found[i] = certify_rows(
            items[i], rotations[i], tolerance, iterations=iterations, method=method, most=most
        )
    n = max((len(c.dual.skew) for c in found.values()), default=1)
    return jax.tree.map(lambda *x: np.stack(x), *(with_blocks(found[i], n) for i in range(len(items))))


def _chunk(
    items: Sequence[Rows], rotations: np.ndarray, chunk: np.ndarray, size: int,
    tolerance: float, iterations: int, method: CertifyMethod,
) -> list[Certificate]:  # fmt: skip
    # Filled up to a power of two, so that few sizes are compiled.
    places = np.minimum(np.arange(1 << (len(chunk) - 1).bit_length()), len(chunk) - 1)
    rows = jax.tree.map(lambda *x: np.stack(x), *(padded(cut(items[chunk[i]]), size) for i in places))
    found, settled, hopeful, states = jax.device_get(
        _closed_forms(rows, rotations[chunk[places]], np.float64(tolerance))
    )

    def one(i: int) -> Certificate:
        if settled[i]:
            return jax.tree.map(lambda x: x[i], found)
        state = jax.tree.map(lambda x: x[i], states)
        return jax.device_get(go_on(state, hopeful=hopeful[i], iterations=iterations, method=method))

    return [one(i) for i in range(len(chunk))]


@partial(jax.jit, compiler_options=QUICKLY)
def _closed_forms(rows: Rows, rotations: Array, tolerance: Array) -> Any:
    return jax.vmap(lambda rows, rotation: closed_form(rows, rotation, tolerance))(rows, rotations)
