"""What is packed on the device comes out the same on the host."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from oracles import solve

import teaser_jax as tj
from teaser_jax.packing import choices_of, pack_problem, pack_solution, unpack_problem, unpack_solution
from teaser_jax.problem import pad_problem, read_problem

CASES = {
    "chain": {},
    "complete": dict(settings=tj.Settings(tim_graph="complete")),
    "voted scale": dict(scale=None),
    "pairs": dict(pairs=np.stack(np.triu_indices(32, 1), axis=1)),
    "as many pairs as points": dict(pairs=np.stack([np.arange(32), np.roll(np.arange(32), 1)], axis=1)),
}


@pytest.mark.long
@pytest.mark.parametrize("case", CASES)
def test_nothing_is_lost(case, x64):
    known = dict(CASES[case])
    settings = known.pop("settings", tj.Settings())
    drawn = tj.synthetic.random_problem(0, n=32, outlier_rate=0.3)
    problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, **known)
    solution = solve(problem, settings)
    found = unpack_solution(jax.device_get(jax.jit(pack_solution)(solution)))
    for before, after in zip(jax.tree.leaves(solution), jax.tree.leaves(found), strict=True):
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    assert jax.tree.structure(solution) == jax.tree.structure(found)
    assert isinstance(dataclasses.replace(found), tj.Solution)


@pytest.mark.parametrize("scale", [1.5, None])
@pytest.mark.parametrize("pairs", [None, [[0, 1], [2, 3]]])
def test_a_problem_arrives_as_it_was(scale, pairs, x64):
    drawn = tj.synthetic.random_problem(0, n=5, outlier_rate=0.0)
    problem = read_problem(
        drawn.src, drawn.dst, noise_bound=np.arange(1, 6) / 10, confidence=np.arange(5) / 4,
        mask=np.arange(5) != 3, cbar2=2.0, scale=scale, pairs=pairs,
    )  # fmt: skip
    settings = tj.Settings(
        clique_nodes=7, gnc_factor=1.7, gnc_tolerance=1e-3, scale_range=(0.5, 3.0), refine=False
    )
    m = None if pairs is None else 4
    sent, choices = pack_problem(problem, settings, 8, m), choices_of(settings)
    assert not jax.tree.leaves(choices)
    assert choices == choices_of(
        tj.Settings(clique_nodes=9, refine=False)
    )  # numbers and budgets compile nothing
    found, numbers = jax.jit(unpack_problem)(sent, choices)
    # Padding is masked, so its bounds do not matter.
    expected = pad_problem(problem, 8, m)
    expected.noise_bound[5:] = 0
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert jax.tree.map(float, numbers) == dataclasses.replace(settings, clique_nodes=1, clique_seconds=0.0)
    np.testing.assert_array_equal(sent.mask, expected.mask)
