"""Random registration problems with known answers: the paper's protocol (section XI-A) and relatives.

Everything is numpy on the host and follows from the seed alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from teaser_jax import so3
from teaser_jax.ground.arrays import Number
from teaser_jax.ground.checks import shown, whole_number
from teaser_jax.ground.numbers import NumberRule, checked_number
from teaser_jax.pose import Pose
from teaser_jax.synthetic.models import Points, Seed, Shape, generator, sample_model

SIGMA = 0.01
BOUND_PER_SIGMA = 5.54  # exceeded by one in 10^6 Gaussian errors of three dimensions


@dataclass(frozen=True, eq=False)
class SyntheticProblem:
    """A ``SyntheticProblem`` holds matched points and the truth about them.

    Attributes:
        src, dst: Matched points, row i with row i; the model fits [0, 1]^3 [length].
        truth: The pose behind the right matches, ``T_dst_src``.
        inliers: The right matches; every other one misses the truth by more than the bound.
        noise_bound: beta, the largest error of a right match [length].
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
    outlier_rate: Number = 0.95,
    scale: Number | tuple[Number, Number] = 1.0,
    sigma: Number = SIGMA,
    noise_bound: Number | None = None,
    radius: Number = 5.0,
    model: Shape = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """Draw a problem by the paper's protocol: wrong matches are uniform in a ball.

    The target is s R a + t with R uniform on SO(3) and t uniform in the unit ball. Noise is
    Gaussian, drawn again until its norm is at most the bound. An ``outlier_rate`` of 1 leaves no
    right match at all.

    Args:
        seed: Anything ``numpy.random.default_rng`` takes; the same seed gives the same problem.
        n: Number of matches.
        outlier_rate: Share of wrong matches, rounded to whole matches.
        scale: The scale, or the range from which it is drawn; the paper's is (1, 5) [-].
        sigma: Standard deviation of the noise of each coordinate [length].
        noise_bound: beta [length]; None: 5.54 sigma, as in the paper.
        radius: Radius of the ball of wrong targets [length]. A smaller one makes more chance agreements.
        model: (m, 3) points, drawn without replacement, or triangles; None: the teapot. Resized to
            fit [0, 1]^3.
        truth: A pose to use instead of a random one; its scale takes the place of ``scale``.

    Raises:
        ValueError: If a rate or size makes no sense, or the model has fewer than ``n`` points.

    References: section XI-A.
    """
    rng = generator(seed)
    checked_number("radius", radius, NumberRule(above=0))
    right = _right_matches(rng, n, scale, sigma, noise_bound, model, truth)
    return _with_outliers(rng, right, outlier_rate, lambda rows: in_ball(rng, len(rows), radius))


def descriptor_problem(
    seed: Seed,
    *,
    n: int = 1000,
    outlier_rate: Number = 0.95,
    hubs: Number = 0.05,
    scale: Number | tuple[Number, Number] = 1.0,
    sigma: Number = SIGMA,
    noise_bound: Number | None = None,
    model: Shape = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """Draw a problem as descriptor matching makes it: wrong matches lie on the target, many to one.

    A descriptor errs towards a few points that look like everything. Wrong matches share
    ``hubs * n`` points of the target among them, so both the density of chance agreements and
    the number of repeated rows are far higher than in the paper's protocol.

    Args:
        seed, n, outlier_rate, scale, sigma, noise_bound, model, truth: As in ``random_problem``.
        hubs: Number of points that attract wrong matches, as a share of n; 1: nearly one to one.

    Raises:
        ValueError: As ``random_problem``; and if the bound spans the target, so that no match could be wrong.
    """
    rng = generator(seed)
    checked_number("hubs", hubs, NumberRule(above=0))
    right = _right_matches(rng, n, scale, sigma, noise_bound, model, truth)
    attractive = right.dst[rng.permutation(n)[: max(2, round(hubs * n))]]
    return _with_outliers(
        rng, right, outlier_rate, lambda rows: attractive[rng.integers(len(attractive), size=len(rows))]
    )


def all_to_all(
    seed: Seed,
    *,
    n: int = 100,
    overlap: Number = 1.0,
    sigma: Number = 0.01 / BOUND_PER_SIGMA,
    noise_bound: Number | None = None,
    model: Shape = None,
    truth: Pose | None = None,
) -> SyntheticProblem:
    """Draw a problem without correspondences: every source point matched with every target point.

    The target is a part of the moved model.

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
    if checked_number("overlap", overlap, NumberRule(above=0)) > 1:
        raise ValueError(f"overlap is {overlap}: expected a share above 0, at most 1.")
    rng = generator(seed)
    whole = _right_matches(rng, n, 1.0, sigma, noise_bound, model, truth)
    kept = rng.permutation(n)[: max(1, round(overlap * n))]
    i, j = np.repeat(np.arange(n), len(kept)), np.tile(kept, n)
    return SyntheticProblem(whole.src[i], whole.dst[j], whole.truth, i == j, whole.noise_bound)


def draw_rotation(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    """Draw a rotation uniformly from SO(3)."""
    return np.asarray(so3.rotation_from_quat(rng.standard_normal(4)))


def in_ball(rng: np.random.Generator, n: int, radius: Number) -> Points:
    """Draw points uniformly from the ball of a radius [length] around the origin."""
    directions = rng.standard_normal((n, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return radius * np.cbrt(rng.random((n, 1))) * directions


def bounded_noise(rng: np.random.Generator, n: int, sigma: Number, bound: Number) -> Points:
    """Draw Gaussian errors of three dimensions [length], each again until its norm is at most the bound."""
    noise = sigma * rng.standard_normal((n, 3))
    while (outside := np.linalg.norm(noise, axis=1) > bound).any():
        noise[outside] = sigma * rng.standard_normal((outside.sum(), 3))
    return noise


def _right_matches(
    rng: np.random.Generator,
    n: int,
    scale: Number | tuple[Number, Number],
    sigma: Number,
    noise_bound: Number | None,
    model: Shape,
    truth: Pose | None,
) -> SyntheticProblem:
    whole_number("n", n, 1, what="the number of points")
    checked_number("sigma", sigma, NumberRule(least=0))
    _check_scale(scale)
    if noise_bound is not None:
        checked_number("noise_bound", noise_bound, NumberRule(above=0))
    bound = float(BOUND_PER_SIGMA * sigma if noise_bound is None else noise_bound)
    if bound < sigma:
        raise ValueError(f"noise_bound {bound} is below sigma {sigma}: most noise would be drawn again.")
    src = sample_model(rng, n, model)
    if truth is None:
        drawn = rng.uniform(*scale) if isinstance(scale, tuple) else scale
        truth = Pose(draw_rotation(rng), in_ball(rng, 1, 1.0)[0], np.asarray(drawn, float))
    dst = truth.apply(src) + bounded_noise(rng, n, sigma, bound)
    return SyntheticProblem(src, dst, truth, np.ones(n, bool), bound)


def _check_scale(scale: Any) -> None:
    """Raise ValueError unless this is a scale above 0, or a range of them."""
    ends = scale if isinstance(scale, tuple) else (scale, scale)
    numbers = [checked_number("scale", each, NumberRule(above=0)) for each in ends]
    if len(numbers) != 2 or numbers[0] > numbers[1]:
        raise ValueError(f"scale is {shown(scale)}: expected one number, or a range (low, high).")


def _with_outliers(
    rng: np.random.Generator,
    right: SyntheticProblem,
    rate: Number,
    draw: Callable[[Int[np.ndarray, " k"]], Points],
) -> SyntheticProblem:
    if checked_number("outlier_rate", rate, NumberRule(least=0)) > 1:
        raise ValueError(f"outlier_rate is {rate}: expected a share from 0 to 1.")
    n = len(right.src)
    wrong = rng.permutation(n)[: round(rate * n)]
    dst, inliers = right.dst.copy(), right.inliers.copy()
    inliers[wrong] = False
    place, todo = right.truth.apply(right.src), wrong
    for _ in range(1000):  # a wrong match that happens to be right is drawn again
        dst[todo] = draw(todo)
        with np.errstate(over="ignore"):  # infinitely far is not near
            todo = todo[np.linalg.norm(dst[todo] - place[todo], axis=1) <= right.noise_bound]
        if not todo.size:
            return SyntheticProblem(right.src, dst, right.truth, inliers, right.noise_bound)
    raise ValueError(f"noise_bound {right.noise_bound} spans the target: no match could be wrong.")
