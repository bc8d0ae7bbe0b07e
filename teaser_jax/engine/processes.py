"""A batch over several processes: each solves its share, and all receive everything."""

from __future__ import annotations

import hashlib
import pickle
from typing import Any

import jax
import numpy as np
from jax.sharding import AxisType, Mesh

from teaser_jax.engine.programs import AXIS


def local_mesh(mesh: Mesh | None) -> Mesh | None:
    """Make a mesh of one axis of the devices of this process; None if it has none.

    Args:
        mesh: The devices of all processes to choose from; None: all there are.
    """
    devices = list(jax.devices() if mesh is None else mesh.devices.flat)
    mine = [d for d in devices if d.process_index == jax.process_index()]
    return Mesh(np.array(mine), (AXIS,), axis_types=(AxisType.Auto,)) if mine else None


def share(count: int, mesh: Mesh | None) -> slice:
    """Tell which of so many problems this process solves: a piece in proportion to its devices."""
    devices = list(jax.devices() if mesh is None else mesh.devices.flat)
    before = sum(d.process_index < jax.process_index() for d in devices)
    mine = sum(d.process_index == jax.process_index() for d in devices)
    return slice(count * before // len(devices), count * (before + mine) // len(devices))


def check_agreement(function: str, given: Any, *, error: type[ValueError] = ValueError) -> None:
    """Raise an error in every process unless all called a function with the same numbers and words.

    Args:
        function: Its name, for the error.
        given: What it was called with.
        error: The kind of error to raise.
    """
    if jax.process_count() == 1:
        return
    digest = hashlib.sha256()
    leaves, form = jax.tree.flatten(given)
    digest.update(str(form).encode())
    for leaf in leaves:
        # The words for an array leave numbers out; its bytes do not.
        is_array = isinstance(leaf, np.ndarray)
        digest.update((f"{leaf.dtype}{leaf.shape}" if is_array else repr(leaf)).encode())
        digest.update(leaf.tobytes() if is_array else b"")
    if len({*all_of(digest.hexdigest())}) > 1:
        raise error(
            f"the processes called {function} with different arguments: each must call with the same ones."
        )


def all_of(mine: Any) -> list[Any]:
    """Gather what every process has, in their order. All processes must call this function."""
    if jax.process_count() == 1:
        return [mine]
    from jax.experimental.multihost_utils import process_allgather

    sent = np.frombuffer(pickle.dumps(mine), np.uint8)
    lengths = process_allgather(np.array([len(sent)], np.int32)).reshape(-1)
    padded = np.zeros(lengths.max(), np.uint8)
    padded[: len(sent)] = sent
    gathered = process_allgather(padded).reshape(len(lengths), -1)
    return [pickle.loads(each[:n].tobytes()) for each, n in zip(gathered, lengths, strict=True)]
