"""Who agrees with whom: what is known before the clique.

The problem is put into its rows, the scale is found, and with it the width of the bounds and the consistency
graph.
"""

from __future__ import annotations

from typing import Any, NamedTuple

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


def prepare(p: Problem, settings: Settings, *, edge_dtype: Any = None, run: Run = plainly) -> Graph:
    """Find the scale and the consistency graph of a clean problem; edges are tested in ``edge_dtype``."""
    rows = run("rows", arrange, p)
    p = in_rows(p, rows)
    scale, scale_pairs = run("scale", find_scale, p, settings)
    widening = run("widening", find_widening, p, scale, settings, dtype=edge_dtype)
    edges = run("consistency graph", find_edges, widened(p, widening), scale, dtype=edge_dtype)
    return Graph(rows, p.mask, scale, scale_pairs, widening, *edges)


def find_scale(p: Problem, settings: Settings) -> tuple[Float[Array, ""], ScalePairs | None]:
    """Return the known scale, or find it by the vote (11), with the pairs that agree with it."""
    if p.scale is not None:
        return p.scale, None
    return estimate_scale(
        p.src, p.dst, p.noise_bound, p.mask,
        cbar2=p.cbar2, pairs=p.pairs, criterion=settings.vote, scale_range=settings.scale_search.range,
    )  # fmt: skip


def find_widening(
    p: Problem, scale: Float[Array, ""], settings: Settings, *, dtype: Any = None
) -> Float[Array, ""]:
    """Find by how much bounds are wider than asked for; the plain cascade takes them as they are."""
    if settings.refine is None:
        return jnp.ones_like(p.cbar2)
    src, dst, noise_bound, scale, cbar2 = _as(dtype, p.src, p.dst, p.noise_bound, scale, p.cbar2)
    wide = bound_widening(src, dst, noise_bound, p.mask, scale=scale, cbar2=cbar2, pairs=p.pairs)
    return wide.astype(p.src.dtype)


def find_edges(p: Problem, scale: Float[Array, ""], *, dtype: Any = None) -> OneToOne:
    """Find who agrees with whom at a scale, tested in ``dtype`` (None: that of the problem)."""
    src, dst, noise_bound, scale, cbar2 = _as(dtype, p.src, p.dst, p.noise_bound, scale, p.cbar2)
    if p.pairs is None:
        return one_to_one_graph(src, dst, noise_bound, p.mask, scale=scale, cbar2=cbar2)
    edges = consistency_graph(src, dst, noise_bound, p.mask, scale=scale, cbar2=cbar2, pairs=p.pairs)
    return OneToOne(edges, jnp.zeros(p.mask.shape, jnp.float32))  # pairs that nobody names exclude nothing


def _as(dtype: Any, *arrays: Array) -> list[Array]:
    """Give arrays a type; None: that of the first."""
    return [x.astype(dtype or arrays[0].dtype) for x in arrays]
