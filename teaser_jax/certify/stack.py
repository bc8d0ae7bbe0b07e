"""Certificates of many problems: the closed form for all at once, the splitting one by one where it fails.

A stack of splittings in step with each other goes on until the slowest one ends, and eigenvectors, which are
their work, are computed one matrix after the other all the same.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from teaser_jax.certify.certificate import Certificate
from teaser_jax.certify.host import (
    QUICKLY,
    ClosedForm,
    after_closed_form,
    certify_on_host,
    closed_form,
    in_float64,
    with_blocks,
)
from teaser_jax.certify.host_measurements import HostMeasurements, padded, without_padding
from teaser_jax.certify.options import Options

CHUNK_BYTES = 256 << 20  # of the matrices of the closed form; some eight of each live at once


def certify_stack(
    items: Sequence[HostMeasurements],
    rotations: Float[np.ndarray, "b 3 3"],
    options: Options,
    *,
    rounds: int,
) -> Certificate:
    """Certify each item of a stack, and return the certificates as one with a leading axis.

    Items that are too large go one by one, and so do all where the method is the published one.
    """
    found: dict[int, Certificate] = {}
    alike = options.method != "reference"
    together = [i for i, item in enumerate(items) if alike and item.measured <= options.max_measurements]
    # In fours: a sixth more rows is a half more time.
    size = 4 * -(-max([items[i].measured for i in together], default=4) // 4)
    step = max(1, CHUNK_BYTES // (8 * (4 * size + 4) ** 2))
    for start in range(0, len(together), step):
        chunk = np.array(together[start : start + step])
        several = in_float64(partial(_chunk, items, rotations, chunk, size, options, rounds))
        found |= dict(zip(chunk.tolist(), several, strict=True))
    for i in set(range(len(items))) - found.keys():
        found[i] = certify_on_host(items[i], rotations[i], options, rounds=rounds)
    n = max((len(c.dual.skew) for c in found.values()), default=1)
    return jax.tree.map(lambda *x: np.stack(x), *(with_blocks(found[i], n) for i in range(len(items))))


def _chunk(
    items: Sequence[HostMeasurements],
    rotations: Float[np.ndarray, "b 3 3"],
    chunk: Int[np.ndarray, " c"],
    size: int,
    options: Options,
    rounds: int,
) -> list[Certificate]:
    """Certify the items of a chunk: the closed form at once, what it leaves one by one."""
    # Filled up to a power of two, so that few sizes are compiled.
    places = np.minimum(np.arange(1 << (len(chunk) - 1).bit_length()), len(chunk) - 1)
    several = jax.tree.map(
        lambda *x: np.stack(x), *(padded(without_padding(items[chunk[i]]), size) for i in places)
    )
    found = jax.device_get(_closed_forms(several, rotations[chunk[places]], np.float64(options.tolerance)))

    def one(i: int) -> Certificate:
        if found.settled[i]:
            return jax.tree.map(lambda x: x[i], found.certificate)
        pending = jax.tree.map(lambda x: x[i], found.pending)
        return jax.device_get(
            after_closed_form(pending, hopeful=found.hopeful[i], rounds=rounds, method=options.method)
        )

    return [one(i) for i in range(len(chunk))]


@partial(jax.jit, compiler_options=QUICKLY)
def _closed_forms(
    several: HostMeasurements, rotations: Float[Array, "c 3 3"], tolerance: Float[Array, ""]
) -> ClosedForm:
    """Try the closed form on all items of a chunk at once."""
    return jax.vmap(lambda item, rotation: closed_form(item, rotation, tolerance))(several, rotations)
