"""What of a cloud can be used, the width of cells, and one point for each."""

from __future__ import annotations

import numpy as np
import pytest
from cloud_scenes import plane, terrain

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from teaser_jax.clouds.cloud import Cloud, as_cloud
from teaser_jax.clouds.neighbours import Tree
from teaser_jax.clouds.voxel import count_cells, downsample, spacing, voxel_size_for


def test_every_reason_is_counted_and_nothing_else_is_lost():
    points = terrain(0, 1000)
    bad = points.copy()
    bad[3, 1], bad[5, 0], bad[7] = np.nan, np.inf, 0
    bad[9] = bad[8]
    bad[11] += 1e5
    cloud = as_cloud(bad)
    counted = cloud.left_out
    assert (counted.not_finite, counted.zero, counted.repeated, counted.stray) == (2, 1, 1, 1)
    assert cloud.given == 1000
    np.testing.assert_array_equal(cloud.rows, np.setdiff1d(np.arange(1000), [3, 5, 7, 9, 11]))
    np.testing.assert_allclose(cloud.points + cloud.origin, points[cloud.rows], atol=1e-12)
    assert str(counted) == "2 not finite, 1 zero, 1 stray, 1 repeated"


def test_large_coordinates_keep_their_digits():
    points = terrain(0, 500)
    far = np.array([4_000_000.25, -1_200_000.5, 4_800_000.0])
    moved = points + far
    cloud = as_cloud(moved)
    np.testing.assert_array_equal(cloud.points + cloud.origin, moved)
    assert np.abs(cloud.points).max() < 30
    here = as_cloud(points)
    np.testing.assert_allclose(cloud.points + (cloud.origin - far), here.points + here.origin, atol=1e-8)


def test_a_box_and_a_range_leave_out_what_lies_outside():
    points = terrain(0, 2000)
    boxed = as_cloud(points, crop=((0, 0, -9), (10, 10, 9)))
    inside = ((points[:, :2] >= 0) & (points[:, :2] <= 10)).all(axis=1)
    np.testing.assert_array_equal(boxed.rows, np.flatnonzero(inside))
    near = as_cloud(points, viewpoint=(10, 10, 0), max_range=5)
    np.testing.assert_array_equal(
        near.rows, np.flatnonzero(np.linalg.norm(points - [10, 10, 0], axis=1) <= 5)
    )
    np.testing.assert_array_equal(near.viewpoint + near.origin, [10, 10, 0])


@pytest.mark.parametrize("away", [2.0, 1e3, 1e6])
@pytest.mark.parametrize("count", [1, 5])
def test_strays_do_not_widen_the_cloud(away: float, count: int):
    points = terrain(0, 3000)
    rng = np.random.default_rng(1)
    strays = 20 * (1 + away) * (1 + rng.uniform(0, 1, (count, 3)))
    cloud = as_cloud(np.concatenate([points, strays]))
    assert cloud.left_out.stray == count
    assert len(cloud) == 3000


def test_more_columns_and_records_are_read():
    points = terrain(0, 300)
    named = np.zeros(300, [("x", "f8"), ("y", "f8"), ("z", "f8"), ("i", "f4")])
    for axis, column in zip("xyz", points.T, strict=True):
        named[axis] = column
    for given in (np.hstack([points, np.ones((300, 2))]), named, points.tolist()):
        np.testing.assert_array_equal(as_cloud(given).points, as_cloud(points).points)
    cloud = as_cloud(points)
    assert as_cloud(cloud) is cloud
    with pytest.raises(ValueError, match="was read already"):
        as_cloud(cloud, max_range=3.0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (np.zeros((500, 3)), "0 points that can be used, of 500 .left out: 500 zero"),
        (np.full((500, 3), np.nan), "left out: 500 not finite"),
        (np.ones((50, 3)), "1 points that can be used"),
        (np.zeros((0, 3)), "0 points that can be used"),
        (np.zeros((500, 2)), r"shape \(500, 2\)"),
        (np.zeros(500), r"shape \(500,\)"),
        ("scan", "no such file"),
    ],
)
def test_what_is_no_cloud_is_refused_in_words(given, said: str):
    with pytest.raises(ValueError, match=said):
        as_cloud(given, "scan")


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"viewpoint": (0, 0)}, "viewpoint is"),
        ({"viewpoint": (0, np.nan, 0)}, "three finite numbers"),
        ({"crop": ((1, 1, 1), (0, 2, 2))}, "lower and the upper corner"),
        ({"max_range": -1}, "max_range is -1"),
    ],
)
def test_options_that_make_no_sense_are_refused(options: dict, said: str):
    with pytest.raises(ValueError, match=said):
        as_cloud(terrain(0, 300), **options)


@pytest.mark.parametrize("unit", [1e300, 1e-300])
def test_a_unit_that_no_one_can_square_is_refused(unit: float, capfd):
    with pytest.raises(ValueError, match="in a sensible unit"):
        as_cloud(unit * terrain(0, 300))
    assert capfd.readouterr() == ("", "")


def test_cells_are_counted_and_their_means_are_taken():
    points = terrain(0, 3000)
    cells, place = np.unique(np.floor((points - points.min(axis=0)) / 0.7), axis=0, return_inverse=True)
    assert count_cells(points, 0.7) == len(cells)
    found = downsample(points - points.min(axis=0), 0.7)
    means = np.stack([np.bincount(place.ravel(), x) for x in points.T - points.min(axis=0)[:, None]], axis=1)
    means /= np.bincount(place.ravel())[:, None]
    order = lambda x: x[np.lexsort(np.round(x, 6).T)]
    np.testing.assert_allclose(order(found), order(means), atol=1e-9)


@pytest.mark.parametrize("wanted", [50, 500, 3000])
@pytest.mark.parametrize("scene", [terrain, plane])
@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_the_width_leaves_as_many_cells_as_wanted(wanted: int, scene, unit: float):
    points = unit * scene(0, 20_000)
    width = voxel_size_for(points, wanted)
    assert abs(count_cells(points, width) / wanted - 1) < 0.06


def test_the_width_of_odd_clouds_is_a_number_above_zero():
    line = np.linspace(0, 1, 500)[:, None] * [1.0, 2.0, 3.0]
    grid = np.stack(np.meshgrid(*[np.arange(8.0)] * 3), axis=-1).reshape(-1, 3)
    for points in (line, grid, np.zeros((200, 3)), line[:1]):
        for wanted in (1, 100, 10**6):
            assert 0 < voxel_size_for(points, wanted) < np.inf


def test_spacing_is_the_usual_distance_to_the_nearest():
    grid = np.stack(np.meshgrid(*[0.25 * np.arange(12.0)] * 3), axis=-1).reshape(-1, 3)
    assert spacing(Tree(grid)) == pytest.approx(0.25)
    assert spacing(Tree(grid[:1])) == 0


def test_cells_too_many_to_number_are_refused_without_a_word_on_the_terminal(capfd):
    points = terrain(0, 200)
    with pytest.raises(ValueError, match="more than a million cells a side"):
        downsample(points, 1e-6)
    assert capfd.readouterr() == ("", "")


def test_a_cloud_prints_what_it_holds():
    points = terrain(0, 500)
    points[0] = np.nan
    assert repr(as_cloud(points)) == "Cloud(499 of 500 points, left out: 1 not finite)"
    assert isinstance(as_cloud(points), Cloud)
