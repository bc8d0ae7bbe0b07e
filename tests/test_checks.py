"""Arguments that count."""

from __future__ import annotations

import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.certify.certificate import CertificateStatus
from teaser_jax.ground.arrays import is_traced
from teaser_jax.ground.checks import check_positive, shown, whole_number


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


@pytest.mark.parametrize("value", ["a", 10**400, [1, [2]], None, 0, np.nan, [1.0, -1.0]])
def test_what_is_not_positive(value):
    with pytest.raises(ValueError, match="^width is .*: expected a finite number above 0.$"):
        check_positive(width=value)


def test_what_was_received_is_one_short_line():
    assert shown("a") == "'a'"
    for value in (np.zeros((50, 3)), "x" * 1000, 10**4000, 10**5000):
        assert len(shown(value)) <= 80
        assert "\n" not in shown(value)


def test_iterators_are_not_looked_into():
    assert not is_traced(iter([1, 2]), (x for x in "ab"))


def test_a_status_is_printed_by_its_name():
    assert str(tj.Status.OK) == f"{tj.Status.OK}" == "OK"
    assert f"{tj.Status.NO_CONSENSUS:d} {CertificateStatus.TOO_LARGE}" == "2 TOO_LARGE"
