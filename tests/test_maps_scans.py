"""Maps of scans: a loop of thirty ray-cast ones, two places of which are alike, and real ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from ray_casting import loop_of_scans

from teaser_jax.maps.motions import inverse
from teaser_jax.maps.pair import MapPair
from teaser_jax.maps.register import register_many
from teaser_jax.maps.result import CloudMap

pytest.importorskip("small_gicp", reason="needs the extra clouds")

FAMILIES = {
    # names, the pairs that may be off by so much, how many pairs are trusted at the least
    "kitchen": (["kitchen_00", "kitchen_01", "kitchen_02", "kitchen_07"], 0.10, 5),
    "kitti": ([f"kitti00_{k:06d}" for k in (0, 2, 4, 6, 20, 4413)], 0.15, 15),
    "kitti07": (["kitti07_0", "kitti07_1", "kitti07_2"], 0.15, 3),
    "bunny": (["bunny_bun000", "bunny_bun045", "bunny_bun090", "bunny_top3", "bunny_ear_back"], 0.003, 8),
}


def displacement(points: np.ndarray, T: np.ndarray, truth: np.ndarray) -> float:
    off = points @ (T - truth)[:3, :3].T + (T - truth)[:3, 3]
    return float(np.linalg.norm(off, axis=1).mean())


def is_right(pair: MapPair, clouds: list[np.ndarray], truth: np.ndarray) -> bool:
    return displacement(clouds[pair.j], pair.T, inverse(truth[pair.i]) @ truth[pair.j]) < 0.5


def check_loop(result: CloudMap, clouds: list[np.ndarray], truth: np.ndarray) -> None:
    """No false pair is kept, no true one refused, and clouds are where they should be."""
    assert not result.ok
    assert len(result.doubts) >= 5
    assert all(is_right(pair, clouds, truth) for pair in result.kept)
    assert not any(is_right(pair, clouds, truth) for pair, _ in result.refused)
    first = np.flatnonzero(result.placed)[0]
    home = inverse(truth[first]) @ truth
    off = [displacement(clouds[k], result.poses[k], home[k]) for k in np.flatnonzero(result.placed)]
    assert max(off) < 0.3


@pytest.mark.slow
def test_a_loop_of_thirty_scans_with_two_corners_alike():
    clouds, truth = loop_of_scans(30, 0, 8.0, columns=400)
    near = {tuple(sorted((i, (i + gap) % 30))) for i in range(30) for gap in (1, 2, 3)}
    corners = {(i, j) for i in (0, 1, 2) for j in (13, 14, 15, 16)} | {(j, 29) for j in (14, 15)}
    result = register_many(clouds, viewpoint=[0, 0, 0], pairs=near | corners, workers=2)
    false = [pair for pair in result.pairs if pair.ok and not is_right(pair, clouds, truth)]
    assert len(false) >= 5  # two clouds alone cannot tell these corners apart
    assert {id(pair) for pair, _ in result.refused} == {id(pair) for pair in false}
    assert result.placed.all()
    assert result.confirmed.all()
    check_loop(result, clouds, truth)


@pytest.mark.slow
@pytest.mark.parametrize("family", FAMILIES)
def test_real_scans_lie_where_they_should(family: str, data_dir: Path):
    names, allowed, trusted = FAMILIES[family]
    folder = data_dir / "cloud_pairs"
    result = register_many([folder / f"{name}.npz" for name in names])
    assert result.ok
    assert len(result.kept) >= trusted
    known = 0
    for row in json.loads((folder / "pairs.json").read_text()):
        if row["dst"] in names and row["src"] in names:
            i, j = names.index(row["dst"]), names.index(row["src"])
            points = np.load(folder / f"{row['src']}.npz")["points"][::50].astype(float)
            T = inverse(result.poses[i]) @ result.poses[j]
            assert displacement(points, T, np.reshape(row["T_dst_src"], (4, 4))) < allowed
            known += 1
    assert known >= 3
