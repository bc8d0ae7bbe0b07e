"""The search over pairs: the optimum wherever a slow search finds it, and never worse than GNC."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import BOUND, best_rotation, draw_vectors, rotation_cost

import teaser_jax as tj
from teaser_jax.stages.rotation import pair_search
from teaser_jax.stages.rotation.pair_search import pair_hypotheses, polish, search_pairs
from teaser_jax.stages.rotation.quadratic_form import Measurements

found_by = jax.jit(search_pairs)


def framed(src, dst, rotation=None) -> Measurements:
    rotation = np.eye(3) if rotation is None else rotation
    ones = jnp.ones(len(src), bool)
    return Measurements(jnp.asarray(src / BOUND), jnp.asarray(dst / BOUND @ rotation), jnp.asarray(1.0), ones)


@pytest.mark.long
@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.8, 1.0])
def test_it_finds_what_trying_all_pairs_and_triples_finds(wrong, x64):
    for seed in range(3):
        src, dst, _ = draw_vectors((seed, 12), 12, wrong)
        _, least = best_rotation(src, dst)
        assert rotation_cost(src, dst, np.asarray(found_by(framed(src, dst)))) <= least + 1e-9


@pytest.mark.long
@pytest.mark.parametrize(("k", "wrong"), [(40, 0.8), (40, 0.9), (100, 0.8), (100, 0.9)])
def test_it_is_never_worse_than_gnc_or_the_truth_at_high_rates(k, wrong):
    for seed in range(5):
        src, dst, truth = draw_vectors((k, seed), k, wrong)
        best = tj.solve_rotation(src, dst, noise_bound=BOUND, proof=None)
        gnc = tj.solve_rotation(src, dst, noise_bound=BOUND, method="gnc", proof=None)
        assert best.cost <= min(gnc.cost, rotation_cost(src, dst, truth)) + 1e-9


@pytest.mark.long
def test_the_candidate_of_the_frame_is_kept_where_it_is_best(x64):
    src, dst, truth = draw_vectors(1, 20, 0.3)
    best = np.asarray(found_by(framed(src, dst)))
    turn = np.asarray(found_by(framed(src, dst, best)))
    np.testing.assert_allclose(turn, np.eye(3), atol=1e-9)


def test_polish_never_goes_up(x64):
    for seed in range(10):
        src, dst, truth = draw_vectors(seed, 15, 0.4)
        m = framed(src, dst, truth)
        assert m.turned(jax.jit(polish)(m)).cost <= m.cost + 1e-12


def test_hypotheses_carry_their_pair(x64):
    src, dst, truth = draw_vectors(0, 8, 0.0, sigma=0.0)
    found = jax.jit(pair_hypotheses)(framed(src, dst))
    np.testing.assert_allclose(found.turns[0], truth, atol=1e-9)
    assert found.costs[0] < 1e-9


@pytest.mark.long
def test_masked_and_many_measurements(x64, monkeypatch):
    src, dst, truth = draw_vectors(2, 30, 0.6)
    m = framed(src, dst)
    few = m._replace(mask=jnp.arange(30) < 10)
    kept = rotation_cost(src[:10], dst[:10], np.asarray(found_by(few)))
    assert kept <= best_rotation(src[:10], dst[:10])[1] + 1e-9
    none = m._replace(mask=jnp.zeros(30, bool))
    np.testing.assert_allclose(found_by(none), np.eye(3), atol=1e-12)
    # With room for fewer hypotheses than pairs each measurement still takes part.
    monkeypatch.setattr(pair_search, "HYPOTHESES", 90)
    assert jax.jit(lambda m: search_pairs(m))(m).shape == (3, 3)


@pytest.mark.long
def test_in_the_cascade_it_changes_nothing_that_is_right(small):
    problem = small
    for graph in ("chain", "complete"):
        results = [
            tj.register(
                problem.src, problem.dst, noise_bound=problem.noise_bound,
                settings=tj.Settings(rotation=rotation, tim_graph=graph),
            )
            for rotation in ("gnc", "global")
        ]  # fmt: skip
        np.testing.assert_allclose(results[1].pose.matrix, results[0].pose.matrix, atol=1e-9)
        assert results[1].ok


@pytest.mark.long
def test_in_float32_and_under_vmap(small):
    problem = tj.make_problem(small.src, small.dst, noise_bound=small.noise_bound)
    settings = tj.Settings(rotation="global", clique="greedy")
    both = jax.jit(jax.vmap(lambda p: tj.solve(p, settings)))(tj.stack_problems([problem, problem]))
    assert both.pose.rotation.dtype == jnp.float32
    assert np.all(both.ok)
