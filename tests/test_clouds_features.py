"""Normals, histograms and matches of points that look alike, against slow oracles."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cloud_scenes import corner, slow_fpfh, sphere, terrain
from oracles import random_pose

pytest.importorskip("small_gicp", reason="needs the extra clouds")

from teaser_jax.clouds.features.fpfh import Descriptors, fpfh
from teaser_jax.clouds.features.matching import match, nearest
from teaser_jax.clouds.features.normals import normals
from teaser_jax.clouds.neighbours import Neighbours, Tree
from teaser_jax.clouds.sizes import rows_for
from teaser_jax.clouds.surface import Surface

F32 = np.float32


def among(points: np.ndarray, count: int) -> Neighbours:
    found = Tree(points).neighbours(points, count)
    return Neighbours(jnp.asarray(found.rows), jnp.asarray(found.squared, jnp.float32))


def test_neighbours_are_those_of_a_full_table():
    points = terrain(0, 200)
    found = Tree(points).neighbours(points[:50], 7)
    table = np.sum((points[:50, None] - points[None]) ** 2, axis=2)
    np.testing.assert_allclose(found.squared, np.sort(table, axis=1)[:, :7], atol=1e-12)
    np.testing.assert_array_equal(found.rows[:, 0], np.arange(50))


def test_a_place_without_a_neighbour_is_infinitely_far():
    points = terrain(0, 4)
    found = Tree(points).neighbours(points, 6)
    assert found.rows.shape == (4, 6)
    assert np.isinf(found.squared[:, 4:]).all()
    assert not found.within(1e9)[:, 4:].any()


def test_normals_of_a_sphere_lie_along_its_radii():
    points = sphere(0)
    found = np.asarray(normals(jnp.asarray(points, jnp.float32), among(points, 30), F32(0.2)))
    assert np.quantile(np.abs(np.sum(found * points, axis=1)), 0.01) > 0.99
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-5)


def test_normals_point_towards_the_viewpoint():
    points, eye = corner(0), np.array([1.5, 1.2, 1.0], F32)
    found = np.asarray(
        normals(jnp.asarray(points, jnp.float32), among(points, 30), F32(0.2), jnp.asarray(eye))
    )
    some = np.any(found != 0, axis=1)
    assert some.mean() > 0.99
    assert (np.sum(found * (points - eye), axis=1)[some] <= 0).all()


@pytest.mark.parametrize("kind", ["line", "few", "one place"])
def test_what_is_no_surface_has_no_normal(kind: str):
    line = np.linspace(0, 1, 20)[:, None] * np.array([1.0, 2.0, 3.0])
    points = {"line": line, "few": corner(0)[:4], "one place": np.ones((9, 3))}[kind]
    found = np.asarray(normals(jnp.asarray(points, jnp.float32), among(points, 8), F32(9.0)))
    np.testing.assert_array_equal(found, 0)


@pytest.mark.parametrize("orientation", ["local", "given"])
def test_histograms_are_those_of_the_oracle(orientation: str, x64: None):
    points = terrain(1, 150, 0.0, 3.0) * np.array([1.0, 0.2, 1.0])
    found = Tree(points).neighbours(points, 60)
    neighbours = Neighbours(jnp.asarray(found.rows), jnp.asarray(found.squared))
    across = sphere(3, len(points))  # of true normals some pairs are level: rounding would choose the first
    across[::10] = 0
    described = fpfh(
        jnp.asarray(points), jnp.asarray(across), neighbours, np.float64(0.9), orientation=orientation
    )
    expected, valid = slow_fpfh(points, across, 0.9, orientation == "local")
    np.testing.assert_array_equal(described.valid, valid)
    assert valid.sum() > 120
    np.testing.assert_allclose(described.values, expected, atol=1e-9)


def test_each_angle_has_two_hundred_counts():
    points = terrain(1, 300, 0.0, 3.0) * np.array([1.0, 0.2, 1.0])
    neighbours = among(points, 60)
    across = normals(jnp.asarray(points, jnp.float32), neighbours, F32(0.8))
    found = fpfh(jnp.asarray(points, jnp.float32), across, neighbours, F32(0.9))
    total = np.asarray(found.values).reshape(-1, 3, 11).sum(axis=2)[np.asarray(found.valid)]
    np.testing.assert_allclose(total, 200, rtol=1e-4)


def test_padding_and_a_batch_change_nothing():
    points = terrain(1, 150, 0.0, 3.0) * np.array([1.0, 0.2, 1.0])
    one = among(points, 40)
    across = normals(jnp.asarray(points, jnp.float32), one, F32(0.8))
    here = jnp.asarray(points, jnp.float32)
    alone = fpfh(here, across, one, F32(0.9))
    more = ((0, 50), (0, 0))
    padded = Neighbours(jnp.pad(one.rows, more), jnp.pad(one.squared, more, constant_values=np.inf))
    wide = fpfh(jnp.pad(here, more), jnp.pad(across, more), padded, F32(0.9))
    np.testing.assert_allclose(wide.values[:150], alone.values, atol=1e-3)
    assert not np.asarray(wide.valid)[150:].any()
    two = jax.tree.map(lambda x: jnp.stack([x, x]), (here, across, one))
    batch = jax.vmap(lambda x: fpfh(*x, F32(0.9)))(two)
    np.testing.assert_allclose(batch.values[1], alone.values, atol=1e-3)


def test_histograms_stay_when_the_cloud_moves():
    points = terrain(2, 4000)
    moved = random_pose(np.random.default_rng(0)).apply(points)
    one, other = (Surface(x - x.mean(axis=0), 0.35).descriptors for x in (points, moved))
    both = one.valid & other.valid
    away = np.abs(one.values - other.values).sum(axis=1)[both]
    assert both.mean() > 0.9
    # The sign of a normal across a patch that is nearly flat is a toss-up.
    assert np.median(away) < 1.0


def test_nearest_rows_are_those_of_a_full_table():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(300, 5)).astype(F32), rng.normal(size=(200, 5)).astype(F32)
    usable_a, usable_b = rng.uniform(size=300) < 0.9, rng.uniform(size=200) < 0.9
    found = nearest(*(jnp.asarray(x) for x in (a, b, usable_a, usable_b)))
    table = np.sum((a[:, None] - b[None]) ** 2, axis=2)
    table[:, ~usable_b] = np.inf
    np.testing.assert_array_equal(found.row, table.argmin(axis=1))
    ordered = np.sort(table, axis=1)
    np.testing.assert_allclose(found.distance, ordered[:, 0], atol=1e-4)
    np.testing.assert_allclose(found.second, ordered[:, 1], atol=1e-4)
    table[~usable_a] = np.inf
    np.testing.assert_array_equal(np.asarray(found.back)[usable_b], table.argmin(axis=0)[usable_b])


def described(rows: np.ndarray, valid: np.ndarray | None = None) -> Descriptors:
    return Descriptors(
        jnp.asarray(rows, jnp.float32), jnp.asarray(np.ones(len(rows), bool) if valid is None else valid)
    )


def test_matches_come_the_clearest_first_and_mutual_ones_are_each_others_nearest():
    rng = np.random.default_rng(0)
    b = rng.normal(size=(60, 8))
    a = b[rng.permutation(60)[:40]] + 0.1 * rng.normal(size=(40, 8))
    mutual, all_of_them = (match(described(a), described(b), mutual=x) for x in (True, False))
    table = np.sum((a[:, None] - b[None]) ** 2, axis=2)
    for i, j in mutual.rows:
        assert table[i].argmin() == j
        assert table[:, j].argmin() == i
    assert len(all_of_them.rows) == 40 >= len(mutual.rows) > 20
    assert (np.diff(mutual.ratio) >= 0).all()
    assert len(match(described(a), described(b), most=5).rows) == 5


def test_points_without_surroundings_are_not_matched():
    rows = np.random.default_rng(0).normal(size=(30, 4))
    valid = np.arange(30) >= 10
    found = match(described(rows, valid), described(rows, valid), mutual=False)
    np.testing.assert_array_equal(np.sort(found.rows[:, 0]), np.arange(10, 30))
    np.testing.assert_array_equal(found.rows[:, 0], found.rows[:, 1])
    assert len(match(described(rows, ~valid & valid), described(rows)).rows) == 0


def test_descriptors_of_two_kinds_are_refused():
    with pytest.raises(ValueError, match="3 and 4 numbers a point"):
        match(described(np.ones((5, 3))), described(np.ones((5, 4))))


def test_programs_are_compiled_for_few_sizes():
    sizes = {rows_for(n) for n in range(1, 20_000, 7)}
    assert len(sizes) <= 8
    assert all(rows_for(n) >= n for n in range(1, 20_000, 7))
