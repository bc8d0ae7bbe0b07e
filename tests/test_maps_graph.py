"""The graph of poses and its cycles: false pairs are refused, contradictions said, both engines agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from map_scenes import errors_of, loop_of_pairs, loop_of_poses, measured, untrusted

from teaser_jax.clouds.trust.judge import SURELY
from teaser_jax.maps.graph import engine_or_any
from teaser_jax.maps.motions import adjoint, exp, inverse, log, right_covariance
from teaser_jax.maps.pair import LEAST_DISPLACEMENT, MapPair
from teaser_jax.maps.placing import Placing, place


def placed(pairs: list[MapPair], count: int, engine: str = "scipy", near: int = 3) -> Placing:
    return place(pairs, np.zeros((count, 3)), engine, near)


def wrong(rng: np.random.Generator) -> np.ndarray:
    return exp(rng.normal(size=6) * [0.3, 0.3, 0.3, 2, 2, 2])


def test_exponential_and_logarithm_undo_one_another():
    rng = np.random.default_rng(0)
    motions = rng.normal(size=(200, 6)) * np.geomspace(1e-12, 1.2, 200)[:, None]
    np.testing.assert_allclose(log(exp(motions)), motions, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(
        exp(motions) @ inverse(exp(motions)), np.tile(np.eye(4), (200, 1, 1)), atol=1e-12
    )
    T, small = exp(motions[-1]), 1e-6 * motions[-2]
    np.testing.assert_allclose(T @ exp(small), exp(adjoint(T) @ small) @ T, atol=1e-14)


def test_the_covariance_is_carried_to_the_right_of_the_pose():
    """Against pairs drawn anew: points of the target move by s + r x (x - c), as the answer says."""
    rng = np.random.default_rng(1)
    truth = loop_of_poses(8)
    pair = measured(truth, 1, 3, rng)
    shift, turn = np.split(rng.multivariate_normal(np.zeros(6), pair.covariance, 50_000), 2, axis=1)
    left = np.hstack([turn, shift - np.cross(turn, pair.centroid)])
    error = log(inverse(pair.T) @ exp(left) @ pair.T)
    expected = right_covariance(pair.T, pair.covariance, pair.centroid)
    off = np.linalg.solve(expected, np.cov(error.T)) - np.eye(6)
    assert np.abs(np.linalg.eigvals(off)).max() < 0.04
    np.testing.assert_allclose(np.linalg.inv(pair.information) / SURELY**2, expected, rtol=1e-6, atol=1e-12)


def test_the_covariance_is_the_derivative_of_the_motion():
    rng = np.random.default_rng(2)
    T, centroid, step = exp(rng.normal(size=6)), rng.normal(size=3), 1e-6
    columns = []
    for k in range(6):
        shift, turn = np.split(step * np.eye(6)[k], 2)
        moved = exp(np.concatenate([turn, shift - np.cross(turn, centroid)])) @ T
        columns.append(log(inverse(T) @ moved) / step)
    J = np.array(columns).T
    A = rng.normal(size=(6, 6))
    np.testing.assert_allclose(right_covariance(T, A @ A.T, centroid), J @ A @ A.T @ J.T, rtol=1e-4)


def test_a_pair_without_noise_is_not_taken_for_exact():
    pair = measured(loop_of_poses(8), 0, 1, np.random.default_rng(3))
    clean = replace(pair, covariance=1e-12 * pair.covariance, displacement=1e-6 * pair.displacement)
    least = replace(pair, displacement=LEAST_DISPLACEMENT * pair.voxel_size)
    ratio = (LEAST_DISPLACEMENT * pair.voxel_size / pair.displacement) ** 2
    np.testing.assert_allclose(clean.information * ratio, least.information, rtol=1e-6)
    assert (untrusted(0, 1).information == 0).all()


@pytest.mark.parametrize("engine", ["gtsam", "scipy"])
def test_false_loops_among_thirty_clouds_are_refused(engine: str):
    if engine == "gtsam":
        pytest.importorskip("gtsam", reason="needs the extra map")
    rng = np.random.default_rng(4)
    truth = loop_of_poses(30)
    pairs = loop_of_pairs(truth, rng)
    true = len(pairs)
    false = [(0, 15), (1, 16), (7, 22), (3, 11), (5, 25), (2, 28), (9, 14)]
    pairs += [measured(truth, i, j, rng, wrong=wrong(rng)) for i, j in false]
    pairs += [untrusted(4, 20), untrusted(8, 23)]
    found = placed(pairs, 30, engine)
    assert found.kept == list(range(true))
    assert sorted(found.refused) == list(range(true, true + len(false)))
    assert all(refusal.is_clear for refusal in found.refused.values())
    assert found.placed.all()
    assert found.confirmed.all()
    assert errors_of(found.poses, truth).max() < 0.3
    assert not found.strained
    assert not found.withheld


def test_the_engines_agree():
    pytest.importorskip("gtsam", reason="needs the extra map")
    rng = np.random.default_rng(5)
    truth = loop_of_poses(16)
    pairs = loop_of_pairs(truth, rng, reach=3)
    ours, theirs = (placed(pairs, 16, engine).poses for engine in ("scipy", "gtsam"))
    np.testing.assert_allclose(ours, theirs, atol=1e-6)
    assert engine_or_any(None) == "gtsam"


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_units_do_not_matter(unit: float):
    rng = np.random.default_rng(6)
    truth = loop_of_poses(12)
    pairs = loop_of_pairs(truth, rng)
    scale = np.diag([unit] * 3 + [1.0] * 3)
    other = []
    for pair in pairs:
        T = pair.T.copy()
        T[:3, 3] *= unit
        other.append(
            replace(
                pair,
                T=T,
                covariance=scale @ pair.covariance @ scale,
                centroid=unit * pair.centroid,
                displacement=unit * pair.displacement,
                voxel_size=unit * pair.voxel_size,
            )  # fmt: skip
        )
    a, b = placed(pairs, 12), placed(other, 12)
    np.testing.assert_allclose(unit * a.poses[:, :3, 3], b.poses[:, :3, 3], rtol=1e-6, atol=1e-6 * unit)


def test_frames_far_away_cost_no_digits():
    """Clouds in the coordinates of a country: poses come in their frames, as exact as about their middles."""
    rng = np.random.default_rng(7)
    truth = loop_of_poses(10)
    pairs = loop_of_pairs(truth, rng)
    origins = np.array([4e5, 5e6, 200]) + rng.normal(size=(10, 3))
    away = np.tile(np.eye(4), (10, 1, 1))
    away[:, :3, 3] = origins
    far = []
    for pair in pairs:
        T = away[pair.i] @ pair.T @ inverse(away[pair.j])
        far.append(replace(pair, T=T, centroid=pair.centroid + origins[pair.i]))
    near, there = placed(pairs, 10), place(far, origins, "scipy", 3)
    expected = away[0] @ near.poses @ inverse(away)
    points = origins + rng.normal(size=(10, 3))
    for k in range(10):
        a, b = (T[k, :3, :3] @ points[k] + T[k, :3, 3] for T in (expected, there.poses))
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_a_chain_that_one_false_loop_closes_is_in_doubt_and_does_not_bend():
    rng = np.random.default_rng(8)
    truth = loop_of_poses(12)
    chain = loop_of_pairs(truth, rng, reach=1, closed=False)
    found = placed([*chain, measured(truth, 0, 11, rng, wrong=wrong(rng))], 12)
    assert found.kept == list(range(11))
    assert not found.refused[11].is_clear
    assert found.placed.all()
    assert not found.confirmed.any()
    assert len(found.bridges) == 11
    np.testing.assert_allclose(found.poses, placed(chain, 12).poses, atol=1e-9)


def test_a_cloud_that_two_pairs_place_in_two_ways_is_not_placed():
    rng = np.random.default_rng(9)
    truth = loop_of_poses(12)
    pairs = [pair for pair in loop_of_pairs(truth, rng) if 6 not in (pair.i, pair.j)]
    lonely = [measured(truth, 2, 6, rng, wrong=wrong(rng)), measured(truth, 6, 10, rng)]
    found = placed([*pairs, *lonely], 12)
    assert np.flatnonzero(~found.placed).tolist() == [6]
    assert np.isnan(found.poses[6]).all()
    assert len(found.withheld) == len(found.refused) == 1


def test_true_pairs_outvote_a_false_one_that_came_first():
    """Where the order of the list means nothing, many that agree with one another are right."""
    rng = np.random.default_rng(10)
    truth = loop_of_poses(12)
    inside = [p for p in loop_of_pairs(truth, rng, reach=3, closed=False) if (p.i < 6) == (p.j < 6)]
    false = measured(truth, 5, 6, rng, wrong=wrong(rng))
    across = [measured(truth, i, j, rng) for i, j in ((0, 11), (2, 9), (3, 10), (1, 8))]
    found = placed([false, *inside, *across], 12, near=0)
    assert list(found.refused) == [0]
    assert found.refused[0].is_clear
    assert errors_of(found.poses, truth).max() < 0.5
    # Where it does, no one can tell whether the others take one place for another.
    ordered = placed([false, *inside, *across], 12)
    assert 0 in ordered.kept
    assert [refusal.is_clear for refusal in ordered.refused.values()] == [False] * 4


def test_two_places_alike_are_in_doubt():
    """Pairs between them agree with one another, and are as many as hold the clouds that lie between."""
    rng = np.random.default_rng(11)
    truth = loop_of_poses(20)
    chain = loop_of_pairs(truth, rng, reach=2, closed=False)
    alike = truth[0] @ exp(np.array([0, 0, 0, 0.5, 0.2, 0])) @ inverse(truth[10]) @ truth
    alike[:10] = truth[:10]
    false = [measured(alike, i, j, rng) for i, j in ((0, 10), (1, 10), (0, 11), (1, 11))]
    found = placed([*chain, *false], 20)
    assert sorted(found.refused) == list(range(len(chain), len(chain) + 4))
    assert not any(refusal.is_clear for refusal in found.refused.values())
    assert errors_of(found.poses, truth).max() < 0.5


def test_parts_that_nothing_joins_stay_apart():
    rng = np.random.default_rng(12)
    truth = loop_of_poses(10)
    pairs = [p for p in loop_of_pairs(truth, rng, closed=False) if (p.i < 4) == (p.j < 4)]
    found = placed(pairs, 10)
    assert found.component.tolist() == [1] * 4 + [0] * 6
    assert found.placed.tolist() == [False] * 4 + [True] * 6
    np.testing.assert_allclose(found.poses[4], np.eye(4), atol=1e-12)
    nothing = placed([untrusted(0, 1)], 2)
    assert not nothing.placed.any()
    assert np.isnan(nothing.poses).all()
    assert not nothing.confirmed.any()


def test_the_order_of_the_pairs_changes_nothing():
    rng = np.random.default_rng(13)
    truth = loop_of_poses(16)
    pairs = [*loop_of_pairs(truth, rng), measured(truth, 0, 8, rng, wrong=wrong(rng))]
    order = rng.permutation(len(pairs))
    a, b = placed(pairs, 16), placed([pairs[k] for k in order], 16)
    assert a.kept == sorted(order[b.kept].tolist())
    np.testing.assert_allclose(a.poses, b.poses, atol=1e-7)
