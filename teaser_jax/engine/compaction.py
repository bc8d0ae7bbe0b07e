"""Rotation and translation in the rows of the clique alone: what follows takes as long as there are rows."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from teaser_jax.cascade import Cascade, find_cascade
from teaser_jax.engine.sizes import Size
from teaser_jax.ground import bits
from teaser_jax.ground.steps import Run
from teaser_jax.problem import Problem
from teaser_jax.settings import Settings

# Each number of rows is a program of its own. More than half of a problem saves too little, and less than a
# sixteenth is too rare.
FEW_ROWS = (16, 32, 64, 256, 1024, 4096)
ALL_ROWS = 0


def rows_for(size: Size, settings: Settings, members: Int[np.ndarray, " b"]) -> Int[np.ndarray, " b"]:
    """Find the smallest number of rows that holds each clique.

    The number is a matter of the problem alone, as the last bits of the answer depend on it.

    Args:
        size: What the programs are compiled for.
        settings: How to solve; complete graphs of TIMs and missing cliques need all rows.
        members: The size of each clique.
    """
    if size.pairs is not None or settings.tim_graph != "chain" or not settings.clique.prunes:
        return np.full(len(members), ALL_ROWS)
    n = size.matches
    offered = np.array([rows for rows in FEW_ROWS if n <= 16 * rows and 2 * rows <= n])
    return np.append(offered, ALL_ROWS)[np.searchsorted(offered, members)]


def cascade_in(rows: int) -> Any:
    """Make the cascade in so many rows instead of all; they must hold the clique, and TIMs be a chain."""
    if rows == ALL_ROWS:
        return find_cascade

    def compact_cascade(
        p: Problem, scale: Float[Array, ""], members: Bool[Array, " n"], settings: Settings, run: Run
    ) -> Cascade:
        chosen = bits.listed(members)[:rows]
        present = jnp.arange(rows, dtype=jnp.int32) < jnp.sum(members, dtype=jnp.int32)
        few = replace(
            p,
            src=p.src[chosen],
            dst=p.dst[chosen],
            noise_bound=p.noise_bound[chosen],
            mask=present,
            confidence=p.confidence[chosen],
        )
        found = find_cascade(few, scale, present, settings, run)
        n = members.shape[0]
        place = jnp.where(present, chosen, n)
        tims, axes = (
            jnp.zeros((n, *x.shape[1:]), bool).at[place].set(x, mode="drop") for x in (found.tims, found.axes)
        )
        return found._replace(tims=tims, axes=axes)

    return compact_cascade
