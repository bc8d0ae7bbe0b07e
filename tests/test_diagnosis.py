"""Advice that names the cause, where the numbers show it; followed, it leads to the right pose."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj

N = 100
RIGHT = tj.synthetic.random_problem(3, n=N, outlier_rate=0.3)


def registered(drawn=RIGHT, **given):
    return tj.register(drawn.src, drawn.dst, **{"noise_bound": drawn.noise_bound, **given})


@pytest.mark.parametrize("scale", [1.98, 0.5, 0.3048])
@pytest.mark.parametrize("rate", [0.0, 0.5, 0.7])
def test_a_forgotten_scale_is_named(scale, rate):
    drawn = tj.synthetic.random_problem(
        (4, N), n=N, outlier_rate=rate, scale=scale, sigma=0.01 * scale, noise_bound=0.0554 * scale
    )
    result = registered(drawn)
    assert not result.ok
    said = f"The matches agree at scale {scale:.2g}"[:-1]
    assert said in str(result)
    assert "pass scale=None" in result.advice
    assert registered(drawn, scale=None).ok


def test_where_bounds_are_nothing_beside_the_lengths_no_warning_leaks():
    result = registered(tj.synthetic.random_problem(0, n=20, outlier_rate=1.0), cbar2=1e-300)
    assert result.status == tj.Status.TOO_FEW_POINTS
    assert "cbar2" in result.advice


def test_no_scale_is_named_where_there_is_none():
    wrong = tj.synthetic.random_problem(5, n=N, outlier_rate=1.0)
    for scale in (1.0, None):
        result = registered(wrong, scale=scale)
        assert not result.ok
        assert result.advice == result.status.advice


@pytest.mark.parametrize("scale", [1.0, None])
def test_a_bound_larger_than_the_scene_is_named(scale):
    """Millimetres where the points are in metres."""
    result = registered(noise_bound=1e3 * RIGHT.noise_bound, scale=scale)
    assert not result.ok
    assert "noise_bound is 55.4 and larger than the scene, which is " in result.advice


def test_bounds_in_two_units_are_named():
    bounds = np.full(N, 1e-3 * RIGHT.noise_bound)
    bounds[[3, 17]] = RIGHT.noise_bound
    result = registered(noise_bound=bounds)
    assert not result.ok
    assert (
        "5.54e-05 for most matches and 0.0554 in row 3: check the unit of 2 of 100 bounds (rows 3, 17)"
        in (result.advice)
    )


@pytest.mark.long
def test_pairs_taken_for_correspondences_are_named():
    order = np.random.default_rng(0).permutation(N)
    dst = np.empty_like(RIGHT.dst)
    dst[order] = RIGHT.dst
    pairs = np.stack([np.arange(N), order], axis=1)
    result = tj.register(RIGHT.src, dst, noise_bound=RIGHT.noise_bound, pairs=pairs)
    assert not result.ok
    cure = "pass src[pairs[:, 0]] and dst[pairs[:, 1]], without pairs."
    assert cure in str(result)
    with pytest.raises(ValueError, match="If pairs are correspondences, pass") as error:
        tj.register(RIGHT.src, dst[:-1], noise_bound=RIGHT.noise_bound, pairs=pairs)
    assert cure in str(error.value)
    a, b = RIGHT.src[pairs[:, 0]], dst[pairs[:, 1]]
    assert tj.register(a, b, noise_bound=RIGHT.noise_bound).ok
