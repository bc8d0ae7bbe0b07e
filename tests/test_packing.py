"""What is packed on the device comes out the same on the host."""

from __future__ import annotations

import dataclasses

import jax
import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.packing import pack_solution, unpack_solution

CASES = {
    "chain": {},
    "complete": dict(settings=tj.Settings(tim_graph="complete")),
    "voted scale": dict(scale=None),
    "pairs": dict(pairs=np.stack(np.triu_indices(32, 1), axis=1)),
    "as many pairs as points": dict(pairs=np.stack([np.arange(32), np.roll(np.arange(32), 1)], axis=1)),
}


@pytest.mark.parametrize("case", CASES)
def test_nothing_is_lost(case, x64):
    known = dict(CASES[case])
    settings = known.pop("settings", tj.Settings())
    drawn = tj.synthetic.random_problem(0, n=32, outlier_rate=0.3)
    problem = tj.make_problem(drawn.src, drawn.dst, noise_bound=drawn.noise_bound, **known)
    solution = jax.jit(tj.solve)(problem, settings)
    found = unpack_solution(jax.device_get(jax.jit(pack_solution)(solution)))
    for before, after in zip(jax.tree.leaves(solution), jax.tree.leaves(found), strict=True):
        assert before.dtype == after.dtype
        np.testing.assert_array_equal(before, after)
    assert jax.tree.structure(solution) == jax.tree.structure(found)
    assert isinstance(dataclasses.replace(found), tj.Solution)
