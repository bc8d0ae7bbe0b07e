"""A long search can be interrupted, and says on a terminal how far it is."""

from __future__ import annotations

import io
import os
import signal
import sys
import threading

import numpy as np
import pytest

from teaser_jax.stages.clique import exact
from teaser_jax.stages.clique.clique import Clique
from teaser_jax.stages.clique.watch import PATIENCE, Watch


@pytest.fixture(autouse=True)
def interrupts_are_heard():
    """Whatever started the tests in the background had them ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


def test_an_interrupt_waits_for_the_next_look():
    with Watch() as watch:
        interrupt()
        sum(range(1000))  # where it would have been raised
        with pytest.raises(KeyboardInterrupt):
            watch.look(3, 5)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_an_interrupt_after_the_last_look_is_not_lost():
    with pytest.raises(KeyboardInterrupt), Watch():
        interrupt()


def test_whoever_handled_interrupts_before_handles_them():
    seen = []
    before = signal.signal(signal.SIGINT, lambda number, frame: seen.append(number))
    try:
        with Watch() as watch:
            interrupt()
            assert not seen
            watch.look(3, 5)
            assert seen == [signal.SIGINT]
            interrupt()
        assert seen == [signal.SIGINT] * 2
    finally:
        signal.signal(signal.SIGINT, before)


def test_in_another_thread_nothing_is_touched():
    handlers = []

    def search():
        with Watch() as watch:
            handlers.append(signal.getsignal(signal.SIGINT))
            watch.look(3, 5)

    thread = threading.Thread(target=search)
    thread.start()
    thread.join()
    assert handlers == [signal.default_int_handler]


@pytest.mark.parametrize("terminal", [True, False])
def test_a_terminal_is_told_after_two_seconds(terminal, monkeypatch):
    stream = io.StringIO()
    stream.isatty = lambda: terminal
    monkeypatch.setattr(sys, "stderr", stream)
    with Watch() as watch:
        watch.look(3, 5)
        assert stream.getvalue() == ""
        watch.shown -= PATIENCE
        watch.look(30, 50)
        told = stream.getvalue()
    assert ("largest clique so far 30 matches, none has more than 50" in told) == terminal


def test_a_search_that_is_interrupted_ends_as_one():
    """Between two looks of the search itself: too many roots for one slice."""
    exact.load_kernels()
    rng = np.random.default_rng(0)
    n = 600
    edges = np.triu(rng.uniform(size=(n, n)) < 0.9, 1)
    edges |= edges.T
    padded = np.pad(edges, ((0, 0), (0, -n % 32)))
    bits = np.packbits(padded, axis=1, bitorder="little").view("<u4").astype(np.uint32)
    threading.Timer(1.0, interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        exact.search_clique(bits, Clique(np.zeros(n, bool), np.int32(n)), nodes=10**9, seconds=60.0)
