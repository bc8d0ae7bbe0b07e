"""The work on pairs: what is done is taken from the folder, the rest is asked, by one or several workers."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context, parent_process
from typing import Any, NamedTuple

from teaser_jax.clouds.prepared import threads_or_all
from teaser_jax.clouds.register import register_clouds
from teaser_jax.maps.pair import MapPair, pair_of
from teaser_jax.maps.shelf import Looked, Shelf
from teaser_jax.maps.store import Store

AHEAD = 2  # pairs that wait for each worker: none is left without work, and few are begun in vain


class Job(NamedTuple):
    """What every worker is told.

    Attributes:
        shelf: The clouds.
        looked: What is known of them.
        store: Where pairs are kept; None: nowhere.
        options: Of ``register_clouds``.
    """

    shelf: Shelf
    looked: list[Looked]
    store: Store | None
    options: dict[str, Any]

    def ask(self, i: int, j: int) -> MapPair:
        """Ask for the pose of cloud j in the frame of cloud i, and keep the answer."""
        answer = register_clouds(self.shelf[j], self.shelf[i], **self.options)
        pair = pair_of(i, j, answer)
        if self.store is not None:
            self.store.write(pair, self.looked[i], self.looked[j])
        return pair


def done_pairs(
    job: Job, pairs: Sequence[tuple[int, int]], workers: int, seconds: float | None
) -> Iterator[MapPair]:
    """Give the answers to pairs: those that are kept first, then others as they come.

    Args:
        job: The clouds, and how to register them.
        pairs: Which of them.
        workers: Processes that share the pairs.
        seconds: A budget: no pair is begun after it [s]; None: none.
    """
    end = None if seconds is None else time.perf_counter() + seconds
    missing = []
    for i, j in pairs:
        kept = None if job.store is None else job.store.read(i, j, job.looked)
        if kept is None:
            missing.append((i, j))
        else:
            yield kept
    if workers == 1 or len(missing) < 2:
        for i, j in missing:
            if end is not None and time.perf_counter() >= end:
                return
            yield job.ask(i, j)
    else:
        yield from _shared(job, missing, min(workers, len(missing)), end)


def _shared(job: Job, pairs: Sequence[tuple[int, int]], workers: int, end: float | None) -> Iterator[MapPair]:
    """Share pairs among processes, begun afresh: JAX does not survive a fork."""
    each = job.shelf.reading.threads or max(1, threads_or_all(None) // workers)
    job = job._replace(shelf=job.shelf.fresh(each))
    pool = ProcessPoolExecutor(workers, get_context("spawn"), _begin, (job,))
    waiting, left = set[Future[MapPair]](), iter(pairs)
    try:
        while True:
            while len(waiting) < AHEAD * workers and (end is None or time.perf_counter() < end):
                pair = next(left, None)
                if pair is None:
                    break
                waiting.add(pool.submit(_ask, *pair))
            if not waiting:
                return
            done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
            for future in done:
                yield future.result()
    except BrokenProcessPool as error:
        raise RuntimeError(
            "a worker ended before its pair was done, as if killed for want of memory: take fewer workers. "
            "With a folder the work goes on where it was."
        ) from error
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


_job: Job | None = None  # of this worker


def _begin(job: Job) -> None:
    global _job
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # who presses a key is answered by the first process
    threading.Thread(target=_end_with_parent, daemon=True).start()
    _job = job


def _end_with_parent() -> None:
    """End this worker when the first process is gone: one that was killed cannot tell its workers."""
    first = parent_process()
    if first is not None:
        first.join()
        os._exit(1)


def _ask(i: int, j: int) -> MapPair:
    assert _job is not None
    return _job.ask(i, j)
