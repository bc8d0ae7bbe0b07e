"""Slow and readable answers to hold the fast ones against, and small random problems."""

from __future__ import annotations

import warnings
from dataclasses import replace
from itertools import combinations
from types import SimpleNamespace
from typing import NamedTuple

import jax
import networkx as nx
import numpy as np
from scipy.spatial.transform import Rotation

import teaser_jax as tj

# Compiled once for all test files, of one size where sizes do not matter: most of a test's time is XLA's.
_solve = jax.jit(tj.solve)
_solve_stack = jax.jit(jax.vmap(tj.solve))
refit = jax.jit(tj.refit)
DEFAULT = tj.Settings()
STACK = 4  # problems in a stack


def solve(problem: tj.Problem, settings: tj.Settings = DEFAULT) -> tj.Solution:
    """``tj.solve`` under jit, its answer as numpy."""
    return jax.device_get(_solve(problem, settings))


def solve_stack(problems: tj.Problem) -> tj.Solution:
    """``tj.solve`` under jit and vmap, its answers as numpy."""
    return jax.device_get(_solve_stack(problems))


def inputs_of(problem: tj.Problem) -> dict:
    """The arrays of a problem that a pose has derivatives in."""
    names = ("src", "dst", "noise_bound", "confidence") + (() if problem.scale is None else ("scale",))
    return {name: getattr(problem, name) for name in names}


def nothing_of(problem: tj.Problem) -> dict:
    """A direction in which nothing moves."""
    return {name: np.zeros(np.shape(x), np.asarray(x).dtype) for name, x in inputs_of(problem).items()}


def both_ways(read, problem: tj.Problem, direction, cotangent):
    """The derivative of a pose along a direction, forward; and the gradient of a combination, reverse."""
    inputs = inputs_of(problem)
    _, along = jax.linearize(lambda inputs: read(replace(problem, **inputs)).matrix, inputs)
    return along(direction), jax.linear_transpose(along, inputs)(cotangent)[0]


@jax.jit
def derivatives(problem: tj.Problem, settings: tj.Settings, direction, cotangent):
    """``both_ways`` of the pose of ``tj.solve``."""
    return both_ways(lambda p: tj.solve(p, settings).pose, problem, direction, cotangent)


def assert_finite(solution) -> None:
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(solution))


class Matches(NamedTuple):
    """A random problem and its truth."""

    src: np.ndarray
    dst: np.ndarray
    noise_bound: float
    truth: tj.Pose
    inliers: np.ndarray


def in_ball(rng: np.random.Generator, n: int, radius: float) -> np.ndarray:
    """Points drawn uniformly from a ball."""
    direction = rng.normal(size=(n, 3))
    length = radius * rng.uniform(size=(n, 1)) ** (1 / 3)
    return length * direction / np.linalg.norm(direction, axis=1, keepdims=True)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    return Rotation.from_quat(rng.normal(size=4)).as_matrix()


def random_pose(rng: np.random.Generator, scale: float = 1.0) -> tj.Pose:
    return tj.Pose(random_rotation(rng), rng.uniform(-1, 1, 3), np.float64(scale))


def random_matches(
    seed: int,
    n: int = 32,
    *,
    wrong: float = 0.5,
    noise_bound: float = 0.05,
    noise: float = 1.0,
    scale: float = 1.0,
) -> Matches:
    """Matches in a cube; right ones off by up to ``noise`` times the bound, wrong ones anywhere within 5."""
    rng = np.random.default_rng(seed)
    src = rng.uniform(-1, 1, (n, 3))
    truth = random_pose(rng, scale)
    dst = truth.apply(src) + in_ball(rng, n, noise * noise_bound)
    lost = rng.permutation(n) < round(wrong * n)
    dst[lost] = in_ball(rng, int(lost.sum()), 5.0)
    return Matches(src, dst, noise_bound, truth, ~lost)


def problem_of(matches: Matches, **known) -> tj.Problem:
    return tj.make_problem(matches.src, matches.dst, **{"noise_bound": matches.noise_bound, **known})


def pose_error(estimate: tj.Pose, truth: tj.Pose) -> float:
    """The largest difference of any entry of the two matrices."""
    return float(np.max(np.abs(np.asarray(estimate.matrix) - np.asarray(truth.matrix))))


def joint_residuals(pose: tj.Pose, src, dst, noise_bound) -> np.ndarray:
    """Distance of each match from the pose, in units of its bound."""
    pose = jax.tree.map(np.asarray, pose)
    return np.linalg.norm(dst - pose.apply(src), axis=1) / noise_bound


# --- truncated least squares for one number -----------------------------------------------------


def consensus_sets(values, bounds, cbar2) -> np.ndarray:
    """Every consensus set of Theorem 7 as a row: at interval ends, around them and between them."""
    reach = np.sqrt(cbar2) * bounds
    ends = np.sort(np.concatenate([values - reach, values + reach]))
    nearby = [ends, np.nextafter(ends, -np.inf), np.nextafter(ends, np.inf), (ends[1:] + ends[:-1]) / 2]
    agree = np.abs(np.concatenate(nearby)[:, None] - values) <= reach
    return np.unique(agree[agree.any(axis=1)], axis=0)


def tls_cost(x: float, values, bounds, cbar2) -> float:
    return float(np.sum(np.minimum((x - values) ** 2 / bounds**2, cbar2)))


def mean_of(members, values, bounds) -> float:
    """The weighted mean (14) of a consensus set."""
    return float(np.average(values[members], weights=bounds[members] ** -2.0))


def set_cost(members, values, bounds, cbar2) -> float:
    """What a consensus set costs at its mean, all others being outliers."""
    x = mean_of(members, values, bounds)
    return float(np.sum((x - values[members]) ** 2 / bounds[members] ** 2) + cbar2 * np.sum(~members))


def tls_by_enumeration(values, bounds, cbar2, interval=(-np.inf, np.inf)) -> float:
    """The least cost of any consensus set whose mean lies in the interval; infinite without one.

    Without an interval that is the global minimum of the truncated cost (Theorem 7).
    """
    sets = consensus_sets(values, bounds, cbar2)
    inside = [s for s in sets if interval[0] <= mean_of(s, values, bounds) <= interval[1]]
    return min((set_cost(s, values, bounds, cbar2) for s in inside), default=np.inf)


def largest_consensus(values, bounds, cbar2, interval=(-np.inf, np.inf)) -> int:
    """The size of the largest consensus set whose mean lies in the interval."""
    sets = consensus_sets(values, bounds, cbar2)
    means = [mean_of(s, values, bounds) for s in sets]
    sizes = [s.sum() for s, x in zip(sets, means, strict=True) if interval[0] <= x <= interval[1]]
    return int(max(sizes, default=0))


# --- graphs -------------------------------------------------------------------------------------


def random_graph(rng: np.random.Generator, n: int, density: float, planted: int = 0) -> np.ndarray:
    """A symmetric boolean matrix without loops, with a planted clique on random vertices."""
    upper = np.triu(rng.uniform(size=(n, n)) < density, 1)
    dense = upper | upper.T
    inside = rng.permutation(n) < planted
    dense |= inside[:, None] & inside
    np.fill_diagonal(dense, False)
    return dense


def pack(dense: np.ndarray) -> np.ndarray:
    """Boolean rows as 32-bit words: bit t of word j is column 32 j + t."""
    rows, n = dense.shape
    packed = np.zeros((rows, -(-n // 32)), np.uint32)
    for column in range(n):
        packed[:, column // 32] |= dense[:, column].astype(np.uint32) << np.uint32(column % 32)
    return packed


def unpack(packed, n: int) -> np.ndarray:
    """The inverse of ``pack``."""
    columns = np.arange(n)
    return (np.asarray(packed)[:, columns // 32] >> (columns % 32).astype(np.uint32) & 1).astype(bool)


def is_clique(dense: np.ndarray, members) -> bool:
    inside = dense[np.ix_(members, members)]
    return bool(np.all(inside | np.eye(len(inside), dtype=bool)))


def clique_number(dense: np.ndarray) -> int:
    """The size of the largest clique, from networkx."""
    return nx.max_weight_clique(nx.from_numpy_array(dense), weight=None)[1]


def edges_in_integers(src: np.ndarray, dst: np.ndarray, tolerance: int) -> np.ndarray:
    """``| |b_ij| - |a_ij| | <= tolerance`` for integer points, without any rounding.

    With integer squared lengths A and B: (A - B)^2 <= d^2 (2 (A + B) - d^2), or A + B <= d^2.
    """
    square = lambda x: np.sum((x[:, None] - x[None]) ** 2, axis=2).astype(object)
    a, b, d2 = square(src), square(dst), tolerance**2
    edge = ((a - b) ** 2 <= d2 * (2 * (a + b) - d2)) | (a + b <= d2)
    return edge.astype(bool) & ~np.eye(len(src), dtype=bool)


def length_gaps(src, dst, scale: float = 1.0) -> np.ndarray:
    """``| |b_ij| - s |a_ij| |`` of all pairs in extended precision."""

    def lengths(x: np.ndarray) -> np.ndarray:
        x = np.asarray(x, np.longdouble)
        return np.sqrt(np.sum((x[:, None] - x[None]) ** 2, axis=2))

    return np.abs(lengths(dst) - np.longdouble(scale) * lengths(src))


BOUND = 0.0554  # of vectors with noise of deviation 0.01 that is cut off there


def draw_vectors(
    seed, k: int, wrong: float, sigma: float = 0.01
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vectors of a unit cube, wrong ones of the right length, and the rotation behind the others."""
    rng = np.random.default_rng(seed)
    src, rotation = rng.uniform(-0.5, 0.5, (k, 3)), random_rotation(rng)
    dst = src @ rotation.T + np.clip(sigma * rng.normal(size=(k, 3)), -3 * sigma, 3 * sigma)
    bad = rng.permutation(k)[: round(wrong * k)]
    odd = rng.normal(size=(len(bad), 3))
    dst[bad] = odd * (np.linalg.norm(src[bad], axis=1) / np.linalg.norm(odd, axis=1))[:, None]
    return src, dst, rotation


def tampered(certificate, **claims) -> SimpleNamespace:
    """What has the fields of a certificate and claims something else, which the record itself may refuse."""
    return SimpleNamespace(**{**vars(certificate), **claims})


def turned(rotation: np.ndarray, degrees: float, seed=0) -> np.ndarray:
    """The rotation, turned about a random axis."""
    axis = np.random.default_rng(seed).normal(size=3)
    return rotation @ Rotation.from_rotvec(np.deg2rad(degrees) * axis / np.linalg.norm(axis)).as_matrix()


def rotation_cost(src, dst, rotation, bound=BOUND) -> float:
    """The truncated cost (12) in units of the bound."""
    return float(np.minimum(np.sum(((dst - src @ rotation.T) / bound) ** 2, axis=1), 1).sum())


def best_rotation(src, dst, bound=BOUND) -> tuple[np.ndarray, float]:
    """The optimum of (12), by fits to all of up to three vectors, each fitted to its own inliers again."""

    def aligned(members) -> np.ndarray:
        with warnings.catch_warnings():  # one vector, or two in line, leave a turn free: any will do
            warnings.simplefilter("ignore", UserWarning)
            return Rotation.align_vectors(dst[members], src[members])[0].as_matrix()

    best, least = np.eye(3), rotation_cost(src, dst, np.eye(3), bound)
    turning = np.flatnonzero(np.any(src != 0, axis=1) & np.any(dst != 0, axis=1))
    for members in [m for size in (1, 2, 3) for m in combinations(turning, size)]:
        rotation = aligned(list(members))
        for _ in range(20):
            now = rotation_cost(src, dst, rotation, bound)
            if now < least:
                best, least = rotation, now
            within = np.sum((dst - src @ rotation.T) ** 2, axis=1) <= bound**2
            if not within[turning].any():
                break
            fitted = aligned(within)
            if np.abs(fitted - rotation).max() < 1e-13:
                break
            rotation = fitted
    return best, least
