"""Matches of one point are one piece of evidence: against a dense oracle, and where a patch meets a point."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import clique_number, length_gaps, random_rotation, solve, unpack

import teaser_jax as tj
from teaser_jax.stages.one_to_one import CROWD, bound_on_rows, one_to_one_graph

N = 40


def graph(src, dst, noise_bound, mask):
    one = jnp.float32(1)
    return one_to_one_graph(src, dst, noise_bound, mask, scale=one, cbar2=one)


ONE, MANY = jax.jit(graph), jax.jit(jax.vmap(graph))
BOUND = jax.jit(bound_on_rows)


def some_matches(seed: int, repeat: bool):
    """Matches that agree as often as not, on points of which some are in many matches, or none is."""
    rng = np.random.default_rng(seed)
    src, dst = rng.normal(size=(2, N, 3))
    if repeat:
        src, dst = src[rng.integers(0, 3, N)], dst[rng.integers(0, 25, N)]
        src[:2], dst[2:4] = [[0.0, 0, 0], [-0.0, 0, 0]], 1.0  # zeros of both signs are one point
    bounds = rng.uniform(0.1, 1.5, N)
    return src.astype(np.float32), dst.astype(np.float32), bounds.astype(np.float32), rng.random(N) < 0.9


def all_edges(src, dst, bounds, mask) -> np.ndarray:
    off = mask[:, None] & mask & ~np.eye(N, dtype=bool)
    return (length_gaps(src, dst) <= bounds[:, None] + bounds) & off


def shared_points(src, dst) -> list[np.ndarray]:
    return [(points[:, None] == points).all(axis=2) for points in (src, dst)]


@pytest.mark.parametrize("repeat", [True, False])
@pytest.mark.parametrize("seed", range(4))
def test_edges_between_matches_of_one_point_go_and_the_bound_stays_one(seed, repeat):
    src, dst, bounds, mask = some_matches(seed, repeat)
    found = ONE(src, dst, bounds, mask)
    dense = all_edges(src, dst, bounds, mask)
    of_src, of_dst = shared_points(src, dst)
    assert (np.sum(dense & of_src, axis=1).max() >= CROWD) == repeat
    wanted = dense & ~of_src & ~of_dst
    np.testing.assert_array_equal(unpack(found.edge_bits, N), wanted)
    apart, together = clique_number(wanted), clique_number(dense)
    bound = int(BOUND(np.int32(apart), found.further, mask))
    assert apart <= together <= bound <= mask.sum()
    if repeat:
        assert together > apart
    else:
        assert bound == apart


@pytest.mark.parametrize("crowd", [CROWD - 1, CROWD])
def test_a_few_matches_of_one_point_stay_as_they_are(crowd):
    """One source in ``crowd`` + 2 matches, of which one is too far off to agree; one target in two."""
    rng = np.random.default_rng(0)
    src, dst = rng.normal(size=(2, N, 3)).astype(np.float32)
    src[: crowd + 2], dst[: crowd + 1] = src[0], dst[0] + rng.uniform(0, 0.01, (crowd + 1, 3))
    dst[crowd + 1] = dst[0] + 5
    dst[-2], src[-2] = dst[-1], src[-1] + 0.01
    bounds, mask = np.full(N, 0.05, np.float32), np.ones(N, bool)
    found = ONE(src, dst, bounds, mask)
    dense = all_edges(src, dst, bounds, mask)
    if crowd < CROWD:
        np.testing.assert_array_equal(unpack(found.edge_bits, N), dense)
        assert not np.any(found.further)
    else:
        assert not unpack(found.edge_bits, N)[: crowd + 1, : crowd + 1].any()
        np.testing.assert_array_equal(found.further, np.full(N, crowd + 1))


def test_a_batch_is_thinned_as_its_problems_are():
    problems = [some_matches(seed, repeat=seed % 2 == 0) for seed in range(4)]
    together = MANY(*(np.stack(x) for x in zip(*problems, strict=True)))
    for k, problem in enumerate(problems):
        alone = ONE(*problem)
        np.testing.assert_array_equal(together.edge_bits[k], alone.edge_bits)
        np.testing.assert_array_equal(together.further[k], alone.further)


def test_the_bound_on_rows_never_exceeds_them():
    mask, further = np.ones(5, bool), np.array([4, 8, 8, 8, 3e38], np.float32)
    assert [int(BOUND(np.int32(k), further, mask)) for k in range(6)] == [0, 5, 5, 5, 5, 5]


def patch_to_point(seed: int, turned_round: bool):
    """105 right matches, 45 wrong ones, and 200 that lead from a patch within the noise to one point."""
    rng = np.random.default_rng(seed)
    truth = tj.Pose(random_rotation(rng), rng.normal(size=3), 1.0)
    src = rng.normal(size=(150, 3))
    dst = truth.apply(src) + rng.uniform(-0.01, 0.01, (150, 3))
    dst[105:] = rng.normal(size=(45, 3))
    patch = rng.normal(size=3) + rng.uniform(-0.01, 0.01, (200, 3))
    more = [patch, np.tile(rng.normal(size=3), (200, 1))]
    if turned_round:
        more.reverse()
    return np.r_[src, more[0]], np.r_[dst, more[1]], truth


@pytest.mark.long
@pytest.mark.parametrize("turned_round", [False, True], ids=["many to one", "one to many"])
def test_a_patch_that_meets_one_point_hides_no_right_matches(turned_round):
    for seed in range(5):
        src, dst, truth = patch_to_point(seed, turned_round)
        result = tj.register(src, dst, noise_bound=0.02)
        assert result.ok
        assert tj.metrics.errors(result, truth).rotation_deg < 0.2
        assert result.inliers[:105].all()
        assert result.inliers.sum() <= 107
        # Of the patch no match can be among the others of a clique but with one of them.
        solution = result.solution
        assert solution.clique_is_maximum
        assert solution.clique_upper_bound >= 200
        assert result.certificate.inlier_gap >= 200 - result.inliers.sum()


@pytest.mark.long
def test_inside_jit_and_in_a_batch_too(x64):
    problems = [tj.host_problem(*patch_to_point(k, k == 1)[:2], noise_bound=0.02) for k in range(2)]
    together = tj.solve_batch(problems)
    for problem, there in zip(problems, together, strict=True):
        alone = solve(problem)
        assert there.ok
        assert alone.ok
        np.testing.assert_array_equal(alone.inliers, there.inliers)
        assert alone.clique_upper_bound == there.clique_upper_bound
