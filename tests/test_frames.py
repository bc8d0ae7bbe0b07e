"""Frames and precision: what is taken away is given back, and float32 is used only where it will do."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.engine.frames import centred, centred_one, float32_will_do, middle
from teaser_jax.engine.packing import pack_problem
from teaser_jax.engine.sizes import padded_size, size_of


def problem(offset=0.0, bound=0.05, **known):
    drawn = tj.synthetic.random_problem(0, n=40, outlier_rate=0.5)
    return tj.host_problem(drawn.src + offset, drawn.dst - offset, noise_bound=bound, **known)


def near(one: tj.Problem):
    return centred_one(pack_problem(one, tj.Settings(), size_of(one)))


def test_the_middle_is_an_upper_median():
    points = np.random.default_rng(0).normal(size=(41, 3))
    np.testing.assert_array_equal(middle(points), np.median(points, axis=0))
    np.testing.assert_array_equal(middle(points[:40]), np.sort(points[:40], axis=0)[20])


def test_an_absurd_row_does_not_move_the_middle_and_a_masked_one_does_not_count():
    one, mask = problem(offset=1e6), np.arange(40) != 3
    far = dataclasses.replace(one, src=np.where(mask[:, None], one.src, 1e9))
    masked = dataclasses.replace(far, mask=mask)
    for each in (far, masked):
        assert np.abs(near(each).origins[0] - near(one).origins[0]).max() < 1
    assert near(masked).edge_dtype is np.float32
    assert near(far).edge_dtype is np.float64


@pytest.mark.parametrize(
    ("known", "dtype"), [({}, np.float32), ({"scale": None}, np.float64), ({"bound": 1e-5}, np.float64)]
)
def test_edges_are_tested_in_float32_where_that_will_do(known, dtype):
    assert near(problem(offset=1e5, **known)).edge_dtype is dtype


def test_one_problem_and_a_stack_are_asked_the_same():
    kinds = [problem(), problem(bound=1e-5), problem(offset=1e6)]
    stack = tj.stack_problems(kinds)
    together = centred(pack_problem(stack, tj.Settings(), size_of(stack)))
    alone = [near(one) for one in kinds]
    np.testing.assert_array_equal(together.narrow, [one.narrow for one in alone])
    assert alone[0].origins is None  # it could stay where it was
    for k, origins in enumerate(together.origins):
        np.testing.assert_array_equal(origins[0], 0)
        np.testing.assert_array_equal(origins[1], alone[1].origins[k])
        np.testing.assert_array_equal(origins[2], alone[2].origins[k])
        assert np.abs(origins[2] - (1e6, -1e6)[k]).max() < 10


def test_float32_is_out_of_the_question_beyond_its_range():
    assert float32_will_do(1.0, 1.0, 1.0, 0.1, 1.0)
    assert not float32_will_do(1e7, 1.0, 1.0, 1e6, 1.0)
    assert not float32_will_do(1e-9, 1e-9, 1.0, 1e-7, 1.0)
    np.testing.assert_array_equal(
        float32_will_do(np.ones(2), np.ones(2), np.ones(2), np.array([0.1, 1e-5]), np.ones(2)), [True, False]
    )


def test_sizes_grow_in_steps():
    assert [padded_size(n) for n in (1, 32, 33, 1024, 1025, 2049)] == [32, 32, 64, 1024, 1536, 3072]
