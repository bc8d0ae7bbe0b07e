"""No answer depends on the order of the rows, and copies of a row share one fate."""

from __future__ import annotations

from dataclasses import replace

import jax
import numpy as np
import pytest
from oracles import problem_of, random_matches, solve

import teaser_jax as tj
from teaser_jax.problem import clean
from teaser_jax.rows import arrange, in_rows

SETS = ("clique", "translation", "inliers")
FLAT = tj.Settings(refine=False)


def with_copies(seed: int, n: int = 40):
    """Points of which some rows are copies, some with another confidence, and zeros of both signs."""
    rng = np.random.default_rng(seed)
    src, dst = rng.normal(size=(n, 3)), rng.normal(size=(n, 3))
    src[5:9], dst[5:9] = src[4], dst[4]
    src[20], dst[20], src[21], dst[21] = 0.0, 0.0, -0.0, 0.0
    confidence = rng.uniform(size=n)
    confidence[5:9] = confidence[4]
    bound = np.full(n, 0.1)
    bound[6] = 0.05
    confidence[21] = 2 * confidence[20]
    return tj.host_problem(src, dst, noise_bound=bound, confidence=confidence, mask=rng.uniform(size=n) < 0.9)


ARRANGE = jax.jit(lambda problem: arrange(clean(problem)[0]))
ARRANGE_ALL = jax.jit(jax.vmap(lambda problem: arrange(clean(problem)[0])))
PUT = jax.jit(in_rows)


def shuffled(problem: tj.Problem, order: np.ndarray) -> tj.Problem:
    names = ("src", "dst", "noise_bound", "mask", "confidence")
    each = {name: getattr(problem, name)[order] for name in names}
    pairs = problem.pairs if problem.pairs is None else np.argsort(order)[problem.pairs].astype(np.int32)
    return replace(problem, **each, pairs=pairs)


@pytest.mark.parametrize("seed", range(5))
def test_rows_are_arranged_alike_whatever_their_order(seed, x64):
    problem = with_copies(seed)
    rows = ARRANGE(problem)
    used = PUT(problem, rows)
    order = np.random.default_rng(seed).permutation(len(problem.src))
    other = shuffled(problem, order)
    moved = ARRANGE(other)
    again = PUT(other, moved)
    np.testing.assert_array_equal(used.mask, again.mask)
    for name in ("src", "dst", "noise_bound", "confidence"):
        np.testing.assert_array_equal(getattr(used, name)[used.mask], getattr(again, name)[used.mask])
    np.testing.assert_array_equal(rows.place[order][other.mask], moved.place[other.mask])


@pytest.mark.parametrize("seed", range(5))
def test_of_copies_the_most_confident_stands_for_all(seed, x64):
    """And of those the one with the smallest bound; whoever stands for them all is found in numpy."""
    problem = with_copies(seed)
    rows = jax.device_get(ARRANGE(problem))
    used = np.asarray(PUT(problem, rows).mask)
    assert used[: used.sum()].all()  # copies and masked rows come last
    points = np.concatenate([problem.src, problem.dst], axis=1)
    for k in np.flatnonzero(problem.mask):
        copies = np.flatnonzero((points == points[k]).all(axis=1) & problem.mask)
        best = min(copies, key=lambda i: (-problem.confidence[i], problem.noise_bound[i], i))
        assert rows.order[rows.place[k]] == best
        assert rows.alone[k] == (best == k)


def test_a_stack_is_arranged_as_its_problems_are(x64):
    problems = [with_copies(k) for k in range(6)]
    together = ARRANGE_ALL(tj.stack_problems(problems))
    for k, problem in enumerate(problems):
        alone = ARRANGE(problem)
        np.testing.assert_array_equal(together.order[k], alone.order)
        np.testing.assert_array_equal(together.place[k], alone.place)


@pytest.mark.long
@pytest.mark.parametrize("settings", [tj.Settings(), FLAT], ids=["refined", "plain"])
@pytest.mark.parametrize("scale", [1.0, None], ids=["known", "voted"])
def test_the_order_of_the_rows_changes_no_set(settings, scale):
    stack, expected = [], []
    for seed in range(4):
        matches = random_matches(seed, 64, wrong=0.5, noise_bound=0.3, noise=1.4)
        problem = tj.host_problem(matches.src, matches.dst, noise_bound=0.3, scale=scale)
        known = dict(noise_bound=0.3, scale=scale, settings=settings)
        first = tj.register(matches.src, matches.dst, **known)
        under_jit = solve(problem_of(matches, scale=scale), settings)
        for k in range(3):
            order = np.random.default_rng(k).permutation(64)
            other = tj.register(matches.src[order], matches.dst[order], **known)
            moved = shuffled(problem_of(matches, scale=scale), order)
            there = solve(moved, settings)
            for name in SETS:
                ours, theirs = (getattr(x.solution.selection, name) for x in (first, other))
                np.testing.assert_array_equal(ours[order], theirs)
                ours, theirs = (getattr(x.selection, name) for x in (under_jit, there))
                np.testing.assert_array_equal(ours[order], theirs)
            np.testing.assert_array_equal(first.pose.matrix, other.pose.matrix)
            stack.append(shuffled(problem, order))
            expected.append((first, order))
    for solution, (first, order) in zip(tj.solve_batch(stack, settings=settings), expected, strict=True):
        for name in SETS:
            ours = getattr(first.solution.selection, name)[order]
            np.testing.assert_array_equal(ours, getattr(solution.selection, name))


@pytest.mark.long
@pytest.mark.parametrize("what", ["zeros", "a wrong match", "a right match"])
@pytest.mark.parametrize("scale", [1.0, None], ids=["known", "voted"])
def test_a_row_listed_two_hundred_times_is_one_match(what, scale):
    """Padding without a mask, pixels without depth: more rows than there are right ones."""
    matches = random_matches(3, 56, wrong=0.4, noise=0.5)
    rows = {"a wrong match": ~matches.inliers, "a right match": matches.inliers}
    extra = np.zeros((200, 6))
    if what in rows:
        extra += np.concatenate([matches.src, matches.dst], axis=1)[rows[what]][0]
    src, dst = (np.concatenate(x) for x in ((matches.src, extra[:, :3]), (matches.dst, extra[:, 3:])))
    result = tj.register(src, dst, noise_bound=matches.noise_bound, scale=scale)
    assert result.ok
    np.testing.assert_array_equal(result.inliers[:56], matches.inliers)
    assert (result.inliers[56:] == (what == "a right match")).all()
    alone = tj.register(matches.src, matches.dst, noise_bound=matches.noise_bound, scale=scale)
    if what == "a right match":  # which says nothing new: not of the pose, nor of what is proved
        np.testing.assert_allclose(result.pose.matrix, alone.pose.matrix, atol=1e-12)
        assert result.solution.clique_size == alone.solution.clique_size
        for ask in (tj.certify, tj.covariance):
            for x, y in zip(jax.tree.leaves(ask(result)), jax.tree.leaves(ask(alone)), strict=True):
                if np.ndim(x) < 3 and np.shape(x) == np.shape(y):
                    np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-9)
    refitted = tj.refit(result.problem, result.solution.selection)
    np.testing.assert_allclose(refitted.matrix, result.pose.matrix, atol=1e-12)


@pytest.mark.long
def test_copies_take_part_in_pairs_and_in_the_plain_cascade():
    matches = random_matches(5, 48, wrong=0.3, noise=0.5)
    src, dst = (np.concatenate([x, x[:16]]) for x in (matches.src, matches.dst))
    pairs = np.random.default_rng(5).integers(0, 64, (400, 2))
    for settings in (tj.Settings(), FLAT, tj.Settings(refine=False, tim_graph="complete")):
        result = tj.register(src, dst, noise_bound=matches.noise_bound, pairs=pairs, settings=settings)
        chosen = result.solution.selection
        for name in SETS:
            each = getattr(chosen, name)
            np.testing.assert_array_equal(each[48:], each[:16])
        refitted = tj.refit(result.problem, chosen)
        np.testing.assert_allclose(refitted.matrix, result.pose.matrix, atol=1e-12)
        assert result.ok
