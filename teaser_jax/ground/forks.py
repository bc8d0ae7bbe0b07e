"""Children of a fork, in which JAX's threads are missing: a call there says so, and does not wait forever."""

from __future__ import annotations

import os
import sys

FORKED = (
    "this process was forked from one in which JAX had already run. JAX's threads do not come along, so that "
    "the call would never return. Start workers afresh, as with multiprocessing.get_context('spawn') or "
    "DataLoader(..., multiprocessing_context='spawn'), or let JAX run in the children only."
)

_has_run = False  # a door of this process, or of one that it was forked from
_ran_before_the_fork = False
_threads_are_missing = False


def check_fork() -> None:
    """Raise RuntimeError if this process lacks the threads of JAX; takes a twentieth of a microsecond."""
    global _has_run
    if _threads_are_missing:
        raise RuntimeError(FORKED)
    _has_run = True


def _jax_has_run() -> bool:
    """Tell whether JAX has started its threads; it has no public way to be asked (its issue 23320)."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    return _has_run or bool(getattr(bridge, "backends_are_initialized", bool)())


def _before() -> None:
    # Asked in the parent: in the child the lock behind the answer may be held by a thread that is gone.
    global _ran_before_the_fork
    _ran_before_the_fork = _jax_has_run()


def _in_child() -> None:
    global _threads_are_missing
    _threads_are_missing |= _ran_before_the_fork


if hasattr(os, "register_at_fork"):  # Windows has no forks
    os.register_at_fork(before=_before, after_in_child=_in_child)
