"""A clique by any method: device first, then the host where something is left; also inside jit."""

from __future__ import annotations

import jax
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, UInt32

from teaser_jax.ground.arrays import AnyArray
from teaser_jax.stages.clique.clique import Clique, CliqueMethod
from teaser_jax.stages.clique.exact import ExactClique


def maximum_clique(
    edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"], method: CliqueMethod = ExactClique()
) -> Clique:
    """Find a clique of a consistency graph by a method, with a proved bound on every clique.

    A method that needs the host is called back, once for a whole batch under ``vmap``, and only where
    the device leaves something to search for. Works under jit, vmap and scan on one device.

    Gradients: none.
    """
    found = search_on_device(method, edge_bits, mask)
    if not method.needs_host or mask.shape[0] == 0:
        return found
    shapes = Clique(jax.ShapeDtypeStruct(mask.shape, np.bool_), jax.ShapeDtypeStruct((), np.int32))

    def ask_host() -> Clique:
        return jax.pure_callback(
            finish_on_host, shapes, method, edge_bits, mask, found, vmap_method="broadcast_all"
        )

    return lax.cond(method.is_settled(found), lambda: found, ask_host)


def search_on_device(
    method: CliqueMethod, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]
) -> Clique:
    """Find a clique by a method as far as the device goes, with its bound."""
    return method.on_device(edge_bits, mask)


def finish_on_host(
    method: CliqueMethod, edge_bits: UInt32[AnyArray, "*batch n w"], mask: Bool[AnyArray, "*batch n"],
    found: Clique,
) -> Clique:  # fmt: skip
    """Search the graphs that the device has not settled, one after the other, in numpy.

    Args:
        method: Whose numbers may have the axes of the batch.
        edge_bits, mask: The graphs, with any axes in front.
        found: What the device has found, with the same axes.
    """
    members, upper_bound = np.array(found.members), np.array(found.upper_bound, np.int32)
    edge_bits, mask = np.asarray(edge_bits), np.asarray(mask)
    unsettled = ~np.asarray(method.is_settled(Clique(members, upper_bound)))
    for item in map(tuple, np.argwhere(unsettled)):
        one = jax.tree.map(lambda x, item=item: np.asarray(x)[item] if np.ndim(x) else x, method)
        start = Clique(members[item], upper_bound[item])
        members[item], upper_bound[item] = one.on_host(edge_bits[item], mask[item], start)
    return Clique(members, upper_bound)
