"""The smooth half: the same pose as the answer's, whatever JAX is set to."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj

FAR = np.array([4e5, 5e6, 100.0])


@pytest.mark.parametrize("origin", [0.0, FAR], ids=["near", "far"])
def test_a_problem_in_float64_is_refitted_in_float64(small, origin):
    """Float32, JAX's default, resolves half a unit there: the pose was 5 degrees off without a word."""
    result = tj.register(small.src + origin, small.dst + origin, noise_bound=small.noise_bound)
    pose = tj.refit(result.problem, result.solution.selection)
    assert pose.rotation.dtype == np.float64
    np.testing.assert_allclose(pose.rotation, result.pose.rotation, atol=1e-8)
    moved = pose.apply(result.problem.src) - result.pose.apply(result.problem.src)
    assert np.abs(moved).max() < 1e-6 * small.noise_bound


def test_solve_refuses_what_float32_cannot_hold(small):
    problem = tj.host_problem(small.src + FAR, small.dst + FAR, noise_bound=small.noise_bound)
    for ask in (tj.solve, tj.select, tj.soft_solve):
        with pytest.raises(ValueError, match="float32 resolves .* use register"):
            ask(problem)
