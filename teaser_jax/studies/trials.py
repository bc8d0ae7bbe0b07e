"""The problems of a study: what is drawn, from which model, and what is known of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias
from zlib import crc32

import numpy as np

from teaser_jax.ground.checks import whole_number
from teaser_jax.files import FileError, one_line
from teaser_jax.problem import Problem
from teaser_jax.register import host_problem
from teaser_jax.synthetic import Mesh, SyntheticProblem


class StudyError(ValueError):
    """A study that cannot be run as asked. The message says what is known instead."""


@dataclass(frozen=True, eq=False)
class Model:
    """What points are sampled from: a name for the title, and points or a mesh (None: the teapot)."""

    name: str = "teapot"
    shape: np.ndarray | Mesh | None = None


TEAPOT = Model()


@dataclass(frozen=True, eq=False)
class Trial:
    """One run of a cell.

    Attributes:
        value: What is swept: the share of wrong matches, the overlap, or the number of matches.
        number: Of the run in its cell; it and the value seed the problem.
        problem: Matches and truth.
        scale: The known scale, or None where methods must find it.
    """

    value: float
    number: int
    problem: SyntheticProblem
    scale: float | None = 1.0

    def for_solver(self) -> Problem:
        """The matches without the truth, in float64 numpy."""
        p = self.problem
        return host_problem(p.src, p.dst, noise_bound=p.noise_bound, scale=self.scale)


Draw: TypeAlias = Callable[[tuple[int, ...], float, Model], SyntheticProblem]


def seed_of(study: str, seed: int, value: float, number: int) -> tuple[int, ...]:
    """The seed of one problem: of its study, the user's seed, the cell and the run, and of nothing else."""
    return seed, crc32(study.encode()), round(10_000 * value), number


def check_seed(seed: Any) -> int:
    """The seed of a study, of any size; StudyError if it is none."""
    return whole_number("seed", seed, 0, below=None, error=StudyError)


def read_model(path: str | Path) -> Model:
    """A model from ``.npy`` points (m, 3), or from what trimesh reads (PLY, OBJ, STL, OFF, ...).

    A file with triangles becomes a ``Mesh``, from which any number of points can be drawn.

    Raises:
        FileError: If the file is missing or broken or holds no points.
        ImportError: Without the extra ``studies``, for anything but ``.npy``.
    """
    path = Path(path)
    if path.is_dir():
        raise FileError(f"{path}: is a folder: name the file of a model in it.")
    if not path.is_file():
        raise FileError(f"{path}: no such file: give a model with triangles or points, or 'procedural'.")
    try:
        shape = np.load(path, allow_pickle=False) if path.suffix == ".npy" else _by_trimesh(path)
    except ImportError:
        raise
    except Exception as error:  # a broken file makes its reader raise nearly anything
        raise FileError(f"{path}: cannot be read as a model ({one_line(error)}).") from error
    points = np.asarray(shape.vertices if isinstance(shape, Mesh) else shape)
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu" or len(points) < 4:
        raise FileError(f"{path}: holds an array of shape {points.shape}: expected (m, 3) points.")
    if not np.isfinite(points).all():
        raise FileError(f"{path}: holds points that are not finite numbers.")
    return Model(path.stem, shape)


def _by_trimesh(path: Path) -> Any:
    try:
        import trimesh
    except ImportError:
        raise ImportError("reading models needs trimesh: pip install 'teaser-jax[studies]'") from None
    found: Any = trimesh.load(path, process=False)
    if isinstance(found, trimesh.Scene):
        found = found.to_geometry()
    faces = getattr(found, "faces", None)
    vertices = np.asarray(found.vertices, np.float64)
    return Mesh(vertices, np.asarray(faces, np.int64)) if faces is not None and len(faces) else vertices
