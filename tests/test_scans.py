"""Procedural solids and partial scans are what they say they are."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial import cKDTree

from teaser_jax import synthetic
from teaser_jax.synthetic.solids import _PARTS


@pytest.mark.long
@pytest.mark.parametrize("kind", synthetic.KINDS)
def test_a_part_has_the_area_it_says_and_its_points_lie_on_its_skin(kind):
    part = _PARTS[kind](np.random.default_rng(1))
    x = part.sample(np.random.default_rng(0), 200_000)
    assert x.shape == (200_000, 3)
    # A step inwards is inside, one outwards is not: normals from three neighbours are good enough here.
    middle = x.mean(axis=0)
    assert np.mean(part.inside(middle + 0.97 * (x - middle))) > (0.6 if kind == "ring" else 0.95)
    assert not np.any(part.inside(middle + 1.03 * (x - middle))) or kind == "ring"
    # Points spread evenly: a small patch holds its share of the area.
    spacing = np.median(cKDTree(x).query(x[:2000], k=9)[0][:, 8])
    assert np.pi * spacing**2 * 200_000 / 8 == pytest.approx(part.area, rel=0.1)


def test_a_solid_is_centred_as_wide_as_one_and_follows_its_seed():
    one = synthetic.random_solid(3, kinds=("box", "ring"), parts=5, n=3000)
    np.testing.assert_array_equal(one, synthetic.random_solid(3, kinds=("box", "ring"), parts=5, n=3000))
    assert one.shape == (3000, 3)
    assert np.ptp(one, axis=0).max() == pytest.approx(1)
    np.testing.assert_allclose(one.min(axis=0) + one.max(axis=0), 0, atol=1e-12)


def test_a_scan_shows_the_near_side_only():
    rng = np.random.default_rng(0)
    ball = rng.normal(size=(20_000, 3))
    ball = 0.5 * ball / np.linalg.norm(ball, axis=1, keepdims=True)
    view = np.array([1.0, 2, 2]) / 3
    seen = synthetic.partial_scan(0, ball, view, n=2000, sigma=0.0)
    assert np.mean(seen @ view > 0) > 0.99
    # But all of it: as far round as cells can tell.
    assert (seen @ view).min() < 0.1
    noisy = synthetic.partial_scan(0, ball, view, n=2000, sigma=0.01)
    assert np.std(np.linalg.norm(noisy, axis=1) - 0.5) == pytest.approx(0.01, rel=0.1)


def test_the_truth_of_a_pair_lays_one_scan_on_the_other():
    model = synthetic.teapot(20_000)
    pair = synthetic.scan_pair(5, model, n=1000, sigma=0.0, turn=(20, 30))
    distance, _ = cKDTree(pair.dst).query(pair.truth.apply(pair.src))
    assert np.median(distance) < 0.05
    assert np.mean(distance < 0.1) > 0.6  # the rest is seen from one side only
    angle = np.degrees(
        np.arccos(
            np.dot(
                *(
                    (v - c) / np.linalg.norm(v - c)
                    for v, c in (
                        (pair.truth.apply(pair.src_viewpoint[None])[0], origin_of(pair)),
                        (pair.dst_viewpoint, origin_of(pair)),
                    )
                )
            )
        )
    )
    assert 15 < angle < 35


def origin_of(pair: synthetic.ScanPair) -> np.ndarray:
    """Roughly the middle of the object, in the target frame."""
    return pair.dst.mean(axis=0)


def test_nonsense_is_refused(unchecked):
    for known, words in (
        ({"kinds": ("cube",)}, "cube"),
        ({"kinds": ()}, "nothing"),
        ({"parts": 0}, "at least"),
    ):
        with pytest.raises(ValueError, match=words):
            synthetic.random_solid(0, **known)
    with pytest.raises(ValueError, match="one point a row"):
        synthetic.partial_scan(0, np.zeros((3, 5)), np.ones(3), n=5, sigma=0.0)
    with pytest.raises(ValueError, match="direction"):
        synthetic.partial_scan(0, np.zeros((5, 3)), np.zeros(3), n=5, sigma=0.0)
