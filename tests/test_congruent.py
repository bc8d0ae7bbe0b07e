"""Other poses of two sets of points, by congruent triples."""

from __future__ import annotations

import numpy as np
import pytest

from teaser_jax.stages.rivals.congruent import is_same, other_poses
from teaser_jax.synthetic import draw_rotation

CUBE = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0]), axis=-1).reshape(-1, 3) - 0.5
TURN = draw_rotation(np.random.default_rng(7))


def same(n):
    return np.stack([np.arange(n)] * 2, axis=1)


def test_a_cube_has_23_other_poses():
    found = other_poses(CUBE, CUBE @ TURN.T, same(8), noise_bound=0.01)
    assert len(found) == 23
    assert all(x.explained == 8 for x in found)
    assert np.allclose([np.linalg.det(x.pose.rotation) for x in found], 1)


def test_points_at_random_have_none_that_explains_much():
    points = np.random.default_rng(0).random((40, 3))
    found = other_poses(points, points @ TURN.T, same(40), noise_bound=0.01)
    assert all(x.explained < 10 for x in found)


@pytest.mark.parametrize("copied", ["source", "target"])
def test_a_copy_elsewhere_is_another_pose(copied):
    """The answer joins the first copy; the triples of the other cloud tell of the second."""
    points = np.random.default_rng(1).random((20, 3))
    twice = np.concatenate([points, points @ TURN.T + 3.0])
    clouds = (twice, points) if copied == "source" else (points, twice)
    best = other_poses(*clouds, same(20), noise_bound=0.01)[0]
    assert best.explained == 20
    assert not is_same(best.pose.apply(points), points, 0.01)


def test_the_pose_behind_a_mirrored_clique_is_found():
    half = np.random.default_rng(2).random((15, 3))
    points = np.concatenate([half, half * [-1, 1, 1]])
    mirrored = np.stack([np.arange(30), np.roll(np.arange(30), 15)], axis=1)
    best = other_poses(points, points @ TURN.T, mirrored, noise_bound=0.01)[0]
    assert best.explained == 30
    np.testing.assert_allclose(best.pose.rotation, TURN, atol=1e-9)


def test_two_pairs_make_no_triple():
    assert other_poses(CUBE, CUBE, same(2), noise_bound=0.01) == []
