"""The two device programs: up to the clique, and from the clique on. The host's search lies between them.

Each takes one problem. ``ON_ONE_DEVICE`` compiles them for ``register``; ``on_mesh`` maps them over the
problems of a batch, on any devices.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool

from teaser_jax.agreement import Graph, prepare
from teaser_jax.engine.compaction import ALL_ROWS, cascade_in
from teaser_jax.engine.compiler import OLDER_EMITTERS, UNTIMED_KERNELS, WHOLE_SUMS, WIDE_VECTORS
from teaser_jax.engine.packing import Packed, PackedProblem, pack, unpack_problem, unpack_settings
from teaser_jax.engine.sizes import Size
from teaser_jax.problem import clean
from teaser_jax.solve import conclude
from teaser_jax.stages.clique.clique import Clique

AXIS = "problems"
# What one device solves side by side: more brings little on a CPU, and holds up all for the slowest. Large
# problems fill the machine by themselves, and are solved one after the other in a run.
MOST, MOST_ROWS = 256, 16384
LARGE, MOST_IN_TURN, ROWS_IN_TURN = 512, 8, 8192
MOST_ON_ACCELERATOR = 4096
MEMORY = 1 << 30  # bytes a device may hold for the problems of one run


def before_search(
    sent: PackedProblem, choices: Any, edge_dtype: Any
) -> tuple[Graph, Clique, Bool[Array, ""]]:
    """Run the first program: scale, graph, and the clique as far as the device takes it.

    Args:
        sent: The problem and the numbers of its settings.
        choices: The structure of the settings; static.
        edge_dtype: The type in which edges are tested; static.

    Returns:
        The graph, the clique, and whether that leaves nothing to search for on the host.
    """
    settings = unpack_settings(sent, choices)
    problem, _ = clean(unpack_problem(sent))
    graph = prepare(problem, settings, edge_dtype=edge_dtype)
    found = settings.clique.on_device(graph.edge_bits, graph.mask)
    return graph, found, settings.clique.is_settled(found)


def after_search(
    sent: PackedProblem, graph: Graph, clique: Clique, choices: Any, few: int = ALL_ROWS
) -> Packed:
    """Run the second program: the sets, the pose, the verdict.

    Args:
        sent, choices: As for the first program.
        graph, clique: What the first program and the host have found.
        few: In how many rows rotation and translation are found; static.
    """
    settings = unpack_settings(sent, choices)
    problem, excluded = clean(unpack_problem(sent))
    return pack(
        conclude(problem, excluded, graph, clique, settings, offset=sent.offset, cascade=cascade_in(few))
    )


class Programs(NamedTuple):
    """Both device programs, compiled when called: once for each size, type of edges and number of rows."""

    before: Callable[..., Any]
    after: Callable[..., Any]


ON_ONE_DEVICE = Programs(
    jax.jit(
        before_search,
        static_argnames=("choices", "edge_dtype"),
        compiler_options=WHOLE_SUMS | WIDE_VECTORS,
    ),
    jax.jit(after_search, static_argnames=("choices", "few"), compiler_options=WHOLE_SUMS | OLDER_EMITTERS),
)


def device_kind(mesh: Mesh) -> str:
    """Name the kind of devices that a mesh has: "cpu", "gpu", ..."""
    return mesh.devices.flat[0].platform


def run_length(size: Size, kind: str) -> int:
    """Count the problems of a size that one device solves in one run: the same whatever the chunks."""
    n = size.matches
    if kind == "cpu":
        beside = min(MOST, MOST_ROWS // n)
        return beside if n < LARGE else max(1, min(MOST_IN_TURN, ROWS_IN_TURN // n))
    numbers = n * (n // 2 if n <= LARGE else n // 8) * 8
    return max(1, min(MOST_ON_ACCELERATOR, MEMORY // max(1, numbers)))


def sharding_over(mesh: Mesh) -> NamedSharding:
    """Lay the problems of a batch over a mesh of one axis: a share on each device."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


@lru_cache(maxsize=64)
def on_mesh(choices: Any, mesh: Mesh) -> Programs:
    """Make both programs over the problems of a batch, on a mesh of one axis; no device waits for another.

    Args:
        choices: The structure of the settings.
        mesh: The devices.
    """
    across = PartitionSpec(AXIS)
    on_cpu, on_gpu = (device_kind(mesh) == kind for kind in ("cpu", "gpu"))

    def sharded(one: Callable[..., Any], *args: Any) -> Any:
        # The loops of one shard end when its own problems are done: sharded arrays under plain jit would wait
        # for each other in every round.
        in_turn = on_cpu and args[0].columns.shape[-1] >= LARGE
        all_of = partial(jax.lax.map, lambda each: one(*each)) if in_turn else lambda x: jax.vmap(one)(*x)
        return jax.shard_map(all_of, mesh=mesh, in_specs=across, out_specs=across, check_vma=False)(args)

    def before(sent: PackedProblem, narrow: bool) -> Any:
        dtype = np.float32 if narrow else np.float64
        return sharded(lambda one: before_search(one, choices, dtype), sent)

    def after(sent: PackedProblem, graph: Graph, clique: Clique, few: int) -> Any:
        return sharded(lambda s, g, c: after_search(s, g, c, choices, few), sent, graph, clique)

    options = WHOLE_SUMS | WIDE_VECTORS if on_cpu else UNTIMED_KERNELS if on_gpu else {}
    return Programs(
        jax.jit(before, static_argnames="narrow", compiler_options=options),
        jax.jit(after, static_argnames="few", compiler_options=options),
    )
