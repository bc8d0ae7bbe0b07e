"""Who agrees with whom: what is known before the clique.

The problem is put into its rows, the scale is found, and with it the width of the bounds and the consistency
graph.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, UInt32

from teaser_jax.ground.steps import Run, plainly
from teaser_jax.problem import Problem
from teaser_jax.refit import widened
from teaser_jax.rows import Rows, arrange, in_rows
from teaser_jax.settings import Settings
from teaser_jax.stages.consistency import consistency_graph
from teaser_jax.stages.one_to_one import OneToOne, one_to_one_graph
from teaser_jax.stages.scale import ScalePairs, estimate_scale
from teaser_jax.stages.widening import bound_widening


class Graph(NamedTuple):
    """What is known before the clique: where the rows are, and which; the scale; the bounds; who agrees.

    Where matches crowd at a point, those of one point do not; ``further`` bounds what they may add.
    """

    rows: Rows
    mask: Bool[Array, " n"]
    scale: Float[Array, ""]
    scale_pairs: ScalePairs | None
    widening: Float[Array, ""]
    edge_bits: UInt32[Array, "n w"]
    further: Float[Array, " n"]


def prepare(
    p: Problem, settings: Settings, *, edge_dtype: Any = None, edges: Run | None = None, run: Run = plainly
) -> Graph:
    """Find the scale and the consistency graph of a clean problem.

    Args:
        p: Clean.
        settings: How to solve.
        edge_dtype: The type in which edges are tested; None: that of the problem.
        edges: Finds who agrees with whom; None: ``find_edges``.
        run: Runs each stage.
    """
    rows = run("rows", arrange, p)
    near = in_rows(p if edge_dtype is None else in_precision(p, edge_dtype), rows)
    scale, scale_pairs = run("scale", find_scale, near, settings)
    widening = run("widening", find_widening, near, scale, settings)
    found = run("consistency graph", edges or find_edges, widened(near, widening), scale)
    dtype = p.src.dtype
    exact = scale.astype(dtype) if p.scale is None else p.scale
    return Graph(rows, near.mask, exact, scale_pairs, widening.astype(dtype), *found)


def in_precision(p: Problem, dtype: Any) -> Problem:
    """Give all numbers of a problem a type."""
    return jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, p)


def find_scale(p: Problem, settings: Settings) -> tuple[Float[Array, ""], ScalePairs | None]:
    """Return the known scale, or find it by the vote (11), with the pairs that agree with it."""
    if p.scale is not None:
        return p.scale, None
    return estimate_scale(
        p.src, p.dst, p.noise_bound, p.mask,
        cbar2=p.cbar2, pairs=p.pairs, criterion=settings.vote, scale_range=settings.scale_search.range,
    )  # fmt: skip


def find_widening(p: Problem, scale: Float[Array, ""], settings: Settings) -> Float[Array, ""]:
    """Find by how much bounds are wider than asked for; the plain cascade takes them as they are."""
    if settings.refine is None:
        return jnp.ones_like(p.cbar2)
    return bound_widening(
        p.src, p.dst, p.noise_bound, p.mask, scale=scale, cbar2=p.cbar2, pairs=p.pairs
    )  # fmt: skip


def find_edges(p: Problem, scale: Float[Array, ""]) -> OneToOne:
    """Find who agrees with whom at a scale."""
    if p.pairs is None:
        return one_to_one_graph(p.src, p.dst, p.noise_bound, p.mask, scale=scale, cbar2=p.cbar2)
    edges = consistency_graph(
        p.src, p.dst, p.noise_bound, p.mask, scale=scale, cbar2=p.cbar2, pairs=p.pairs
    )  # fmt: skip
    return OneToOne(edges, jnp.zeros(p.mask.shape, jnp.float32))  # pairs that nobody names exclude nothing
