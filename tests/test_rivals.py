"""Several answers to one set of matches: planted ones are found, in order, whatever else is there."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random_pose

from teaser_jax.stages.rivals.evidence import evidence
from teaser_jax.stages.rivals.search import Rivals, RivalSearch, find_rivals
from teaser_jax.stages.rivals.seeds import SHORT, TIGHT, tight_graph, triangles

SEARCH = RivalSearch(answers=4, seeds=64)
BOUND = 0.02
LARGE, SMALL, WRONG = 30, 25, 82  # six in ten are wrong


def planted(seed: int = 0, dtype=np.float32):
    """Matches of two poses among wrong ones, shuffled: source, target, which pose each has, and the poses."""
    rng = np.random.default_rng(seed)
    n = LARGE + SMALL + WRONG
    src, dst = rng.uniform(-1, 1, (n, 3)), rng.uniform(-2, 2, (n, 3))
    poses = [random_pose(rng), random_pose(rng)]
    which = np.repeat([0, 1, 2], [LARGE, SMALL, WRONG])
    for k, pose in enumerate(poses):
        noise = rng.uniform(-1, 1, (n, 3)) * BOUND / 4
        dst[which == k] = (pose.apply(src) + noise)[which == k]
    order = rng.permutation(n)
    return src[order].astype(dtype), dst[order].astype(dtype), which[order], poses


def found_by(src, dst, mask=None, scale: float = 1.0, first=None, search: RivalSearch = SEARCH) -> Rivals:
    mask = np.ones(len(src), bool) if mask is None else mask
    bounds, scale = np.full(len(src), BOUND, src.dtype), np.asarray(scale, src.dtype)
    inputs = [jnp.asarray(x) for x in (src, dst, bounds, mask)]
    first = None if first is None else jnp.asarray(first)
    return jax.device_get(find_rivals(*inputs, scale=jnp.asarray(scale), search=search, first=first))


def check_planted(found: Rivals, which: np.ndarray, poses: list, tolerance: float = 0.01) -> None:
    assert found.valid[:2].all()
    assert (np.diff(found.score) <= 0).all()
    for k, pose in enumerate(poses):
        assert found.inliers[k][which == k].mean() > 0.95
        assert found.inliers[k][which != k].mean() < 0.05
        np.testing.assert_allclose(found.pose.rotation[k], pose.rotation, atol=tolerance)
        np.testing.assert_allclose(found.pose.translation[k], pose.translation, atol=tolerance)


def check_sane(found: Rivals) -> None:
    """What is not valid holds nothing, and everything is a number."""
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((found.pose, found.score)))
    assert not found.inliers[~found.valid].any()
    assert not found.score[~found.valid].any()
    assert (found.inliers[found.valid].sum(axis=1) >= 3).all()


@pytest.mark.parametrize("seed", range(3))
def test_two_planted_poses_are_found_the_larger_first(seed: int):
    src, dst, which, poses = planted(seed)
    found = found_by(src, dst)
    check_planted(found, which, poses)
    check_sane(found)


def test_in_float64(x64):
    src, dst, which, poses = planted(dtype=np.float64)
    found = found_by(src, dst)
    assert found.score.dtype == np.float64
    check_planted(found, which, poses)


def test_a_scale_is_passed_in():
    src, dst, which, poses = planted()
    found = found_by(src / 3, dst, scale=3.0)
    assert (found.pose.scale == 3).all()
    check_planted(found, which, poses)


def test_permuted_rows_give_the_same_sets():
    src, dst, _, _ = planted()
    order = np.random.default_rng(5).permutation(len(src))
    plain, mixed = found_by(src, dst), found_by(src[order], dst[order])
    np.testing.assert_array_equal(plain.inliers[:2][:, order], mixed.inliers[:2])


def test_masks_and_padding_change_nothing():
    src, dst, which, _ = planted()
    plain = found_by(src, dst)
    rows = np.sort(np.random.default_rng(1).permutation(len(src) + 40)[: len(src)])
    mask = np.zeros(len(src) + 40, bool)
    mask[rows] = True
    padded = [np.full((len(mask), 3), np.nan, np.float32) for _ in range(2)]
    for each, points in zip(padded, (src, dst), strict=True):
        each[rows] = points
    found = found_by(*padded, mask)
    np.testing.assert_array_equal(found.valid, plain.valid)
    np.testing.assert_array_equal(found.inliers[:2][:, rows], plain.inliers[:2])
    assert not found.inliers[:, ~mask].any()
    np.testing.assert_allclose(found.pose.matrix[:2], plain.pose.matrix[:2], atol=1e-5)


def test_the_first_rows_start_and_all_count():
    src, dst, which, poses = planted()
    order = np.argsort(which == 1, kind="stable")  # the smaller pose last
    found = found_by(src[order], dst[order], search=RivalSearch(answers=4, seeds=64, rows=LARGE + WRONG))
    assert found.inliers[0].sum() >= LARGE - 1
    assert found.inliers[:, -SMALL:].mean() < 0.2


def test_a_set_given_is_an_answer_though_no_seed_starts_there():
    src, dst, which, poses = planted()
    only_one = RivalSearch(answers=4, seeds=1)
    assert found_by(src, dst, search=only_one).valid.sum() == 1
    found = found_by(src, dst, first=(which == 1)[None], search=only_one)
    check_planted(found, which, poses)


def test_a_batch_is_a_loop():
    problems = [planted(seed)[:2] for seed in range(3)]
    src, dst = (np.stack(x) for x in zip(*problems, strict=True))
    mask, bounds = np.ones(src.shape[:2], bool), np.full(src.shape[:2], BOUND, np.float32)
    run = lambda a, b, c, d: find_rivals(a, b, c, d, scale=jnp.float32(1), search=SEARCH)
    many = jax.device_get(jax.vmap(run)(*map(jnp.asarray, (src, dst, bounds, mask))))
    for k in range(3):
        one = found_by(src[k], dst[k])
        np.testing.assert_array_equal(many.inliers[k][:2], one.inliers[:2])
        np.testing.assert_allclose(many.score[k][:2], one.score[:2], rtol=1e-4)
        np.testing.assert_allclose(many.pose.matrix[k][:2], one.pose.matrix[:2], atol=1e-5)


def test_twice_the_same_bits():
    src, dst, _, _ = planted()
    jax.tree.map(np.testing.assert_array_equal, found_by(src, dst), found_by(src, dst))


@pytest.mark.parametrize("n", [0, 1, 2, 3])
def test_few_matches(n: int):
    src, dst, _, _ = planted()
    check_sane(found_by(src[:n], dst[:n]))


def test_no_match_can_be_used():
    src, dst, _, _ = planted()
    found = found_by(src, dst, mask=np.zeros(len(src), bool))
    assert not found.valid.any()
    check_sane(found)


def test_all_wrong_and_all_the_same_point():
    src, dst, which, _ = planted()
    wrong = found_by(src, dst, mask=which == 2)
    check_sane(wrong)
    assert wrong.score.max() < SMALL
    check_sane(found_by(np.zeros_like(src), np.zeros_like(dst)))


def test_all_right_is_one_answer():
    src, dst, which, poses = planted()
    found = found_by(src, dst, mask=which == 0)
    np.testing.assert_array_equal(found.valid, [True, False, False, False])
    np.testing.assert_array_equal(found.inliers[0], which == 0)


def test_triangles_by_counting():
    src, dst, _, _ = planted()
    n = len(src)
    mask = np.arange(n) % 7 != 0
    inputs = src, dst, np.full(n, BOUND, np.float32), mask
    edges = np.array(tight_graph(*map(jnp.asarray, inputs)))
    counts = np.array(triangles(jnp.asarray(edges)))
    for i in range(0, n, 9):
        for j in range(n):
            a, b = (np.linalg.norm(x[i].astype(float) - x[j]) for x in (src, dst))
            if abs(abs(a - b) - TIGHT * BOUND) > 1e-4:
                agree = abs(a - b) <= TIGHT * BOUND and min(a, b) > SHORT * BOUND
                assert edges[i, j] == (agree and mask[i] and mask[j])
            both = sum(edges[i, k] and edges[j, k] for k in range(n))
            assert counts[i, j] == (both if edges[i, j] else 0)


def test_evidence_counts_places_once():
    src = np.repeat(np.eye(3, dtype=np.float32), [1, 5, 1], axis=0)
    dst = np.concatenate([np.eye(3)[:2], np.full((5, 3), 4.0)]).astype(np.float32)
    bounds, mask = np.full(7, BOUND, np.float32), np.array([True] * 6 + [False])
    r2 = np.array([[0.0] * 7, [2.25] * 7, [9.0] * 7], np.float32)
    found = np.array(evidence(*map(jnp.asarray, (r2, src, dst, bounds, mask))))
    # Two places of the source, three of the target: at both radii, and six inliers on the spot; at one.
    np.testing.assert_allclose(found, [2 + 2 + 6, 2, 0])
