"""Arguments that count."""

from __future__ import annotations

import numpy as np
import pytest

from teaser_jax.ground.checks import whole_number


@pytest.mark.parametrize("value", [3, np.int8(3), np.uint64(3)])
def test_whole_numbers_of_any_kind(value):
    found = whole_number("count", value, 3)
    assert found == 3
    assert type(found) is int


@pytest.mark.parametrize("value", [2, True, 3.0, "3", None, np.array([3]), np.nan])
def test_what_is_none(value):
    with pytest.raises(ValueError, match="^count is .*: expected a whole number, 3 or above.$"):
        whole_number("count", value, 3)


def test_ends():
    with pytest.raises(ValueError, match="expected a whole number below 2147483648"):
        whole_number("count", 2**31, 0)
    assert whole_number("seed", 2**40, 0, below=None) == 2**40
    with pytest.raises(OverflowError):
        whole_number("count", -1, 0, error=type("Own", (ValueError, OverflowError), {}))
