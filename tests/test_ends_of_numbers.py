"""Numbers at the ends of their type give a status and finite gradients, and never ok."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import teaser_jax as tj

RIGHT = tj.synthetic.random_problem(0, n=32, outlier_rate=0.25)
WRONG = tj.synthetic.random_problem(0, n=32, outlier_rate=1.0)
ENDS = (1e-38, 1e-25, 1e-14, 1e14, 1e25, 3e38)


@jax.jit
@jax.value_and_grad
def _traced(numbers, drawn):
    src, dst = drawn
    known = {name: numbers[name] for name in ("noise_bound", "scale", "cbar2")}
    confidence = jnp.full(len(src), numbers["confidence"])
    solution = tj.solve(tj.make_problem(src, dst, confidence=confidence, **known))
    # The status travels in the value: 10 for ok.
    return jnp.where(solution.ok, 10.0, 0.0) + 1e-3 * jnp.sum(solution.pose.matrix)


@pytest.mark.long
@pytest.mark.parametrize("name", ["noise_bound", "confidence", "scale", "cbar2"])
def test_inside_jit(name):
    plain = {"noise_bound": 0.06, "confidence": 1.0, "scale": 1.0, "cbar2": 1.0}
    right, wrong = ((x.src.astype(np.float32), x.dst.astype(np.float32)) for x in (RIGHT, WRONG))
    assert _traced({k: np.float32(v) for k, v in plain.items()}, right)[0] > 9
    for end in ENDS:
        numbers = {k: np.float32(v) for k, v in {**plain, name: end}.items()}
        for drawn in (right, wrong):
            value, gradient = _traced(numbers, drawn)
            assert abs(value) < 1, (name, end)  # finite, and not ok
            assert all(np.isfinite(x) for x in gradient.values()), (name, end)


@pytest.mark.long
@pytest.mark.parametrize("shape", ["a line", "a plane", "half of the points equal"])
def test_bounds_and_covariance_of_shapes_that_determine_little(shape):
    rng = np.random.default_rng(0)
    src = rng.normal(size=(30, 3))
    if shape == "a line":
        src = src[:, :1] * [1.0, 2.0, 3.0]
    elif shape == "a plane":
        src = src * [1.0, 1.0, 0.0]
    else:
        src[:15] = src[0]
    result = tj.register(src, src + 0.001 * rng.normal(size=(30, 3)), noise_bound=0.01)
    # Points that stand together stay together however the rest is turned: that looks like chance.
    assert result.ok == (shape == "a plane")
    for ask in (tj.error_bounds, tj.certify, tj.covariance):
        assert str(ask(result))
