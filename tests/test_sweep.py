"""Adaptive voting against enumeration, over hundreds of random and awkward cases."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import consensus_sets, largest_consensus, mean_of, tls_by_enumeration, tls_cost

from teaser_jax.stages.vote.sweep import vote

pytestmark = pytest.mark.usefixtures("x64")

WIDTH = 40
EVERYWHERE = (-np.inf, np.inf)


class Ballot(NamedTuple):
    """One vote: measurements padded to WIDTH, and its settings."""

    values: np.ndarray
    bounds: np.ndarray
    mask: np.ndarray
    cbar2: float
    interval: tuple[float, float]

    @property
    def voters(self) -> tuple[np.ndarray, np.ndarray]:
        use = self.mask & np.isfinite(self.bounds)
        return self.values[use], self.bounds[use]


def ballot(values, bounds, cbar2=1.0, interval=EVERYWHERE) -> Ballot:
    """Padding holds numbers that would win if they were looked at."""
    missing = WIDTH - len(values)
    return Ballot(
        np.append(values, np.full(missing, 0.25)),
        np.append(bounds, np.full(missing, 1e-3)),
        np.arange(WIDTH) < len(values),
        cbar2,
        interval,
    )


def random_ballots(seed: int, count: int, kind: str) -> list[Ballot]:
    """Ballots of 1 to WIDTH measurements: see KINDS."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(count):
        k = int(rng.integers(1, WIDTH + 1))
        values, bounds, cbar2 = rng.normal(size=k), rng.uniform(0.05, 0.5, k), 1.0
        interval = EVERYWHERE
        if kind == "spread":
            bounds, cbar2 = 10 ** rng.uniform(-4, 1, k), 10 ** rng.uniform(-1, 1)
        elif kind == "clustered":
            agree = rng.uniform(size=k) < rng.uniform(0, 0.6)
            values = np.where(agree, rng.uniform(-1, 1) + 0.9 * bounds * rng.uniform(-1, 1, k), 10 * values)
        elif kind == "grid":  # ends of intervals coincide all the time
            values, bounds = rng.integers(-4, 5, k).astype(float), rng.integers(1, 3, k).astype(float)
        elif kind == "duplicates":
            values, bounds = rng.choice(values[:3], k), rng.choice(bounds[:3], k)
        elif kind == "infinite":
            bounds = np.where(rng.uniform(size=k) < 0.3, np.inf, bounds)
        elif kind == "far":
            values = values + 10 ** rng.uniform(2, 4)
        elif kind == "interval":
            low = rng.normal()
            interval = (low, low + rng.uniform(0.1, 2))
        found.append(ballot(values, bounds, cbar2, interval))
    return found


KINDS = ["plain", "spread", "clustered", "grid", "duplicates", "infinite", "far", "interval"]


def one_vote(criterion, values, bounds, mask, cbar2, interval):
    return vote(values, bounds, mask=mask, cbar2=cbar2, criterion=criterion, interval=interval)


BATCH = 100  # one batch size, one compilation a criterion
votes = {c: jax.jit(jax.vmap(partial(one_vote, c))) for c in ("tls", "consensus")}


def count(ballots: list[Ballot], criterion: str) -> list:
    """All ballots as one batch; the answers one by one, in numpy."""
    filled = ballots + [ballots[0]] * (BATCH - len(ballots))
    values, bounds, mask, cbar2, interval = (np.stack(x) for x in zip(*filled, strict=True))
    won = votes[criterion](values, bounds, mask, cbar2, (interval[:, 0], interval[:, 1]))
    won = jax.tree.map(np.asarray, won)
    return [jax.tree.map(lambda x, i=i: x[i], won) for i in range(len(ballots))]


def agreeing(x: float, b: Ballot, slack: float) -> np.ndarray:
    use = b.mask & np.isfinite(b.bounds)
    return use & (np.abs(x - b.values) <= np.sqrt(b.cbar2) * b.bounds * (1 + slack))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_tls_is_the_global_optimum(kind):
    ballots = random_ballots(KINDS.index(kind), BATCH, kind)
    for b, won in zip(ballots, count(ballots, "tls"), strict=True):
        values, bounds = b.voters
        best = tls_by_enumeration(values, bounds, b.cbar2, b.interval) if len(values) else np.inf
        if np.isinf(best):
            assert won.estimate == 0
            assert not won.members.any()
            continue
        reached = tls_cost(won.estimate, values, bounds, b.cbar2)
        assert reached <= best * (1 + 1e-9) + 1e-12
        assert b.interval[0] <= won.estimate <= b.interval[1]
        # Members are those that agree with the witness, and the estimate is their mean (14). Where
        # no interval cuts the best set off, they agree with the estimate itself.
        places = (won.witness, won.estimate) if b.interval == EVERYWHERE else (won.witness,)
        for place in places:
            assert np.all(won.members <= agreeing(place, b, 1e-9))
            assert np.all(won.members >= agreeing(place, b, -1e-9))
        assert won.estimate == pytest.approx(mean_of(won.members, b.values, b.bounds), rel=1e-12, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_consensus_is_the_largest_set(kind):
    ballots = random_ballots(KINDS.index(kind), BATCH, kind)
    for b, won in zip(ballots, count(ballots, "consensus"), strict=True):
        values, bounds = b.voters
        # Intervals that only just touch may count or not: rounding decides.
        least, most = (
            largest_consensus(values, bounds * factor, b.cbar2, b.interval) if len(values) else 0
            for factor in (1 - 1e-9, 1 + 1e-9)
        )
        assert won.members.sum() <= most
        assert won.members.sum() >= least
        if not won.members.any():
            assert won.estimate == 0
            continue
        assert b.interval[0] <= won.estimate <= b.interval[1]
        assert np.all(won.members <= agreeing(won.witness, b, 1e-9))
        assert np.all(won.members >= agreeing(won.witness, b, -1e-9))
        assert won.estimate == pytest.approx(mean_of(won.members, b.values, b.bounds), rel=1e-12, abs=1e-12)


def test_of_equally_large_sets_consensus_takes_the_cheaper():
    values, bounds = np.array([0.0, 0.9, 10.0, 10.1, 10.2, 0.2]), np.ones(6)
    (won,) = count([ballot(values, bounds)], "consensus")
    assert won.estimate == pytest.approx(10.1)
    np.testing.assert_array_equal(np.flatnonzero(won.members), [2, 3, 4])


def test_tls_and_consensus_can_differ():
    # Three that barely agree lose against two that agree exactly, when residuals count.
    values, bounds = np.array([-1.0, 0.0, 1.0, 9.0, 9.0]), np.ones(5) * 1.01
    tls, consensus = (count([ballot(values, bounds, 1.0)], c)[0] for c in ("tls", "consensus"))
    assert consensus.estimate == pytest.approx(0)
    assert tls_cost(tls.estimate, values, bounds, 1.0) <= tls_cost(0.0, values, bounds, 1.0)
    sets = consensus_sets(values, bounds, 1.0)
    assert max(s.sum() for s in sets) == consensus.members.sum() == 3


@pytest.mark.parametrize("criterion", ["tls", "consensus"])
def test_no_measurement_and_no_voter_answer_zero(criterion):
    nothing = vote(jnp.zeros(0), jnp.zeros(0), criterion=criterion)
    assert nothing.estimate == nothing.witness == 0
    assert nothing.members.shape == (0,)
    hopeless = [
        ballot(np.ones(3), np.full(3, np.inf)),
        ballot(np.zeros(0), np.zeros(0)),
        ballot(np.full(3, np.nan), np.ones(3)),
        ballot(np.ones(3), np.ones(3), interval=(5.0, 6.0)),
    ]
    for won in count(hopeless, criterion):
        assert won.estimate == won.witness == 0
        assert not won.members.any()


@pytest.mark.long
@pytest.mark.parametrize("criterion", ["tls", "consensus"])
@pytest.mark.parametrize("k", [1, 2, 5])
def test_padding_changes_nothing(k, criterion):
    rng = np.random.default_rng(k)
    values, bounds = rng.normal(size=k), rng.uniform(0.1, 1, k)
    short = jax.jit(partial(vote, criterion=criterion))(values, bounds)
    (padded,) = count([ballot(values, bounds)], criterion)
    np.testing.assert_array_equal(short.members, padded.members[:k])
    assert float(short.estimate) == pytest.approx(padded.estimate, abs=1e-14)


def clear_ballots(seed: int) -> list[Ballot]:
    """Ballots with one clear winner, so that no tie decides."""
    rng = np.random.default_rng(seed)
    found = []
    for k in rng.integers(10, WIDTH + 1, 60):
        bounds = rng.uniform(0.05, 0.5, k)
        agree = np.arange(k) < 5 + k // 5
        values = np.where(agree, 0.7 + 0.9 * bounds * rng.uniform(-1, 1, k), rng.uniform(-50, 50, k))
        found.append(ballot(values, bounds))
    return found


@pytest.mark.parametrize("criterion", ["tls", "consensus"])
def test_equivariance_under_shift_scaling_and_order(criterion):
    ballots, order = clear_ballots(20), np.random.default_rng(0).permutation(WIDTH)
    shifted = [b._replace(values=b.values + 0.75) for b in ballots]
    scaled = [b._replace(values=3 * b.values, bounds=3 * b.bounds) for b in ballots]
    mixed = [b._replace(values=b.values[order], bounds=b.bounds[order], mask=b.mask[order]) for b in ballots]
    wider = [b._replace(bounds=b.bounds / 2, cbar2=4.0) for b in ballots]
    answers = zip(*(count(x, criterion) for x in (ballots, shifted, scaled, mixed, wider)), strict=True)
    for plain, moved, larger, turned, same in answers:
        for other in (moved, larger, same):
            np.testing.assert_array_equal(other.members, plain.members)
        np.testing.assert_array_equal(turned.members, plain.members[order])
        assert plain.members.sum() >= 4
        assert moved.estimate == pytest.approx(plain.estimate + 0.75, abs=1e-12)
        assert larger.estimate == pytest.approx(3 * plain.estimate, abs=1e-12)
        assert turned.estimate == pytest.approx(plain.estimate, abs=1e-12)
        assert same.estimate == pytest.approx(plain.estimate, abs=1e-12)


def test_a_batch_equals_a_loop():
    ballots = random_ballots(30, 20, "clustered")
    one = jax.jit(partial(one_vote, "tls"))
    for b, together in zip(ballots, count(ballots, "tls"), strict=True):
        alone = one(*b)
        np.testing.assert_array_equal(alone.members, together.members)
        assert float(alone.estimate) == pytest.approx(together.estimate, abs=1e-14)


def test_many_measurements_agree_to_rounding():
    # 20 000 measurements, a thousand of which agree: running sums must not lose them.
    rng = np.random.default_rng(7)
    values, bounds = rng.uniform(-50, 50, 20_000), 10 ** rng.uniform(-3, -1, 20_000)
    right = rng.permutation(20_000) < 1000
    values[right] = 1.25 + 0.5 * bounds[right] * rng.uniform(-1, 1, 1000)
    won = jax.jit(vote)(values, bounds)
    members = np.asarray(won.members)
    assert np.all(members[right])
    assert float(won.estimate) == pytest.approx(mean_of(members, values, bounds), rel=1e-12)
    np.testing.assert_array_equal(members, np.abs(values - float(won.estimate)) <= bounds)


def test_no_gradient_flows_through_a_choice():
    values, bounds = jnp.asarray([0.0, 0.1, 5.0]), jnp.ones(3)
    assert np.all(np.asarray(jax.jit(jax.grad(lambda v: vote(v, bounds).estimate))(values)) == 0)


def test_float32_is_good_enough_for_a_few():
    # Its own tolerance: a thousandth of a bound.
    with jax.enable_x64(False):
        rng = np.random.default_rng(3)
        values, bounds = rng.normal(size=20).astype(np.float32), rng.uniform(0.1, 0.5, 20).astype(np.float32)
        won = jax.jit(vote)(values, bounds)
        assert won.estimate.dtype == jnp.float32
    exact = tls_by_enumeration(values.astype(float), bounds.astype(float), 1.0)
    assert tls_cost(float(won.estimate), values, bounds, 1.0) <= exact + 1e-3
