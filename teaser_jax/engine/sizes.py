"""The padded sizes that programs are compiled for, so that a stream of problems needs few of them."""

from __future__ import annotations

from typing import NamedTuple

from teaser_jax.problem import Problem

SMALLEST = 32


class Size(NamedTuple):
    """What a program is compiled for: padded matches and pairs, and whether the scale is known."""

    matches: int
    pairs: int | None
    scale_is_known: bool


def padded_size(n: int) -> int:
    """Round n rows up to a size: powers of two up to 1024, then steps of 512 up to 2048, then of 1024.

    Eight programs serve all sizes from 300 to 6000, and padding costs a fifth of the time there.
    """
    if n <= 1024:
        return max(SMALLEST, 1 << (n - 1).bit_length())
    step = 512 if n <= 2048 else 1024
    return -(-n // step) * step


def size_of(problem: Problem) -> Size:
    """Find the size that serves one problem, or a stack of them."""
    pairs = None if problem.pairs is None else padded_size(problem.pairs.shape[-2])
    return Size(padded_size(problem.src.shape[-2]), pairs, problem.scale is not None)
