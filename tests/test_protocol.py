"""What the README promises, on the paper's protocol: minutes of work, so marked slow."""

from __future__ import annotations

import jax
import numpy as np
import pytest

import teaser_jax as tj
from teaser_jax.stages.refinement import fit_similarity

TRIALS = 20
# N, share wrong, unknown scale
CELLS = [
    *((100, rate, False) for rate in (0.0, 0.5, 0.7, 0.9)),
    *((1000, rate, False) for rate in (0.95, 0.97, 0.99)),
    *((100, rate, True) for rate in (0.0, 0.5, 0.8)),
]


@pytest.mark.slow
@pytest.mark.parametrize(("n", "rate", "unknown"), CELLS)
def test_right_trusted_and_as_accurate_as_least_squares_on_the_true_inliers(n, rate, unknown):
    found, limit = [], []
    for trial in range(TRIALS):
        known = dict(scale=(1.0, 5.0)) if unknown else {}
        p = tj.synthetic.random_problem((n, round(100 * rate), trial), n=n, outlier_rate=rate, **known)
        scale = None if unknown else 1.0
        result = tj.register(p.src, p.dst, noise_bound=p.noise_bound, scale=scale)
        assert result.ok
        with jax.enable_x64(True):
            best = jax.device_get(fit_similarity(p.src, p.dst, p.inliers.astype(float), scale).pose)
        found.append(tj.metrics.errors(result.pose, p.truth))
        limit.append(tj.metrics.errors(best, p.truth))
    assert max(e.rotation_deg for e in found) < 5
    assert np.median([e.rotation for e in found]) <= 1.05 * np.median([e.rotation for e in limit])
    assert np.median([e.translation for e in found]) <= 1.05 * np.median([e.translation for e in limit])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["uniform", "one to one", "many to one"])
def test_wrong_matches_are_hardly_ever_trusted(kind):
    trusted = 0
    for trial in range(50):
        known = dict(n=(30, 100, 300)[trial % 3], outlier_rate=1.0, sigma=0.01, noise_bound=0.0554)
        if kind == "uniform":
            p = tj.synthetic.random_problem((9, trial), radius=1.0, **known)
        else:
            hubs = 1.0 if kind == "one to one" else 0.2
            p = tj.synthetic.descriptor_problem((9, trial), hubs=hubs, **known)
        trusted += tj.register(p.src, p.dst, noise_bound=p.noise_bound).ok
    assert trusted <= 1
