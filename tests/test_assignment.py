"""Pairs that have each point once, at the least truncated cost."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest

from teaser_jax.stages.assignment import least_cost_pairs


def cost(r2, pairs, cbar2):
    """Sum the truncated cost: a source point without a partner costs as much as an outlier."""
    return sum(r2[i, j] for i, j in pairs) + cbar2 * (len(r2) - len(pairs))


@pytest.mark.parametrize("seed", range(5))
def test_no_other_choice_costs_less(seed):
    r2 = np.random.default_rng(seed).exponential(1.5, (4, 5))
    pairs = least_cost_pairs(r2, 1.0)
    assert len(set(pairs[:, 0])) == len(set(pairs[:, 1])) == len(pairs)
    least = min(sum(min(r2[i, j], 1.0) for i, j in enumerate(choice)) for choice in permutations(range(5), 4))
    assert cost(r2, pairs, 1.0) == pytest.approx(least)


def test_what_is_no_match_or_too_far_apart_has_no_partner():
    r2 = np.array([[np.inf, 0.5, np.inf], [np.inf, np.inf, 4.0]])
    np.testing.assert_array_equal(least_cost_pairs(r2, 1.0), [[0, 1]])


def test_of_two_that_want_one_point_the_nearer_has_it():
    np.testing.assert_array_equal(least_cost_pairs(np.array([[0.4], [0.1]]), 1.0), [[1, 0]])
