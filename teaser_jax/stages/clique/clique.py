"""What every method of this room returns, and what it must be able to do."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Int, UInt32

from teaser_jax.ground.arrays import AnyArray


class Clique(NamedTuple):
    """Members of a clique, and a proved bound on the size of every clique.

    Attributes:
        members: The matches in it.
        upper_bound: No clique of the graph is larger: proved.
    """

    members: Bool[AnyArray, "*batch n"]
    upper_bound: Int[AnyArray, "*batch"]

    @property
    def proved(self) -> Bool[AnyArray, "*batch"]:
        """Whether it is proved that no clique is larger."""
        return self.members.sum(axis=-1, dtype=np.int32) >= self.upper_bound


@runtime_checkable
class CliqueMethod(Protocol):
    """A way to prune wrong matches. Its record holds its numbers, with their defaults.

    Attributes:
        needs_host: Whether a search on the host may have to follow the device.
        prunes: Whether it finds a clique at all.
    """

    needs_host: ClassVar[bool]
    prunes: ClassVar[bool]

    def on_device(self, edge_bits: UInt32[Array, "n w"], mask: Bool[Array, " n"]) -> Clique:
        """Find a clique, as far as the device goes; works under jit and vmap."""

    def is_settled(self, found: Clique) -> Bool[AnyArray, "*batch"]:
        """Tell whether what the device has found leaves nothing to search for on the host."""

    def on_host(
        self, edge_bits: UInt32[np.ndarray, "n w"], mask: Bool[np.ndarray, " n"], found: Clique
    ) -> Clique:
        """Finish one graph on the host, from what the device has found."""
