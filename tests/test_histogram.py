"""The histogram's vote against the sweep's, with few bins so that every pass has work to do."""

from __future__ import annotations

import math
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import random_matches, set_cost, tls_by_enumeration, tls_cost, unpack

from teaser_jax.stages import scale
from teaser_jax.stages.vote import histogram
from teaser_jax.stages.vote.histogram import vote_by_histogram
from teaser_jax.stages.vote.sweep import vote

pytestmark = pytest.mark.usefixtures("x64")

LENGTH = 16  # measurements in a row


@pytest.fixture(params=[(256, 256), (64, 128)], ids=["256 bins", "64 bins"])
def few_bins(request, monkeypatch):
    bins, ends = request.param
    monkeypatch.setattr(histogram, "BINS", bins)
    passes = math.ceil(math.log(1e8, bins))  # as sharp an eye as the many bins give
    monkeypatch.setattr(histogram, "SAMPLE_PASSES", passes)
    monkeypatch.setattr(histogram, "most_ends", lambda count: ends)


class Listed:
    """Arrays as a table."""

    length = LENGTH

    def __init__(self, *columns):
        self.columns = [jnp.asarray(x).reshape(-1, LENGTH) for x in columns]
        self.rows = self.columns[0].shape[0]

    def row(self, k):
        return tuple(jax.lax.dynamic_index_in_dim(x, k, keepdims=False) for x in self.columns)

    def recall(self, k, i):
        return tuple(x[k, i] for x in self.columns)


def by_histogram(*args):
    return compiled_histogram(*args, bins=histogram.BINS)


@partial(jax.jit, static_argnames="bins")  # what the fixture changes is read when this is traced
def compiled_histogram(values, bounds, mask, cbar2, interval, *, bins):
    unit = jnp.asarray(1.5, values.dtype)
    return vote_by_histogram(Listed(values, bounds, mask), cbar2=cbar2, unit=unit, interval=interval)


@jax.jit
def by_sweep(values, bounds, mask, cbar2, interval):
    return vote(values, bounds, mask=mask, cbar2=cbar2, interval=interval)


def assert_same_set(values, bounds, mask=None, cbar2=1.0, interval=(0.0, np.inf)):
    mask = np.ones(len(values), bool) if mask is None else mask
    args = (np.asarray(values, float), np.asarray(bounds, float), mask, cbar2, interval)
    found, witness = by_histogram(*args)
    swept = by_sweep(*args)
    assert bool(found) == bool(np.any(swept.members))
    if not found:
        return
    usable = mask & np.isfinite(bounds)
    members = usable & (np.abs(values - float(witness)) <= np.sqrt(cbar2) * bounds)
    if not np.array_equal(members, swept.members):  # then both are best
        costs = [set_cost(x, values, bounds, cbar2) for x in (members, np.asarray(swept.members))]
        assert costs[0] == pytest.approx(costs[1], rel=1e-12)


def draw(seed, rows=20, tight=0.02, right=0.3):
    rng = np.random.default_rng(seed)
    k = rows * LENGTH
    bounds = tight * rng.uniform(0.3, 3, k)
    values = np.abs(rng.normal(0, 2, k))
    inlier = rng.random(k) < right
    values[inlier] = np.maximum(1.3 + bounds[inlier] * rng.uniform(-0.9, 0.9, inlier.sum()), 0)
    return values, bounds


@pytest.mark.long
@pytest.mark.parametrize("tight", [1e-6, 0.02, 0.3])
@pytest.mark.parametrize("right", [0.0, 0.05, 0.3, 1.0])
def test_same_set_as_the_sweep(few_bins, tight, right):
    for seed in range(4):
        values, bounds = draw(seed, tight=tight, right=right)
        assert_same_set(values, bounds)
        assert_same_set(values, bounds, cbar2=4.0)
        assert_same_set(values, bounds, mask=np.random.default_rng(seed).random(len(values)) < 0.6)


@pytest.mark.long
def test_the_cost_is_the_enumerated_optimum(few_bins):
    for seed in range(5):
        values, bounds = draw(seed, rows=4, right=0.1)
        found, witness = by_histogram(values, bounds, np.ones(len(values), bool), 1.0, (0.0, np.inf))
        members = np.abs(values - float(witness)) <= bounds
        weights = 1 / bounds[members] ** 2
        estimate = np.sum(weights * values[members]) / np.sum(weights)
        best = tls_by_enumeration(values, bounds, 1.0)
        assert found
        assert tls_cost(estimate, values, bounds, 1.0) == pytest.approx(best, rel=1e-12)


@pytest.mark.parametrize("interval", [(1.0, 1.6), (0.0, 0.9), (1.35, np.inf), (1.32, 1.34), (50.0, 60.0)])
def test_only_sets_with_their_estimate_in_the_interval_compete(few_bins, interval):
    for seed in range(4):
        assert_same_set(*draw(seed), interval=interval)


@pytest.mark.long
def test_two_peaks_apart_are_told_from_each_other(few_bins):
    # Equal but for one measurement: both stay open to the last pass.
    offsets = np.random.default_rng(0).uniform(-0.01, 0.01, 8 * LENGTH)
    values = np.concatenate([0.7 + offsets, 4.0 + offsets])
    bounds = np.full(len(values), 0.05)
    for fewer in (0, 8 * LENGTH):
        mask = np.ones(len(values), bool)
        mask[fewer] = False
        found, witness = by_histogram(values, bounds, mask, 1.0, (0.0, np.inf))
        assert found
        assert abs(float(witness) - (4.0 if fewer == 0 else 0.7)) < 0.05


@pytest.mark.long
def test_ties_of_exact_data():
    # Lattices have few lengths: ends meet exactly, by the hundred.
    rng = np.random.default_rng(1)
    lengths = np.sqrt(rng.integers(1, 30, 20 * LENGTH))
    values = np.where(rng.random(len(lengths)) < 0.5, 1.0, np.round(4 * rng.random(len(lengths))) / 2)
    assert_same_set(values, 0.1 / lengths)


@pytest.mark.parametrize("size", [1e-6, 1e6])
def test_units_do_not_matter(few_bins, size):
    # ``unit`` is only a guess: answers a million times smaller or larger are found too.
    values, bounds = draw(3)
    assert_same_set(size * values, size * bounds)


def test_one_absurd_measurement_hides_nothing(few_bins):
    for absurd in (1e6, 1e12):
        values, bounds = draw(5)
        values[7], bounds[9] = absurd, 1e-9
        assert_same_set(values, bounds)


def test_infinite_bounds_and_masked_numbers_do_not_vote(few_bins):
    values, bounds = draw(6)
    bounds[::3] = np.inf
    mask = np.ones(len(values), bool)
    mask[1], values[1], bounds[2] = False, np.nan, 1e-3
    assert_same_set(values, bounds, mask)


def test_nobody_votes(few_bins):
    values, bounds = draw(7)
    assert not by_histogram(values, bounds, np.zeros(len(values), bool), 1.0, (0.0, np.inf))[0]


@pytest.mark.long
def test_a_batch_equals_a_loop(few_bins):
    drawn = [draw(seed) for seed in range(3)]
    values, bounds = (np.stack(x) for x in zip(*drawn, strict=True))
    mask = np.ones(values.shape, bool)
    mask[1] = False  # a hopeless neighbour
    batched = jax.vmap(lambda v, b, m: by_histogram(v, b, m, 1.0, (0.0, np.inf)))(values, bounds, mask)
    for i in range(3):
        found, witness = by_histogram(values[i], bounds[i], mask[i], 1.0, (0.0, np.inf))
        assert batched[0][i] == found
        if found:
            assert batched[1][i] == witness


@partial(jax.jit, static_argnames="method")  # which is chosen when this is traced
def compiled_scale(src, dst, noise_bound, *, method):
    one = jnp.ones((), src.dtype)
    return scale.estimate_scale(src, dst, noise_bound, jnp.ones(len(src), bool), cbar2=one)


@pytest.mark.long
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("n", [40, 41])
def test_the_scale_of_all_pairs_is_that_of_the_sweep(few_bins, monkeypatch, dtype, n):
    matches = random_matches(3, n, wrong=0.5, scale=1.7)
    args = [np.asarray(x, dtype) for x in (matches.src, matches.dst, np.full(n, matches.noise_bound))]

    monkeypatch.setattr(scale, "FEW_PAIRS", 0)
    found, pairs = compiled_scale(*args, method=f"{histogram.BINS} bins")
    monkeypatch.setattr(scale, "FEW_PAIRS", n * n)
    swept, agreeing = compiled_scale(*args, method="sweep")
    np.testing.assert_array_equal(unpack(pairs, n), unpack(agreeing, n))
    assert float(found) == float(swept)
    assert found.dtype == dtype
