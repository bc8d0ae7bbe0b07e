"""The two device programs of a batch, sharded over a mesh: to the clique bounds, and from the cliques on."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from teaser_jax.batch.groups import Size
from teaser_jax.compilation import OLDER_EMITTERS, WHOLE_SUMS, WIDE_VECTORS
from teaser_jax.packing import PackedProblem
from teaser_jax.register import since_clique, until_clique
from teaser_jax.types import Settings

AXIS = "problems"
# Problems that one device solves side by side. More of them bring nothing on a CPU, and hold up all for the
# slowest; large ones fill the machine by themselves, and wait for nobody when they run alone.
MOST, ALONE = 64, 512
MOST_ON_ACCELERATOR = 4096
MEMORY = 1 << 30  # bytes a device may hold for the problems of one run


class Programs(NamedTuple):
    """Compiled for one mesh and one set of choices; sizes compile once each."""

    before: Callable[..., Any]
    after: Callable[..., Any]
    sharding: NamedSharding


def unit(size: Size, device: Any) -> int:
    """How many problems of a size one device solves in one run: the same whatever the chunks."""
    if device.platform == "cpu":
        return 1 if size.n >= ALONE else MOST
    numbers = size.n * (size.n // 2 if size.n <= ALONE else size.n // 8) * 8
    return max(1, min(MOST_ON_ACCELERATOR, MEMORY // max(1, numbers)))


@lru_cache(maxsize=64)
def programs(choices: Settings, mesh: Mesh) -> Programs:
    """Both programs on a mesh of one axis; no device waits for another."""
    across = PartitionSpec(AXIS)
    sharding = NamedSharding(mesh, across)

    def sharded(one: Callable[..., Any]) -> Callable[..., Any]:
        # The loops of one shard end when its own problems are done: sharded arrays under plain jit would wait
        # for each other in every round.
        return jax.shard_map(jax.vmap(one), mesh=mesh, in_specs=across, out_specs=across, check_vma=False)

    def before(sent: PackedProblem, narrow: bool) -> Any:
        dtype = np.float32 if narrow else np.float64
        return sharded(lambda one: until_clique(one, choices, dtype))(sent)

    def after(sent: PackedProblem, graph: Any, clique: Any) -> Any:
        return sharded(lambda s, g, c: since_clique(s, g, c, choices))(sent, graph, clique)

    on_cpu = mesh.devices.flat[0].platform == "cpu"
    options = (WHOLE_SUMS | WIDE_VECTORS, WHOLE_SUMS | OLDER_EMITTERS) if on_cpu else ({}, {})
    return Programs(
        jax.jit(before, static_argnames="narrow", compiler_options=options[0]),
        jax.jit(after, compiler_options=options[1]),
        sharding,
    )
