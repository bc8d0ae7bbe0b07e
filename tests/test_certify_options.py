"""What all who certify are asked: tolerances, caps, and the rounds that many measurements can have."""

from __future__ import annotations

import numpy as np
import pytest

from teaser_jax.certify.options import MAX_MEASUREMENTS, TOLERANCE, checked_options, default_iterations


def test_the_work_of_many_measurements_is_bounded():
    assert [default_iterations(k) for k in (10, 200, 400, 800, 1000)] == [200, 200, 25, 3, 3]


def test_a_cap_that_is_given_holds_for_any_number():
    asked = checked_options(TOLERANCE, 7, "splitting", MAX_MEASUREMENTS)
    assert [asked.rounds(k) for k in (10, 1000)] == [7, 7]
    left = checked_options(TOLERANCE, None, "splitting", MAX_MEASUREMENTS)
    assert [left.rounds(k) for k in (10, 1000)] == [200, 3]


@pytest.mark.parametrize("kind", [float, np.float32, np.float64, np.asarray])
def test_numbers_of_all_kinds_become_plain_ones(kind):
    options = checked_options(kind(0.25), np.int64(3), "direct", np.int32(9))
    assert options == (0.25, 3, "direct", 9)
    assert [type(x) for x in options] == [float, int, str, int]


@pytest.mark.parametrize("tolerance", [0.0, 1.0, -1.0, np.nan, np.inf, [1e-3]])
def test_a_tolerance_lies_between_0_and_1(tolerance):
    with pytest.raises(ValueError, match="between 0 and 1"):
        checked_options(tolerance, None, "splitting", MAX_MEASUREMENTS)
