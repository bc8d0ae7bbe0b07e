"""The door for two raw clouds: one call, no parameter, a pose and a verdict."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from tqdm import tqdm

from teaser_jax.clouds.candidates import ENOUGH, MOST_CELLS, Candidate, Search, candidates
from teaser_jax.clouds.fine import align
from teaser_jax.clouds.pair import Pair
from teaser_jax.clouds.parts.answer import part_answer
from teaser_jax.clouds.prepared import Prepared, as_prepared, threads_or_all
from teaser_jax.clouds.registration import CloudRegistration
from teaser_jax.clouds.symmetry import Axis
from teaser_jax.clouds.trust.judge import CELLS, Judged, Verdict, judge
from teaser_jax.clouds.trust.pairing import moved
from teaser_jax.clouds.trust.rivals import Guess
from teaser_jax.ground.arrays import AnyArray, inside_jit, is_traced
from teaser_jax.ground.checks import one_of
from teaser_jax.ground.flags import as_on_the_host
from teaser_jax.pose import Pose, as_pose
from teaser_jax.reading import known_scale, positive_number, real_numbers
from teaser_jax.solution import Status

MATCHES_AGAIN = ("fit", "space", "own")  # doubts that other matches may dispel
OTHERS = 6  # candidates that are tried as rivals
USUAL_ERROR = 3.0  # cells, of an initial pose of which no error is given
NEAREST_REACH = 2.0  # cells, from which surfaces draw a pose in any case
SOME = 500  # points that tell how far two poses lie apart
INSIDE_JIT = (
    "register_clouds was called inside jit, vmap or grad. It runs on the host: inside use the pieces, "
    "teaser_jax.clouds.features.fpfh and matching.nearest, then teaser_jax.solve."
)


def register_clouds(
    src: Any,
    dst: Any,
    *,
    voxel_size: float | None = None,
    tolerance: float | None = None,
    src_viewpoint: Any = None,
    dst_viewpoint: Any = None,
    initial: Any = None,
    initial_error: float | None = None,
    scale: float = 1.0,
    descriptors: Any = None,
    crop: Any = None,
    max_range: float | None = None,
    threads: int | None = None,
    seconds: float | None = None,
    refine: str | None = "gicp",
    progress: bool | Callable[[str], None] = False,
) -> CloudRegistration:
    """Register two raw clouds: no matches, no voxel size and no noise bound are needed.

    Both clouds are cut into cells, cells that look alike are matched, ``register`` finds a pose, and the two
    clouds judge it: whether they lie on one another, whether their shapes hold the pose, and whether another
    pose explains as much. Further ways to match follow where the first fails. All runs on the host, in
    the frames as given; the same clouds and settings give the same bits.

    Args:
        src, dst: The clouds, of any two sizes: (n, 3) arrays of numpy, JAX or torch, structured arrays with
            x, y, z, clouds of Open3D, paths of files, or what ``prepare`` made of one. Further columns
            and colours are ignored.
        voxel_size: Width of the cells that the verdict rests on; None: 6000 of them in the cloud that needs
            the finer ones, not finer than its points lie [length].
        tolerance: ``ok`` shall promise that points of the overlap are off by less than this, too [length].
        src_viewpoint, dst_viewpoint: Where each sensor stood, (3,), in the frame of its cloud [length].
        initial: A pose near the answer, as a ``Pose`` or matrix: then only poses near it are looked for.
        initial_error: How far it may have points of the overlap off [length]; other poses further off are
            not counted as rivals then. None: three cells, and no pose is ruled out.
        scale: Known scale, by which the target sees the source larger [-].
        descriptors: Two arrays, (n, d) and (m, d): for each point of the source and of the target, as given,
            a row of numbers, of which near ones look alike; None: histograms of the normals around (FPFH).
        crop: The lower and the upper corner of a box in the frame of each cloud, (2, 3) [length].
        max_range: Points further from the viewpoint, or the origin, are left out [length].
        threads: How many threads to work with; None: one for each core. They change no answer.
        seconds: A budget: no further way to match is tried after it [s].
        refine: How to align the pose at last: "gicp" by the shape of both clouds, "plane" by the planes of
            the target; None: not at all.
        progress: Whether to show on a terminal what is being done; or a function that is told.

    Returns:
        A ``CloudRegistration``; act on its pose only where ``ok``.

    Raises:
        ValueError: If a cloud cannot be read, or an option makes no sense.
        ImportError: Without the extra ``clouds``.
    """
    start = time.perf_counter()
    if inside_jit() or is_traced(src, dst):
        raise ValueError(INSIDE_JIT)
    given = dict(voxel_size=voxel_size, tolerance=tolerance, initial_error=initial_error, seconds=seconds)
    for name, value in given.items():
        if value is not None:
            positive_number(value, name)
    if refine is not None:
        one_of("refine", refine, ("gicp", "plane"))
    if initial is None and initial_error is not None:
        raise ValueError("initial_error is given without initial: give the pose that may be so far off.")
    size, workers = float(known_scale(scale)), threads_or_all(threads)
    one = partial(as_prepared, crop=crop, max_range=max_range, threads=workers)
    with as_on_the_host(x64=False), _shown(progress) as show:
        clouds = one(src, "src", viewpoint=src_viewpoint), one(dst, "dst", viewpoint=dst_viewpoint)
        pair = Pair(clouds[0].scaled(size), clouds[1], size, voxel_size)
        described = None if descriptors is None else _descriptors(descriptors, clouds)
        search = Search(pair, described, None if seconds is None else start + seconds)
        pair.seconds["reading"] = time.perf_counter() - start
        ask = _Ask(refine, tolerance, initial_error is not None, show)
        if initial is None:
            outcome = _with_part(search, ask, *_searched(search, ask))
        else:
            outcome = _near(search, _guess(pair, initial, initial_error), ask)
        return _answer(search, clouds, ask, outcome)


class _Ask(NamedTuple):
    """What is asked of the answer, and who is told of the work."""

    refine: str | None
    tolerance: float | None
    is_certain: bool  # that the initial pose is no further off than was said
    show: Callable[[str], None]


class _Outcome(NamedTuple):
    """What the work led to.

    Attributes:
        found: All poses, best first.
        judged: The first of them; None: there is none.
        equivalent: Poses as good as the first; None: those that the verdict knows.
        axis: About which the source may be turned, in the frame of the target about its middle.
    """

    found: list[Candidate]
    judged: Judged | None
    equivalent: list[Pose] | None = None
    axis: Axis | None = None


def _searched(search: Search, ask: _Ask) -> tuple[list[Candidate], Judged | None]:
    """Look for candidates until one passes; the best that does not is judged, too."""
    found: list[Candidate] = []
    best, judged = None, None
    for candidate in candidates(search, ask.show):
        found = sorted([*found, candidate], key=lambda x: -x.score)
        if found[0] is best or found[0].score < ENOUGH:
            continue
        best, judged = found[0], _judge(found, search.pair, ask)
        if judged.verdict.doubt not in MATCHES_AGAIN:
            break
    if found and found[0] is not best:
        judged = _judge(found, search.pair, ask)
    return found, judged


def _with_part(search: Search, ask: _Ask, found: list[Candidate], judged: Judged | None) -> _Outcome:
    """Look for a part in a scan of it where matches lead to nothing; its pose counts if it is found."""
    pair = search.pair
    if judged is not None and judged.verdict.doubt is None:
        return _Outcome(found, judged)
    ask.show("looking for a part in its scan")
    part = part_answer(pair, search.seconds_left)
    lost = judged is None or judged.verdict.status == Status.NO_CONSENSUS
    if part is None or (part.verdict.doubt == "part" and not lost):
        return _Outcome(found, judged)
    others = [pair.given(x) for x in part.poses[1:]]
    best = search.weighed(part.poses[0], "all poses of a part", None)
    there = judge(part.poses[0], pair, refine=None)
    return _Outcome([best, *found], replace(there, verdict=part.verdict), others, part.axis)


def _near(search: Search, guess: Guess, ask: _Ask) -> _Outcome:
    """Look for a pose near a guess; if the clouds draw it further away than it may be off, the guess stays.

    The surfaces draw it from as far as it may be off, then from half of that, and so on.
    """
    pair = search.pair
    ask.show("aligning the initial pose")
    src, dst = pair.surfaces(CELLS, MOST_CELLS)
    pose, reach = guess.pose, guess.error / dst.voxel_size
    while reach > NEAREST_REACH:
        pose = align(pose, src, dst, reach=reach)
        reach /= 2
    some = src.points[:: max(1, len(src) // SOME)]
    is_near = lambda x: np.linalg.norm(moved(x, some) - moved(guess.pose, some), axis=1).mean() <= guess.error
    found = [search.compared(pair.given(pose if is_near(pose) else guess.pose), "the initial pose", None)]
    judged = _judge(found, pair, ask, guess)
    if ask.is_certain and not is_near(judged.pose):
        judged = replace(judged, verdict=Verdict(Status.NO_CONSENSUS, "guess"))
    return _Outcome(found, judged)


def _judge(found: list[Candidate], pair: Pair, ask: _Ask, guess: Guess | None = None) -> Judged:
    """Judge the first candidate, the others being rivals."""
    ask.show("looking for other poses that fit")
    best, *others = (pair.centred(x.pose) for x in found[: 1 + OTHERS])
    ruled = guess if guess is not None and ask.is_certain else None
    return judge(best, pair, others, guess=ruled, refine=ask.refine, tolerance=ask.tolerance)


def _answer(
    search: Search, clouds: tuple[Prepared, Prepared], ask: _Ask, outcome: _Outcome
) -> CloudRegistration:
    """Write what was found in the frames as given."""
    pair, (src, dst), judged, axis = search.pair, clouds, outcome.judged, outcome.axis
    evidence, verdict = None, Verdict(Status.NO_CONSENSUS, "matches")
    equivalent: tuple[Pose, ...] = ()
    pose = Pose(np.eye(3), np.zeros(3), np.float64(pair.scale))
    if judged is not None:
        pose, evidence, verdict = pair.given(judged.pose), judged.evidence, judged.verdict
        rivals = (pair.given(x) for x in evidence.rivals.poses)
        equivalent = () if verdict.doubt is None else tuple(outcome.equivalent or rivals)
    return CloudRegistration(
        pose=pose,
        status=verdict.status,
        doubt=verdict.doubt,
        evidence=evidence,
        candidates=tuple(outcome.found),
        equivalent=equivalent,
        axis=None if axis is None else axis._replace(point=axis.point + pair.dst.cloud.origin),
        src=src.cloud,
        dst=dst.cloud,
        tolerance=ask.tolerance,
        ended_early=search.seconds_left == 0,
        seconds=pair.seconds,
    )


def _guess(pair: Pair, initial: Any, error: float | None) -> Guess:
    """Read an initial pose as one between the middles, and how far it may be off."""
    pose = as_pose(initial)
    if not np.isclose(pose.scale, pair.scale, rtol=1e-6):
        raise ValueError(f"initial has scale {float(pose.scale):.6g}, and scale is {pair.scale:.6g}.")
    return Guess(pair.centred(pose), USUAL_ERROR * pair.width(CELLS, MOST_CELLS) if error is None else error)


def _descriptors(given: Any, clouds: tuple[Prepared, Prepared]) -> tuple[AnyArray, AnyArray]:
    """Read the descriptors of both clouds: one row for each point that is used."""
    if not isinstance(given, (tuple, list)) or len(given) != 2:
        raise ValueError("descriptors: expected two arrays, one for the source and one for the target.")
    a, b = (
        _rows_of(cloud, real_numbers(values, f"the descriptors of {name}"), name)
        for cloud, values, name in zip(clouds, given, ("src", "dst"), strict=True)
    )
    if a.shape[1] != b.shape[1]:
        raise ValueError(f"descriptors have {a.shape[1]} and {b.shape[1]} numbers a point: give one kind.")
    return a, b


def _rows_of(cloud: Prepared, values: AnyArray, name: str) -> AnyArray:
    if values.ndim != 2 or len(values) != cloud.cloud.given:
        raise ValueError(
            f"the descriptors of {name} have shape {values.shape}: expected ({cloud.cloud.given}, d), a row "
            "for each point."
        )
    return values[cloud.cloud.rows]


@contextmanager
def _shown(progress: bool | Callable[[str], None]) -> Iterator[Callable[[str], None]]:
    """Give a function that tells what is being done: a terminal, a function of the user, or no one."""
    if callable(progress):
        yield progress
        return
    # disable=None: on a terminal only.
    with tqdm(bar_format="{desc} {elapsed}", leave=False, disable=None if progress else True) as bar:
        yield bar.set_description_str
