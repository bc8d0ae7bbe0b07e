"""The two device programs of a batch, sharded over a mesh: to the clique bounds, and from the cliques on."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Int

from teaser_jax.batch.groups import Size
from teaser_jax.compilation import UNTIMED_KERNELS, WHOLE_SUMS, WIDE_VECTORS
from teaser_jax.packing import PackedProblem
from teaser_jax.register import since_clique, until_clique
from teaser_jax.types import Settings

AXIS = "problems"
# What one device solves side by side: more brings little on a CPU, and holds up all for the slowest. Large
# problems fill the machine by themselves, and are solved one after the other in a run.
MOST, ROWS = 256, 16384
ALONE, MOST_IN_TURN, ROWS_IN_TURN = 512, 8, 8192
MOST_ON_ACCELERATOR = 4096
MEMORY = 1 << 30  # bytes a device may hold for the problems of one run


class Programs(NamedTuple):
    """Compiled for one mesh and one set of choices; sizes compile once each."""

    before: Callable[..., Any]
    after: Callable[..., Any]
    sharding: NamedSharding


def platform(mesh: Mesh) -> str:
    """What kind of devices a mesh has: "cpu", "gpu", ..."""
    return mesh.devices.flat[0].platform


def unit(size: Size, kind: str) -> int:
    """How many problems of a size one device solves in one run: the same whatever the chunks."""
    if kind == "cpu":
        beside = min(MOST, ROWS // size.n)
        return beside if size.n < ALONE else max(1, min(MOST_IN_TURN, ROWS_IN_TURN // size.n))
    numbers = size.n * (size.n // 2 if size.n <= ALONE else size.n // 8) * 8
    return max(1, min(MOST_ON_ACCELERATOR, MEMORY // max(1, numbers)))


# Rows for the members of a clique: what follows takes as long as there are rows, and each room is a program
# of its own. Rooms beyond half of a problem save too little, below a sixteenth too rare.
ROOMS = (16, 32, 64, 256, 1024, 4096)
NO_ROOM = 0  # all rows


def rooms(size: Size, settings: Settings, members: Int[np.ndarray, " b"]) -> Int[np.ndarray, " b"]:
    """The smallest room for each clique: a matter of the problem alone, as its last bits depend on it."""
    if size.m is not None or settings.tim_graph != "chain" or settings.clique == "none":
        return np.full(len(members), NO_ROOM)
    offered = np.array([room for room in ROOMS if size.n <= 16 * room and 2 * room <= size.n])
    return np.append(offered, NO_ROOM)[np.searchsorted(offered, members)]


@lru_cache(maxsize=64)
def programs(choices: Settings, mesh: Mesh) -> Programs:
    """Both programs on a mesh of one axis; no device waits for another."""
    across = PartitionSpec(AXIS)
    sharding = NamedSharding(mesh, across)
    on_cpu, on_gpu = (platform(mesh) == kind for kind in ("cpu", "gpu"))

    def sharded(one: Callable[..., Any], *args: Any) -> Any:
        # The loops of one shard end when its own problems are done: sharded arrays under plain jit would wait
        # for each other in every round.
        in_turn = on_cpu and args[0].columns.shape[-1] >= ALONE
        all_of = partial(jax.lax.map, lambda each: one(*each)) if in_turn else lambda x: jax.vmap(one)(*x)
        return jax.shard_map(all_of, mesh=mesh, in_specs=across, out_specs=across, check_vma=False)(args)

    def before(sent: PackedProblem, narrow: bool) -> Any:
        dtype = np.float32 if narrow else np.float64
        return sharded(lambda one: until_clique(one, choices, dtype), sent)

    def after(sent: PackedProblem, graph: Any, clique: Any, room: int) -> Any:
        return sharded(lambda s, g, c: since_clique(s, g, c, choices, room or None), sent, graph, clique)

    options = WHOLE_SUMS | WIDE_VECTORS if on_cpu else UNTIMED_KERNELS if on_gpu else {}
    return Programs(
        jax.jit(before, static_argnames="narrow", compiler_options=options),
        jax.jit(after, static_argnames="room", compiler_options=options),
        sharding,
    )
