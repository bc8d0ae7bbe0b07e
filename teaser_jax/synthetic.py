"""Random registration problems with known answers: the paper's protocol (section XI-A) and relatives.

Everything is numpy on the host and follows from the seed alone. No data files: the default model
is a small teapot, a solid of blended primitives without any symmetry, so that its pose is unique.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax import so3
from teaser_jax.types import Pose

SIGMA = 0.01
BOUND_PER_SIGMA = 5.54  # exceeded by one in 10^6 Gaussian errors of three dimensions

Points: TypeAlias = Float[np.ndarray, "n 3"]
Seed: TypeAlias = int | Sequence[int]


class Mesh(NamedTuple):
    """A triangle mesh to sample from: a model with any number of surface points."""

    vertices: Float[np.ndarray, "v 3"]
    faces: Int[np.ndarray, "f 3"]


@dataclass(frozen=True, eq=False)
class SyntheticProblem:
    """Matched points and the truth about them.

    Attributes:
        src, dst: Matched points, row i with row i; the model fits [0, 1]^3.
        truth: The pose behind the right matches, ``T_dst_src``.
        inliers: The right matches; every other one misses the truth by more than the bound.
        noise_bound: beta, the largest error of a right match.
    """

    src: Points
    dst: Points
    truth: Pose
    inliers: Bool[np.ndarray, " n"]
    noise_bound: float


def random_problem(
    seed: Seed,
    *,
    n: int = 1000,
    outlier_rate: float = 0.95,
    scale: float | tuple[float, float] = 1.0,
    sigma: float = SIGMA,
    noise_bound: float | None = None,
    radius: float = 5.0,
    model: Points | Mesh | None = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """A problem by the paper's protocol: wrong matches are uniform in a ball.

    The target is s R a + t with R uniform on SO(3) and t uniform in the unit ball. Noise is
    Gaussian, drawn again until its norm is at most the bound. An ``outlier_rate`` of 1 leaves no
    right match at all.

    Args:
        seed: Anything ``numpy.random.default_rng`` takes; the same seed gives the same problem.
        n: Number of matches.
        outlier_rate: Share of wrong matches, rounded to whole matches.
        scale: The scale, or the range from which it is drawn; the paper's is (1, 5).
        sigma: Standard deviation of the noise of each coordinate.
        noise_bound: beta; None: 5.54 sigma, as in the paper.
        radius: Radius of the ball of wrong targets. A smaller one makes more chance agreements.
        model: (m, 3) points, drawn without replacement, or a mesh; None: the teapot. Resized to
            fit [0, 1]^3.
        truth: A pose to use instead of a random one; its scale takes the place of ``scale``.

    Raises:
        ValueError: If a rate or size makes no sense, or the model has fewer than ``n`` points.

    References: section XI-A.
    """
    rng = np.random.default_rng(seed)
    right = _right_matches(rng, n, scale, sigma, noise_bound, model, truth)
    return _with_outliers(rng, right, outlier_rate, lambda rows: in_ball(rng, len(rows), radius))


def descriptor_problem(
    seed: Seed,
    *,
    n: int = 1000,
    outlier_rate: float = 0.95,
    hubs: float = 0.05,
    scale: float | tuple[float, float] = 1.0,
    sigma: float = SIGMA,
    noise_bound: float | None = None,
    model: Points | Mesh | None = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """A problem as descriptor matching makes it: wrong matches lie on the target, many to one.

    A descriptor errs towards a few points that look like everything. Wrong matches share
    ``hubs * n`` points of the target among them, so both the density of chance agreements and
    the number of repeated rows are far higher than in the paper's protocol.

    Args:
        seed, n, outlier_rate, scale, sigma, noise_bound, model, truth: As in ``random_problem``.
        hubs: Number of points that attract wrong matches, as a share of n; 1: nearly one to one.

    Raises:
        ValueError: As ``random_problem``.
    """
    rng = np.random.default_rng(seed)
    right = _right_matches(rng, n, scale, sigma, noise_bound, model, truth)
    attractive = right.dst[rng.permutation(n)[: max(2, round(hubs * n))]]
    return _with_outliers(
        rng, right, outlier_rate, lambda rows: attractive[rng.integers(len(attractive), size=len(rows))]
    )


def all_to_all(
    seed: Seed,
    *,
    n: int = 100,
    overlap: float = 1.0,
    sigma: float = 0.01 / BOUND_PER_SIGMA,
    noise_bound: float | None = None,
    model: Points | Mesh | None = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """No correspondences: every source point matched with every point of a part of the target.

    Rows run over the source first: match i * m + j pairs source point i with target point j, for
    m = overlap * n target points in random order.

    Args:
        seed, sigma, noise_bound, model, truth: As in ``random_problem``; the scale is 1.
        n: Points of the source, so that there are overlap * n^2 matches.
        overlap: Share of the source points that have a counterpart.

    Raises:
        ValueError: As ``random_problem``.

    References: section XI-C, Fig. 7.
    """
    if not 0 < overlap <= 1:
        raise ValueError(f"overlap is {overlap}: expected a share above 0, at most 1.")
    rng = np.random.default_rng(seed)
    whole = _right_matches(rng, n, 1.0, sigma, noise_bound, model, truth)
    kept = rng.permutation(n)[: max(1, round(overlap * n))]
    i, j = np.repeat(np.arange(n), len(kept)), np.tile(kept, n)
    return SyntheticProblem(whole.src[i], whole.dst[j], whole.truth, i == j, whole.noise_bound)


def random_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Uniform on SO(3)."""
    return np.asarray(so3.rotation_from_quat(rng.standard_normal(4)))


def in_ball(rng: np.random.Generator, n: int, radius: float) -> Points:
    """Uniform in the ball around the origin."""
    directions = rng.standard_normal((n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * np.cbrt(rng.random((n, 1))) * directions


def bounded_noise(rng: np.random.Generator, n: int, sigma: float, bound: float) -> Points:
    """Gaussian errors, each drawn again until its norm is at most the bound."""
    noise = sigma * rng.standard_normal((n, 3))
    while (outside := np.linalg.norm(noise, axis=1) > bound).any():
        noise[outside] = sigma * rng.standard_normal((outside.sum(), 3))
    return noise


def sample_model(rng: np.random.Generator, n: int, model: Points | Mesh | None = None) -> Points:
    """``n`` different points of a model, resized together to fit [0, 1]^3."""
    if isinstance(model, Mesh):
        points = _on_triangles(rng, n, model)
    else:
        pool = teapot(max(n, 20_000)) if model is None else np.asarray(model, float)
        if n > len(pool):
            raise ValueError(f"the model has {len(pool)} points, fewer than n = {n}: give a Mesh instead.")
        points = pool[rng.choice(len(pool), n, replace=False)]
    low = points.min(axis=0)
    extent = (points.max(axis=0) - low).max()
    return (points - low) / (extent if extent > 0 else 1)


@functools.lru_cache(maxsize=2)
def teapot(n: int) -> Points:
    """``n`` points, uniform on the surface of the teapot; always the same ones, read-only."""
    rng, found = np.random.default_rng(0), np.zeros((0, 3))
    while len(found) < n:
        x = rng.uniform((-1, -0.7, -0.6), (1.1, 0.8, 0.8), (50_000, 3))
        x = x[np.abs(_teapot_distance(x)) < 0.05]
        value, slope = _teapot_distance(x), _teapot_slope(x)
        # A thin shell of constant thickness has as much volume where the surface has area.
        thin = np.abs(value) < 0.02 * np.linalg.norm(slope, axis=1)
        x, value, slope = x[thin], value[thin], slope[thin]
        for _ in range(3):  # Newton's method onto the surface
            x = x - (value / np.sum(slope**2, axis=1))[:, None] * slope
            value, slope = _teapot_distance(x), _teapot_slope(x)
        found = np.concatenate([found, x])
    found = found[:n]
    found.flags.writeable = False
    return found


def _teapot_distance(x: Points) -> Float[np.ndarray, " n"]:
    """Negative inside, zero on the surface: a blend of simple solids, z up, spout along x."""

    def ball(centre: Sequence[float], radii: Any) -> np.ndarray:
        return (np.linalg.norm((x - centre) / radii, axis=1) - 1) * np.min(radii)

    def blend(a: np.ndarray, b: np.ndarray, width: float = 0.07) -> np.ndarray:
        share = np.clip(0.5 + 0.5 * (b - a) / width, 0, 1)
        return b + (a - b) * share - width * share * (1 - share)

    body = ball((0, 0, 0), np.array([0.62, 0.62, 0.48]))
    knob = ball((0, 0, 0.54), 0.1)
    badge = ball((0.1, 0.6, 0.05), 0.12)  # on one side only: not even a mirror image fits
    ring = np.hypot(np.hypot(x[:, 0] + 0.62, x[:, 2] - 0.06) - 0.27, x[:, 1]) - 0.06
    start, along = np.array([0.4, 0, -0.12]), np.array([0.62, 0, 0.52])
    position = np.clip((x - start) @ along / (along @ along), 0, 1)
    spout = np.linalg.norm(x - start - position[:, None] * along, axis=1) - (0.15 - 0.09 * position)
    return functools.reduce(blend, (body, knob, badge, ring, spout))


def _teapot_slope(x: Points, step: float = 1e-5) -> Points:
    central = [_teapot_distance(x + e) - _teapot_distance(x - e) for e in step * np.eye(3)]
    return np.stack(central, axis=1) / (2 * step)


def _on_triangles(rng: np.random.Generator, n: int, mesh: Mesh) -> Points:
    a, b, c = np.moveaxis(np.asarray(mesh.vertices, float)[np.asarray(mesh.faces)], 1, 0)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    face = rng.choice(len(area), n, p=area / area.sum())
    u, v = rng.random((2, n, 1))
    u, v = np.where(u + v > 1, (1 - u, 1 - v), (u, v))  # folds the square onto the triangle
    return a[face] + u * (b - a)[face] + v * (c - a)[face]


def _right_matches(
    rng: np.random.Generator,
    n: int,
    scale: float | tuple[float, float],
    sigma: float,
    noise_bound: float | None,
    model: Points | Mesh | None,
    truth: Pose | None,
) -> SyntheticProblem:
    if n < 1 or sigma < 0:
        raise ValueError(f"received n = {n} and sigma = {sigma}: expected n above 0, sigma 0 or above.")
    bound = BOUND_PER_SIGMA * sigma if noise_bound is None else float(noise_bound)
    if bound < sigma:
        raise ValueError(f"noise_bound {bound} is below sigma {sigma}: most noise would be drawn again.")
    src = sample_model(rng, n, model)
    if truth is None:
        drawn = rng.uniform(*scale) if isinstance(scale, tuple) else scale
        truth = Pose(random_rotation(rng), in_ball(rng, 1, 1.0)[0], np.asarray(drawn, float))
    dst = truth.apply(src) + bounded_noise(rng, n, sigma, bound)
    return SyntheticProblem(src, dst, truth, np.ones(n, bool), bound)


def _with_outliers(
    rng: np.random.Generator,
    right: SyntheticProblem,
    rate: float,
    draw: Callable[[Int[np.ndarray, " k"]], Points],
) -> SyntheticProblem:
    if not 0 <= rate <= 1:
        raise ValueError(f"outlier_rate is {rate}: expected a share from 0 to 1.")
    n = len(right.src)
    wrong = rng.permutation(n)[: round(rate * n)]
    dst, inliers = right.dst.copy(), right.inliers.copy()
    inliers[wrong] = False
    place, todo = right.truth.apply(right.src), wrong
    for _ in range(1000):  # a wrong match that happens to be right is drawn again
        dst[todo] = draw(todo)
        todo = todo[np.linalg.norm(dst[todo] - place[todo], axis=1) <= right.noise_bound]
        if not todo.size:
            return SyntheticProblem(right.src, dst, right.truth, inliers, right.noise_bound)
    raise ValueError(f"noise_bound {right.noise_bound} spans the target: no match could be wrong.")
