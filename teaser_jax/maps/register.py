"""The door for many clouds: one call, and a map of them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import Any

import numpy as np
from tqdm import tqdm

from teaser_jax.clouds.prepared import Prepared
from teaser_jax.ground.checks import shown, whole_number
from teaser_jax.maps.chosen import NEXT, pairs_to_ask
from teaser_jax.maps.graph import Engine, engine_or_any
from teaser_jax.maps.placing import place
from teaser_jax.maps.result import CloudMap
from teaser_jax.maps.shelf import Reading, Shelf, named
from teaser_jax.maps.store import open_store
from teaser_jax.maps.work import Job, done_pairs
from teaser_jax.reading import positive_number


def register_many(
    clouds: Sequence[Any],
    *,
    names: Sequence[str] | None = None,
    pairs: str | Iterable[Any] | None = None,
    folder: str | PathLike[str] | None = None,
    workers: int = 1,
    seconds: float | None = None,
    ordered: bool = True,
    engine: Engine | None = None,
    progress: bool | Callable[[str], None] = False,
    voxel_size: float | None = None,
    tolerance: float | None = None,
    refine: str | None = "gicp",
    viewpoint: Any = None,
    crop: Any = None,
    max_range: float | None = None,
    threads: int | None = None,
) -> CloudMap:
    """Register many raw clouds to one map: scans of a building, a street, an object.

    Pairs of clouds are registered by ``register_clouds``. Those that it trusts must agree with one another
    in cycles: two places may look alike, and a pair that contradicts others is refused. The rest are the
    edges of a graph of poses, weighed by what they are uncertain of, with a robust kernel.

    Args:
        clouds: Two or more, as ``register_clouds`` takes them, in one unit; paths are read when they are
            needed, in the order in which they were taken, or see ``ordered``.
        names: What to call them; None: as their files.
        pairs: "all"; "some": each cloud with the three that follow it and with five that look alike; a list
            of pairs of numbers; None: all of up to thirty clouds, some of more.
        folder: Where answers to pairs are kept, a file for each: whatever ends the work, the same call goes
            on. Files of other clouds or options are not touched. None: nowhere.
        workers: How many processes share the pairs. A script that asks for several needs the usual
            ``if __name__ == "__main__":``.
        seconds: A budget: no pair is begun after it [s].
        ordered: Whether neighbours in the list are neighbours in time: pairs of those are not refused for
            others, however many, as places that look alike lie apart in time. False: votes decide.
        engine: What optimises the poses, "gtsam" or "scipy"; None: GTSAM if it is installed.
        progress: Whether to show a bar on a terminal; or a function that is told.
        voxel_size, tolerance, refine: As in ``register_clouds``, for all pairs.
        viewpoint, crop, max_range, threads: As in ``prepare``, for all clouds.

    Returns:
        A ``CloudMap``. It does not depend on the number of workers, nor on where the work was broken off.

    Raises:
        ValueError: If a cloud cannot be read, or an option makes no sense.
        FileError: If the folder cannot be used.
        ImportError: Without the extra ``clouds``, or GTSAM if it is asked for.
        RuntimeError: If a worker was killed.
    """
    start = time.perf_counter()
    values = _checked(clouds, viewpoint=viewpoint, crop=crop, max_range=max_range)
    whole_number("workers", workers, 1, what="how many processes share the pairs")
    given = dict(seconds=seconds, voxel_size=voxel_size, tolerance=tolerance)
    for name, value in given.items():
        if value is not None:
            positive_number(value, name)
    engine = engine_or_any(engine)
    reading = Reading(viewpoint, crop, max_range, threads)
    shelf = Shelf(values, named(values, names), reading)
    options = dict(voxel_size=voxel_size, tolerance=tolerance, refine=refine)
    store = None if folder is None else open_store(folder, repr(sorted(options.items())))
    took = {}
    with _shown(progress) as show:
        show("reading clouds", 0, len(shelf))
        looked = list(_counted(shelf.look(), show, "reading clouds", len(shelf)))
        took["reading"] = time.perf_counter() - start
        asked = pairs_to_ask(shelf, pairs)
        took["choosing pairs"] = time.perf_counter() - start - sum(took.values())
        job = Job(shelf, looked, store, options)
        left = None if seconds is None else max(1e-9, start + seconds - time.perf_counter())
        done = _counted(done_pairs(job, asked, workers, left), show, "registering pairs", len(asked))
        answers = sorted(done, key=lambda pair: (pair.i, pair.j))
    took["pairs"] = time.perf_counter() - start - sum(took.values())
    placing = place(answers, np.array([x.origin for x in looked]), engine, NEXT if ordered else 0)
    took["placing"] = time.perf_counter() - start - sum(took.values())
    return CloudMap(tuple(shelf.names), tuple(answers), placing, engine, len(asked), took, shelf)


def _checked(clouds: Any, **reading: Any) -> list[Any]:
    """Take a sequence of clouds, or raise ValueError."""
    if isinstance(clouds, (str, PathLike, Prepared)) or not isinstance(clouds, Iterable):
        raise ValueError(f"clouds is {shown(clouds)}: expected a list of clouds or of paths.")
    values = list(clouds)
    if len(values) < 2:
        raise ValueError(f"clouds has {len(values)} entries: expected two or more.")
    given = [name for name, value in reading.items() if value is not None]
    if given and any(isinstance(value, Prepared) for value in values):
        raise ValueError(f"some clouds were prepared already: give {' and '.join(given)} to prepare.")
    return values


def _counted(
    items: Iterator[Any], show: Callable[[str, int, int], None], what: str, total: int
) -> Iterator[Any]:
    for k, item in enumerate(items, 1):
        show(what, k, total)
        yield item


@contextmanager
def _shown(progress: bool | Callable[[str], None]) -> Iterator[Callable[[str, int, int], None]]:
    """Give a function that tells how far the work is: a terminal, a function of the user, or no one."""
    if callable(progress):
        yield lambda what, k, total: progress(f"{what}: {k} of {total}")
        return
    # disable=None: on a terminal only.
    with tqdm(leave=False, disable=None if progress else True) as bar:

        def show(what: str, k: int, total: int) -> None:
            bar.set_description_str(what, refresh=False)
            bar.total, bar.n = total, k
            bar.refresh()

        yield show
