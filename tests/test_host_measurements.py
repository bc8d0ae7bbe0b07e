"""Measurements on the host: few sizes, rows that count first, and bad input."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from teaser_jax.certify.host_measurements import padded_count, read_measurements, without_padding


def test_sizes_are_few_and_little_larger():
    assert all(padded_count(k) >= max(k, 16) for k in range(1000))
    assert all(padded_count(k) <= max(16, k + 8, 1.26 * k) for k in range(1000))
    assert len({padded_count(k) for k in range(1001)}) < 60


def test_rows_of_the_mask_come_first_and_padding_comes_off():
    rng = np.random.default_rng(0)
    src, dst = rng.normal(size=(2, 25, 3))
    mask = rng.uniform(size=25) < 0.5
    bounds = rng.uniform(1, 2, 25)
    read = read_measurements(src.astype(np.float32), dst, bounds, 1.0, mask)
    assert read.src.dtype == np.float64
    assert len(read.src) == padded_count(int(mask.sum()))
    assert read.measured == mask.sum()
    plain = without_padding(read)
    assert_array_equal(plain.src, src[mask].astype(np.float32))
    assert_array_equal(plain.dst, dst[mask])
    assert_array_equal(plain.noise_bound, bounds[mask])
    assert plain.mask.all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (dict(noise_bound=np.ones(3)), "shapes"),
        (dict(cbar2=np.ones(2)), "shapes"),
        (dict(mask=np.ones(3, bool)), "mask has shape"),
        (dict(mask=[0, 2, 3]), "expected .* truth values"),
        (dict(mask=[0, 1, 1, 0, 1]), "pass mask.astype"),
        (dict(noise_bound="a"), "noise_bound has dtype"),
        (dict(src=[[1, 2], [3]]), "src cannot be read"),
        (dict(noise_bound=0.0), "above 0"),
        (dict(noise_bound=np.inf), "above 0"),
        (dict(noise_bound=np.nan), "above 0"),
        (dict(cbar2=-1.0), "above 0"),
    ],
)
def test_bad_input_is_refused(change, words):
    known = dict(src=np.ones((5, 3)), dst=np.ones((5, 3)), noise_bound=1.0, cbar2=1.0, mask=np.ones(5, bool))
    with pytest.raises(ValueError, match=words):
        read_measurements(**(known | change))


def test_a_bound_outside_the_mask_may_be_anything():
    bounds = np.array([1.0, np.nan, 1.0])
    read = read_measurements(np.ones((3, 3)), np.ones((3, 3)), bounds, 1.0, np.array([True, False, True]))
    assert read.measured == 2


def test_what_a_masked_array_hides_is_no_measurement():
    src = np.ma.masked_array(np.ones((5, 3)), np.arange(5)[:, None] == [[1, 1, 1]])
    read = read_measurements(src, np.ones((5, 3)), 1.0, 1.0, np.ones(5, bool))
    assert np.isnan(read.src[1]).all()
