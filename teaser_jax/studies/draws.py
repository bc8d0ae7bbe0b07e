"""How the problems of the studies are drawn, each from a seed, the value that is swept, and a model."""

from __future__ import annotations

from typing import Any

import numpy as np

from teaser_jax import synthetic
from teaser_jax.ground.arrays import Number
from teaser_jax.pose import Pose
from teaser_jax.studies.trials import Model
from teaser_jax.synthetic import SyntheticProblem


def matched(seed: tuple[int, ...], value: Number, model: Model, **known: Any) -> SyntheticProblem:
    """Draw matches by the paper's protocol, of which the share ``value`` is wrong."""
    return synthetic.random_problem(seed, outlier_rate=value, model=model.shape, **known)


def turned(seed: tuple[int, ...], value: Number, model: Model, n: int) -> SyntheticProblem:
    """Draw vectors from the mean of a model and their turned copies, of which the share ``value`` is wrong.

    Wrong vectors keep their length, as those do that pass the test of lengths: others would make the search
    easier than it is after a clique. By chance a wrong one may be right.
    """
    rng = np.random.default_rng((*seed, 1))
    turn = Pose(synthetic.draw_rotation(rng), np.zeros(3), np.asarray(1.0))
    p = matched(seed, 0.0, model, n=n, truth=turn)
    src, inliers = p.src - p.src.mean(axis=0), np.ones(n, bool)
    dst = turn.apply(src) + (p.dst - turn.apply(p.src))
    wrong = rng.permutation(n)[: round(value * n)]
    inliers[wrong] = False
    odd = rng.standard_normal((len(wrong), 3))
    dst[wrong] = odd * (np.linalg.norm(src[wrong], axis=1) / np.linalg.norm(odd, axis=1))[:, None]
    return SyntheticProblem(src, dst, turn, inliers, p.noise_bound)


def moved(seed: tuple[int, ...], value: Number, model: Model, n: int) -> SyntheticProblem:
    """Draw matches that are moved and not turned, of which the share ``value`` is wrong."""
    shift = synthetic.in_ball(np.random.default_rng((*seed, 1)), 1, 1.0)[0]
    return matched(seed, value, model, n=n, truth=Pose(np.eye(3), shift, np.asarray(1.0)))


def all_to_all(seed: tuple[int, ...], value: Number, model: Model) -> SyntheticProblem:
    """Draw a problem without correspondences, of which the share ``value`` overlaps."""
    return synthetic.all_to_all(seed, overlap=value, model=model.shape)


def growing(seed: tuple[int, ...], value: Number, model: Model) -> SyntheticProblem:
    """Draw ``value`` matches, of which 95 % are wrong."""
    return matched(seed, 0.95, model, n=int(value))
