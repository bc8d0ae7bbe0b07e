"""Problems in files, so that another program can be measured on the same ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, fields
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np

from teaser_jax.ground.io import FileError, os_errors_named, read_archive, replacing
from teaser_jax.pose import Pose
from teaser_jax.studies.study import Study
from teaser_jax.studies.trials import TEAPOT, Model, Origin, Trial, check_seed
from teaser_jax.synthetic import SyntheticProblem

SHARD_BYTES = 64_000_000
SHAPES = {
    "src": 3, "dst": 3, "inliers": 2, "noise_bound": 1, "rotation": 3, "translation": 2, "scale": 1,
    "known_scale": 1, "value": 1, "trial": 1,
}  # fmt: skip
ORIGIN = tuple(field.name for field in fields(Origin))  # a value each, and none in older shards


def draw_trials(
    study: Study, *, runs: int | None = None, seed: int = 0, model: Model = TEAPOT, quick: bool = False
) -> Iterator[Trial]:
    """Draw the problems of a study, cell by cell: those that ``run_study`` asks every method.

    Args:
        study: One of ``studies()``.
        runs: Problems a cell; None: the study's own.
        seed: The seed of the whole study.
        model: What points are drawn from, see ``read_model``.
        quick: A few cells of three runs each.

    Raises:
        StudyError: On runs or a seed that make no sense.
    """
    for value, numbers in study.cells(runs, quick=quick):
        for number in numbers:
            yield study.trial(check_seed(seed), value, number, model)


def save_trials(
    folder: str | Path, trials: Iterable[Trial], *, name: str = "problems", shard_bytes: int = SHARD_BYTES
) -> list[Path]:
    """Write problems as ``NAME-00000.npz`` and so on, b problems of n matches in each.

    Arrays of a shard: ``src``, ``dst`` (b, n, 3); ``inliers`` (b, n), the right matches; ``noise_bound``
    (b,); the truth as ``rotation`` (b, 3, 3), ``translation`` (b, 3), ``scale`` (b,) and as ``T_dst_src``
    (b, 4, 4); ``known_scale`` (b,), NaN where it is to be estimated; ``value`` (b,), what the study sweeps;
    ``trial`` (b,), the run; and, a value each, what draws them again: ``study``, ``seed`` (as text from 2^63
    on), ``model``, ``model_crc32`` of its points, ``protocol``. Problems of different sizes go to different
    shards, and their order is kept. Every shard appears whole or not at all; older shards of that name are
    removed if they are of the same study, seed and model.

    Args:
        folder: Made if it does not exist.
        trials: As from ``draw_trials``; read one by one, so that any number fits.
        name: How the files begin.
        shard_bytes: About the largest size of a file.

    Returns:
        The files, in order.

    Raises:
        FileError: If they cannot be written, or the folder holds shards of that name with problems of another
            study, seed or model; these are left as they are.
    """
    folder = Path(folder)
    written: list[Path] = []
    with os_errors_named(folder, "cannot be written"):
        folder.mkdir(parents=True, exist_ok=True)
        older = {path: read_origin(path) for path in folder.glob(f"{name}-[0-9][0-9][0-9][0-9][0-9].npz")}
        for shard in _shards(_checked(trials, set(older.values()), folder / f"{name}-*.npz"), shard_bytes):
            path = folder / f"{name}-{len(written):05d}.npz"
            with replacing(path) as partial:
                arrays: dict[str, Any] = _arrays(shard)
                np.savez_compressed(partial, **arrays)
            written.append(path)
        for path in older.keys() - set(written):
            path.unlink()
    return written


def _checked(trials: Iterable[Trial], older: set[Origin | None], place: Path) -> Iterator[Trial]:
    """Raise FileError before the first problem if it would take the place of those of another origin."""
    every = iter(trials)
    for first in every:
        if older and first.origin not in older:
            other = next(iter(older))
            differs = other and first.origin and first.origin.unlike(asdict(other))
            said = (
                "of {} {!r}, and {!r} is asked for" if differs else "and do not say of which seed and model"
            )
            raise FileError(
                f"{place}: hold problems {said.format(*differs or ())}: name another folder, or remove them."
            )
        yield from chain([first], every)


def read_trials(paths: str | Path | Sequence[str | Path]) -> Iterator[Trial]:
    """Read the problems of ``save_trials`` again, bit for bit, one by one.

    Args:
        paths: A folder, whose shards are read in order of their names; or a shard, or several.

    Raises:
        FileError: If there is no shard, or one is broken or holds something else.
    """
    listed = [paths] if isinstance(paths, str | Path) else list(paths)
    for given in map(Path, listed):
        shards = sorted(given.glob("*.npz")) if given.is_dir() else [given]
        if not shards:
            raise FileError(f"{given}: holds no shard (.npz).")
        for path in shards:
            yield from _read(path)


def _shards(trials: Iterable[Trial], shard_bytes: int) -> Iterator[list[Trial]]:
    """Group neighbouring problems of one size and origin, as many as fit into a file."""
    for (size, _), some in groupby(trials, key=lambda t: (len(t.problem.src), t.origin)):
        most, shard = max(1, shard_bytes // (49 * size + 200)), []
        for trial in some:
            shard.append(trial)
            if len(shard) == most:
                yield shard
                shard = []
        if shard:
            yield shard


def _arrays(trials: list[Trial]) -> dict[str, np.ndarray]:
    problems = [trial.problem for trial in trials]
    return {
        "src": np.stack([p.src for p in problems]),
        "dst": np.stack([p.dst for p in problems]),
        "inliers": np.stack([p.inliers for p in problems]),
        "noise_bound": np.array([p.noise_bound for p in problems]),
        "rotation": np.stack([p.truth.rotation for p in problems]),
        "translation": np.stack([p.truth.translation for p in problems]),
        "scale": np.array([p.truth.scale for p in problems], np.float64),
        "T_dst_src": np.stack([p.truth.matrix for p in problems]),
        "known_scale": np.array([np.nan if t.scale is None else t.scale for t in trials]),
        "value": np.array([t.value for t in trials]),
        "trial": np.array([t.number for t in trials]),
    } | _origin_arrays(trials[0].origin)


def _origin_arrays(origin: Origin | None) -> dict[str, np.ndarray]:
    known = {} if origin is None else asdict(origin)
    # What no integer of numpy holds would be written as a pickle, which nobody should read.
    return {k: np.array(x if isinstance(x, str) or x < 2**63 else str(x)) for k, x in known.items()}


def read_origin(path: Path) -> Origin | None:
    """Read what the problems of a shard, or the answers to them, are drawn from; None: it does not say.

    Raises:
        FileError: If it is no archive, or says what makes no sense.
        OSError: If it cannot be read.
    """
    arrays = read_archive(path, ORIGIN).arrays
    if set(ORIGIN) - set(arrays):
        return None
    text = {}
    for key, array in arrays.items():
        if len(found := np.unique(array)) != 1:  # answers to several shards may repeat it
            raise FileError(f"{path}: {key} has {len(found)} values: expected one, as in a shard.")
        text[key] = str(found[0])
    if not (text["seed"].isdecimal() and text["protocol"].isdecimal()):
        raise FileError(f"{path}: seed or protocol is no whole number: copy both from the shard.")
    numbers = {key: int(text[key]) for key in ("seed", "protocol")}
    return Origin(text["study"], model=text["model"], model_crc32=text["model_crc32"], **numbers)


def _read(path: Path) -> Iterator[Trial]:
    if not path.exists():
        raise FileError(f"{path}: no such file.")
    with os_errors_named(path, "cannot be read"):
        arrays, origin = read_archive(path, SHAPES).arrays, read_origin(path)
    if missing := set(SHAPES) - set(arrays):
        raise FileError(f"{path}: is no shard of problems: it lacks {', '.join(sorted(missing))}.")
    count = len(arrays["value"]) if arrays["value"].ndim else 0
    for name, dimensions in SHAPES.items():
        if arrays[name].ndim != dimensions or len(arrays[name]) != count:
            raise FileError(f"{path}: {name} has shape {arrays[name].shape}: it is no shard of problems.")
    for k in range(count):
        one: dict[str, Any] = {name: array[k] for name, array in arrays.items()}
        truth = Pose(one["rotation"], one["translation"], one["scale"])
        problem = SyntheticProblem(one["src"], one["dst"], truth, one["inliers"], float(one["noise_bound"]))
        scale = None if np.isnan(one["known_scale"]) else float(one["known_scale"])
        yield Trial(float(one["value"]), int(one["trial"]), problem, scale, origin)
