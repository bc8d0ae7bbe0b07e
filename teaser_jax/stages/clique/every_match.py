"""No pruning: all usable matches go on."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, UInt32

from teaser_jax.ground.arrays import AnyArray, namespace
from teaser_jax.ground.numbers import named
from teaser_jax.stages.clique.clique import Clique


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class EveryMatch:
    """Take all usable matches instead of a clique; nothing is proved of them."""

    name: str = named("none")
    needs_host: ClassVar[bool] = False
    prunes: ClassVar[bool] = False

    def on_device(self, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
        """Take all usable matches."""
        return Clique(mask, jnp.sum(mask, dtype=jnp.int32))

    def is_settled(self, found: Clique) -> Bool[AnyArray, "*batch"]:
        """Return True for every graph: there is nothing to search for."""
        return namespace(found.upper_bound).ones_like(found.upper_bound, dtype=bool)

    def on_host(
        self, edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"], found: Clique
    ) -> Clique:
        """Return what the device has found."""
        return found
