"""What is packed on the device comes out the same on the host."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest
from oracles import solve

import teaser_jax as tj
from teaser_jax.engine.packing import pack, pack_problem, unpack, unpack_problem, unpack_settings
from teaser_jax.engine.sizes import Size
from teaser_jax.problem import pad_problem, read_problem
from teaser_jax.settings import ExactClique, Gnc, ScaleVote

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
    found = unpack(jax.device_get(jax.jit(pack)(solution)))
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
        clique=ExactClique(nodes=7), rotation=Gnc(factor=1.7, tolerance=1e-3),
        scale_search=ScaleVote((0.5, 3.0)), refine=False,
    )  # fmt: skip
    m = None if pairs is None else 4
    sent, choices = (
        pack_problem(problem, settings, Size(8, m, scale is not None)),
        jax.tree.structure(settings),
    )
    # Numbers and budgets compile nothing, whole numbers neither.
    assert choices == jax.tree.structure(tj.Settings(clique=ExactClique(nodes=9, seconds=1), refine=False))
    found = jax.jit(unpack_problem)(sent)
    numbers = jax.jit(unpack_settings, static_argnums=1)(sent, choices)
    # Padding is masked, so its bounds do not matter.
    expected = pad_problem(problem, 8, m)
    expected.noise_bound[5:] = 0
    jax.tree.map(np.testing.assert_array_equal, found, expected)
    assert jax.tree.structure(numbers) == choices
    np.testing.assert_array_equal(jax.tree.leaves(numbers), jax.tree.leaves(settings))
    np.testing.assert_array_equal(sent.mask, expected.mask)


@pytest.mark.long
def test_a_leaf_that_stands_in_a_record_twice_travels_once(x64):
    """The inliers are a field of the solution and of its selection."""
    drawn = tj.synthetic.random_problem(0, n=32, outlier_rate=0.3)
    problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound)
    sent = jax.jit(lambda p: pack(tj.solve(p)))(problem)
    assert [mask.shape for mask in sent.masks] == [(32, 6)]
    assert [x.shape for x in sent.others] == [(32,), (32,)]  # the order of the rows, and back
