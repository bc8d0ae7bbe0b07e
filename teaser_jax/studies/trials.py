"""The problems of a study: what is drawn, from which model, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias
from zlib import crc32

import numpy as np

from teaser_jax.files.models import read_shape
from teaser_jax.ground.arrays import Number
from teaser_jax.ground.checks import whole_number
from teaser_jax.problem import Problem, host_problem
from teaser_jax.synthetic import Shape, SyntheticProblem, Triangles

PROTOCOL = 1  # raised when a study draws other problems for the same seed


class StudyError(ValueError):
    """A ``StudyError`` says why a study cannot be run as asked, and what is known instead."""


@dataclass(frozen=True, eq=False)
class Model:
    """A ``Model`` is what the points of a study are drawn from.

    Attributes:
        name: What titles and tables call it.
        shape: (m, 3) points or ``synthetic.Triangles`` [length]; None: the teapot.
    """

    name: str = "teapot"
    shape: Shape = None

    @cached_property
    def crc32(self) -> str:
        """The checksum of the shape tells models of one name apart; empty for the teapot."""
        if self.shape is None:
            return ""
        arrays = self.shape if isinstance(self.shape, Triangles) else (self.shape,)
        return f"{crc32(b''.join(np.asarray(x, np.float64).tobytes() for x in arrays)):08x}"


TEAPOT = Model()


@dataclass(frozen=True)
class Origin:
    """An ``Origin`` says what the problems of a study are drawn from: shards, answers and tables carry it.

    Attributes:
        study: The name of the study.
        seed: The seed of the whole study.
        model: The name of the model.
        model_crc32: The checksum of its points, see ``Model``.
        protocol: The version of the drawing.
    """

    study: str
    seed: int
    model: str
    model_crc32: str
    protocol: int = PROTOCOL

    def unlike(self, other: Mapping[str, Any]) -> tuple[str, Any, Any] | None:
        """Find the first part that differs from another origin: its name, theirs, ours; None if none does.

        What was written before the checksum of the points was kept lacks it: that is no difference.
        """
        for key, ours in asdict(self).items():
            theirs = other.get(key, ours if key == "model_crc32" else None)
            if theirs != ours:
                return key.replace("_", " "), theirs, ours
        return None


@dataclass(frozen=True, eq=False)
class Trial:
    """A ``Trial`` is one run of a cell: a problem that every method is asked about.

    Attributes:
        value: What is swept: the share of wrong matches, the overlap, or the number of matches.
        number: The number of the run in its cell; it and the value seed the problem.
        problem: Matches and truth.
        scale: The known scale [-], or None where methods must find it.
        origin: The study, seed and model that it is drawn from; None where nobody knows.
    """

    value: Number
    number: int
    problem: SyntheticProblem
    scale: float | None = 1.0
    origin: Origin | None = None

    def for_solver(self) -> Problem:
        """Return the matches without the truth, in float64 numpy."""
        p = self.problem
        return host_problem(p.src, p.dst, noise_bound=p.noise_bound, scale=self.scale)


Draw: TypeAlias = Callable[[tuple[int, ...], Number, Model], SyntheticProblem]


def seed_of(study: str, seed: int, value: Number, number: int) -> tuple[int, ...]:
    """Make the seed of one problem from its study, the user's seed, the cell, the run, and nothing else."""
    return seed, crc32(study.encode()), round(10_000 * value), number


def check_seed(seed: Any) -> int:
    """Return the seed of a study as an int of any size, or raise StudyError."""
    return whole_number("seed", seed, 0, below=None, error=StudyError)


def read_model(path: str | Path) -> Model:
    """Read a model for ``run_study``, which the name of its file names.

    Args:
        path: Points (m, 3) as ``.npy``, or points or triangles in PLY, OBJ, STL, OFF, ...

    Raises:
        FileError: If the file is missing or broken or holds no points.
        ImportError: Without the extra ``studies``, for anything but ``.npy``.
    """
    return Model(Path(path).stem, read_shape(path))
