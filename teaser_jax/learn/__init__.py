"""What training loops call: a teacher, losses, soft matching, a small network and a loop; all under jit."""

from teaser_jax.learn.losses import (
    inlier_loss,
    keypoint_loss,
    matching_loss,
    point_loss,
    rotation_loss,
    translation_loss,
)
from teaser_jax.learn.matching import Matches, match, soft_counterparts
from teaser_jax.learn.network import Scan, describe, init_network, read_scan
from teaser_jax.learn.teacher import Labels, teacher
from teaser_jax.learn.training import (
    History,
    Pairs,
    Teach,
    match_scans,
    read_pairs,
    solver_labels,
    train,
    truth_labels,
)

__all__ = [
    "History", "Labels", "Matches", "Pairs", "Scan", "Teach", "describe", "init_network", "inlier_loss",
    "keypoint_loss", "match", "match_scans", "matching_loss", "point_loss", "read_pairs", "read_scan",
    "rotation_loss", "soft_counterparts", "solver_labels", "teacher", "train", "translation_loss",
    "truth_labels",
]  # fmt: skip
