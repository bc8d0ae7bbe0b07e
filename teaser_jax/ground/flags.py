"""What JAX is set to while a door of the host computes: float64, and nothing that debugging asks for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import jax

from teaser_jax.ground.forks import check_fork


@contextmanager
def as_on_the_host(*, x64: bool = True) -> Iterator[None]:
    """Compute in float64, compiled, with transfers allowed, whatever this thread has JAX set to.

    Without ``x64`` programs compute in float32, and that whatever JAX is set to, too.

    The doors of the host send numpy arrays and fetch numpy arrays: a guard against transfers is not meant for
    them. Programs that run operation by operation (``jax_disable_jit``) take minutes, and NaN may stand in
    rows that nothing is read from.

    Raises:
        RuntimeError: In a child that was forked after JAX had run, where every program waits forever.
    """
    check_fork()
    with (
        jax.enable_x64(x64),
        jax.transfer_guard("allow"),
        jax.disable_jit(False),
        jax.debug_nans(False),
        jax.debug_infs(False),
    ):
        yield
