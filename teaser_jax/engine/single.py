"""One problem outside jit: centred and packed, then device, host, device."""

from __future__ import annotations

import jax
import numpy as np

from teaser_jax.engine.frames import centred, with_origins, without_padding
from teaser_jax.engine.packing import fetch, pack_problem, unpack, unpack_problem
from teaser_jax.engine.programs import ON_ONE_DEVICE
from teaser_jax.engine.sizes import size_of
from teaser_jax.problem import Problem, clean
from teaser_jax.rows import arrange_on_host, in_rows
from teaser_jax.settings import Settings
from teaser_jax.solution import Solution, as_asked
from teaser_jax.solve import conclude
from teaser_jax.stages.clique.maximum import finish_on_host


def solve_one(problem: Problem, settings: Settings) -> Solution:
    """Solve a problem in its own frames and rows, with a solution in float64 numpy.

    Whether JAX's 64-bit types are switched on does not matter.
    """
    rows = arrange_on_host(
        np.concatenate([problem.src.T, problem.dst.T]), problem.mask, problem.noise_bound, problem.confidence
    )
    near = centred(in_rows(problem, rows))
    sent = pack_problem(near.problem, settings, size_of(problem))
    choices = jax.tree.structure(settings)
    with jax.enable_x64(True):
        graph, clique, settled = ON_ONE_DEVICE.before(sent, choices, near.edge_dtype)
        if settings.clique.needs_host and not settled:  # to look at it is to wait for the device
            clique = finish_on_host(settings.clique, graph.edge_bits, sent.mask, clique)
        if settings.rotation.needs_host:  # step by step, with a solver on the host in between
            cleaned, excluded = clean(unpack_problem(sent))
            solution = jax.device_get(conclude(cleaned, excluded, graph, clique, settings))
        else:
            solution = unpack(fetch(ON_ONE_DEVICE.after(sent, graph, clique, choices)))
    found = without_padding(with_origins(solution, near.src_origin, near.dst_origin), problem)
    return as_asked(found, rows, has_pairs=problem.pairs is not None)
