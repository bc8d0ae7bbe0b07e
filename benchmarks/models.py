"""Models to scan and sample: procedural families, and the real ones where there are data."""

from __future__ import annotations

import numpy as np

from benchmarks.problems import DATA
from teaser_jax import studies, synthetic

FILES = {"bunny": "bunny.ply", "armadillo": "armadillo.npy", "dragon": "dragon_scan1.npy"}
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
    shape = {name: studies.read_model(folder / file).shape for name, file in FILES.items()}
    clouds = shape | {"bunny": synthetic.sample_model(np.random.default_rng(0), DENSE, shape["bunny"])}
    return {name: [unit(np.asarray(points, np.float64))] for name, points in clouds.items()}
