"""One problem outside jit: centred and packed, then device, host, device."""

from __future__ import annotations

import jax

from teaser_jax.engine.frames import centred_one, with_origins, without_padding
from teaser_jax.engine.packing import fetch, pack_problem, unpack, unpack_problem
from teaser_jax.engine.programs import ON_ONE_DEVICE
from teaser_jax.engine.sizes import size_of
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.problem import Problem, clean
from teaser_jax.settings import Settings
from teaser_jax.solution import Solution
from teaser_jax.solve import conclude
from teaser_jax.stages.clique.maximum import finish_on_host


def solve_one(problem: Problem, settings: Settings) -> Solution:
    """Solve a problem in its own frames and rows, with a solution in float64 numpy.

    Whether JAX's 64-bit types are switched on does not matter.
    """
    near = centred_one(pack_problem(problem, settings, size_of(problem)))
    choices = jax.tree.structure(settings)
    with as_on_the_host():
        graph, clique, settled = ON_ONE_DEVICE.before(near.sent, choices, near.edge_dtype)
        if settings.clique.needs_host and not settled:  # to look at it is to wait for the device
            clique = finish_on_host(settings.clique, graph.edge_bits, graph.mask, clique)
        if settings.rotation.needs_host:  # step by step, with a solver on the host in between
            cleaned, excluded = clean(unpack_problem(near.sent))
            solution = jax.device_get(
                conclude(cleaned, excluded, graph, clique, settings, offset=near.sent.offset)
            )
        else:
            solution = unpack(fetch(ON_ONE_DEVICE.after(near.sent, graph, clique, choices)))
    return with_origins(without_padding(solution, problem), near.origins)
