"""Robust 3-D point-cloud registration that is certifiable, differentiable and batched, in JAX."""

from teaser_jax import files, learn, metrics, plots, so3, studies, synthetic
from teaser_jax.batch.run import solve_batch
from teaser_jax.certify.certificate import Certificate, CertificateStatus, CertifiedBy
from teaser_jax.certify.error_bounds import ErrorBounds, error_bounds
from teaser_jax.certify.pose import certify
from teaser_jax.certify.rotation import certify_rotation
from teaser_jax.certify.verify import verify
from teaser_jax.problem import make_problem, stack_problems
from teaser_jax.profile import Profile, profile
from teaser_jax.register import Registration, host_problem, register, warmup
from teaser_jax.soft import SoftSolution, soft_solve
from teaser_jax.solve import refit, select, solve
from teaser_jax.solve_rotation import RotationSolution, solve_rotation
from teaser_jax.types import Pose, Problem, Selection, Settings, Solution, Status
from teaser_jax.uncertainty import Uncertainty, covariance, pose_difference

__version__ = "0.1.0"

__all__ = [
    "Certificate", "CertificateStatus", "CertifiedBy", "ErrorBounds", "Pose", "Problem", "Profile",
    "Registration", "RotationSolution", "Selection", "Settings", "SoftSolution", "Solution", "Status",
    "Uncertainty", "certify", "certify_rotation", "covariance", "error_bounds", "files", "host_problem",
    "learn", "make_problem", "metrics", "plots", "pose_difference", "profile", "refit", "register", "select",
    "so3", "soft_solve", "solve", "solve_batch", "solve_rotation", "stack_problems", "studies", "synthetic",
    "verify", "warmup",
]  # fmt: skip
