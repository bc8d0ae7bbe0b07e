"""Problems, models and scans that follow from a seed, with known answers. numpy on the host."""

from teaser_jax.synthetic.models import Shape, Triangles, sample_model, teapot
from teaser_jax.synthetic.protocol import (
    BOUND_PER_SIGMA,
    SIGMA,
    SyntheticProblem,
    all_to_all,
    bounded_noise,
    descriptor_problem,
    draw_rotation,
    in_ball,
    random_problem,
)
from teaser_jax.synthetic.scans import ScanPair, partial_scan, scan_pair
from teaser_jax.synthetic.solids import KINDS, Kind, random_solid

__all__ = [
    "BOUND_PER_SIGMA", "KINDS", "SIGMA", "Kind", "ScanPair", "Shape", "SyntheticProblem", "Triangles",
    "all_to_all", "bounded_noise", "descriptor_problem", "draw_rotation", "in_ball", "partial_scan",
    "random_problem", "random_solid", "sample_model", "scan_pair", "teapot",
]  # fmt: skip
