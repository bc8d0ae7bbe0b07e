"""A rare case that a batch pays for only where one of its problems is such a case."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import nullcontext
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jax import lax
from jax.custom_batching import custom_vmap

Found = TypeVar("Found")


def if_any(
    question: Callable[..., Any], rare: Callable[..., Found], usual: Callable[..., Found]
) -> Callable[..., Found]:
    """Make a function that is ``rare`` where the answer to a question is yes, and ``usual`` elsewhere.

    Under ``jax.vmap`` the question is asked once for the whole batch: a plain ``lax.cond`` would have every
    problem pay for both. Where any problem says yes, all go through ``rare``, which must give those that say
    no what ``usual`` gives.

    Args:
        question, rare, usual: Functions of the same arrays; the first returns one truth value.

    Gradients: none; inputs must be stopped by the caller.
    """

    @custom_vmap
    def choose(*inputs: Any) -> Any:
        return lax.cond(question(*inputs), rare, usual, *inputs)

    @choose.def_vmap
    def choose_for_all(size: int, batched: Any, *inputs: Any) -> Any:
        each = [
            x if has_axis else jnp.broadcast_to(x, (size, *x.shape))
            for x, has_axis in zip(inputs, batched, strict=True)
        ]
        # This may be traced after the block that allowed 64 bits has ended: they must stay what they are.
        wide = any(x.dtype.itemsize == 8 for x in each)
        with jax.enable_x64(True) if wide else nullcontext():
            some = jnp.any(jax.vmap(question)(*each))
            found = lax.cond(some, jax.vmap(rare), jax.vmap(usual), *each)
        return found, jax.tree.map(lambda _: True, found)

    return choose
