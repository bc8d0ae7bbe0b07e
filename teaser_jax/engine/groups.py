"""Problems of all sizes, sorted into groups that share a compiled program."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Int

from teaser_jax.engine.packing import PackedProblem, pack_problem
from teaser_jax.engine.sizes import Size, size_of
from teaser_jax.problem import Problem
from teaser_jax.settings import Settings


def by_size(problems: Sequence[Problem]) -> dict[Size, Int[np.ndarray, "_"]]:
    """List the places of the problems of each size, in the user's order."""
    places: dict[Size, list[int]] = {}
    for k, problem in enumerate(problems):
        places.setdefault(size_of(problem), []).append(k)
    return {size: np.array(each) for size, each in places.items()}


def pack_list(problems: Sequence[Problem], settings: Settings, size: Size) -> PackedProblem:
    """Pack problems of one size as one batch on the host; those of as many rows are packed together."""
    whole: Any = None
    for rows in by_shape(problems).values():
        alike = [problems[k] for k in rows]
        packed = pack_problem(jax.tree.map(lambda *x: np.stack(x), *alike), settings, size)
        if len(rows) == len(problems):
            return packed
        if whole is None:
            whole = jax.tree.map(lambda x: np.empty((len(problems), *x.shape[1:]), x.dtype), packed)
        for into, part in zip(jax.tree.leaves(whole), jax.tree.leaves(packed), strict=True):
            into[rows] = part
    return whole


def by_shape(problems: Sequence[Problem]) -> dict[tuple[int, int | None], list[int]]:
    """List the places of the problems of each number of rows and of pairs."""
    places: dict[tuple[int, int | None], list[int]] = {}
    for k, problem in enumerate(problems):
        m = None if problem.pairs is None else problem.pairs.shape[0]
        places.setdefault((problem.src.shape[0], m), []).append(k)
    return places
