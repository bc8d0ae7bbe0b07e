"""Models to scan and sample: procedural families, and the real ones where there are data."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.problems import DATA
from teaser_jax import synthetic

DENSE = 20_000  # points of a surface
Points = np.ndarray


def family(seed: int, kinds: tuple[synthetic.Kind, ...], count: int) -> list[Points]:
    """Different solids of some kinds of parts."""
    return [synthetic.random_solid((seed, k), kinds=kinds, n=DENSE) for k in range(count)]


def unit(points: Points) -> Points:
    """About the origin, the longest side being 1."""
    low, high = points.min(axis=0), points.max(axis=0)
    return (points - (low + high) / 2) / (high - low).max()


def real_models() -> dict[str, list[Points]]:
    """Bunny, Armadillo and Dragon; empty where there are no data."""
    folder = DATA / "models"
    if not folder.is_dir():
        return {}
    bunny = synthetic.sample_model(np.random.default_rng(0), DENSE, bunny_mesh(folder / "bunny.ply"))
    clouds = {
        "bunny": bunny,
        "armadillo": np.load(folder / "armadillo.npy"),
        "dragon": np.load(folder / "dragon_scan1.npy"),
    }
    return {name: [unit(np.asarray(points, np.float64))] for name, points in clouds.items()}


def bunny_mesh(path: Path) -> synthetic.Mesh:
    """Vertices and triangles of an ASCII PLY file."""
    lines = path.read_text().splitlines()
    start = lines.index("end_header") + 1
    counts = {line.split()[1]: int(line.split()[2]) for line in lines[:start] if line.startswith("element")}
    vertices = np.array([line.split()[:3] for line in lines[start : start + counts["vertex"]]], np.float64)
    rest = lines[start + counts["vertex"] :][: counts["face"]]
    return synthetic.Mesh(vertices, np.array([line.split()[1:4] for line in rest], np.int64))
