"""Half precision goes in, and float32 comes out; gradients are in the type of the input."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import teaser_jax as tj

DRAWN = tj.synthetic.random_problem(0, n=64, outlier_rate=0.5)
HALVES = [jnp.bfloat16, jnp.float16]


def halved(dtype):
    return jnp.asarray(DRAWN.src, dtype), jnp.asarray(DRAWN.dst, dtype), jnp.asarray(0.1, dtype)


def assert_float32_and_right(pose: tj.Pose) -> None:
    assert {x.dtype for x in jax.tree.leaves(pose)} == {jnp.dtype("float32")}
    assert np.degrees(tj.metrics.rotation_error(pose, DRAWN.truth)) < 1
    # A rotation in bfloat16 would be off by 0.1 deg from the nearest rotation.
    np.testing.assert_allclose(pose.rotation.T @ pose.rotation, np.eye(3), atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize(("dtype", "solver"), list(zip(HALVES, [tj.solve, tj.soft_solve], strict=True)))
def test_gradients_under_jit(dtype, solver):
    def total(src, dst, bound):
        found = solver(tj.make_problem(src, dst, noise_bound=bound))
        return jnp.sum(found.pose.matrix), found

    slope = jax.jit(jax.value_and_grad(total, (0, 1, 2), has_aux=True))
    (_, found), gradients = slope(*halved(dtype))
    assert found.status == tj.Status.OK
    assert_float32_and_right(found.pose)
    for gradient in gradients:
        assert gradient.dtype == dtype
        assert np.isfinite(gradient.astype(np.float32)).all()
    assert np.any(gradients[1].astype(np.float32) != 0)


@pytest.mark.parametrize("dtype", HALVES)
def test_outside_jit(dtype):
    src, dst, _ = halved(dtype)
    assert tj.make_problem(src, dst, noise_bound=0.1).src.dtype == np.float32
    for convert in (jnp.asarray, np.asarray):
        assert tj.register(convert(src), convert(dst), noise_bound=0.1).ok


@pytest.mark.long
def test_a_problem_that_became_half_on_the_way():
    """As a network's mixed precision makes them: the records hold whatever they are given."""
    dtype = jnp.bfloat16
    wide = tj.make_problem(DRAWN.src, DRAWN.dst, noise_bound=0.1)
    problem = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, wide)
    solution = jax.jit(tj.solve)(problem)
    assert solution.ok
    assert_float32_and_right(solution.pose)
    assert_float32_and_right(tj.refit(problem, solution.selection))
    assert tj.covariance(problem, solution).covariance.dtype == np.float32
    assert tj.certify(problem, solution).status == 0
