"""The loop that several stages share: a step is repeated until nothing changes."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Bool, Int

State = TypeVar("State")


def until_settled(
    step: Callable[[State], tuple[State, Bool[Array, ""]]], start: State, *, iterations: Int[Array, ""] | int
) -> tuple[State, Bool[Array, ""]]:
    """Repeat a step until it says that it changed nothing, or the cap on its iterations is reached.

    Args:
        step: Takes a state and returns the next one, and whether the two are the same for its purpose.
        start: The first state, a pytree.
        iterations: The cap.

    Returns:
        The last state, and whether the steps had settled.

    Gradients: those of ``lax.while_loop``, forward mode only.
    """

    def unsettled(loop: tuple[State, Array, Array]) -> Array:
        _, settled, rounds = loop
        return ~settled & (rounds < iterations)

    def once(loop: tuple[State, Array, Array]) -> tuple[State, Array, Array]:
        state, _, rounds = loop
        state, settled = step(state)
        return state, settled, rounds + 1

    state, settled, _ = lax.while_loop(unsettled, once, (start, jnp.zeros((), bool), jnp.int32(0)))
    return state, settled
