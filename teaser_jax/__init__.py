"""Robust 3-D point-cloud registration that is certifiable, differentiable and batched, in JAX.

``register_clouds`` takes two raw clouds and ``register`` matched points, both on the host; ``solve`` is the
latter under jit, vmap and grad; ``solve_batch`` takes thousands. Everything loads when it is first used.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

import teaser_jax.ground.forks  # noqa: F401  watches for forks from the import on

__version__ = "0.1.0"

if TYPE_CHECKING:  # for editors and type checkers: at run time the table below is asked
    from teaser_jax import files, learn, metrics, plots, settings, so3, studies, synthetic
    from teaser_jax.all_to_all import AllToAll, all_to_all
    from teaser_jax.certify.certificate import Certificate
    from teaser_jax.certify.error_bounds import error_bounds
    from teaser_jax.certify.pose import certify
    from teaser_jax.certify.rotation import certify_rotation
    from teaser_jax.certify.verify import verify
    from teaser_jax.clouds.prepared import prepare
    from teaser_jax.clouds.register import register_clouds
    from teaser_jax.clouds.registration import CloudRegistration
    from teaser_jax.maps.register import register_many
    from teaser_jax.maps.result import CloudMap
    from teaser_jax.plots.either import plot
    from teaser_jax.pose import Pose
    from teaser_jax.problem import Problem, host_problem, make_problem, stack_problems
    from teaser_jax.profile import profile
    from teaser_jax.refit import refit
    from teaser_jax.register import Registration, register, warmup
    from teaser_jax.settings import Settings
    from teaser_jax.soft import soft_solve
    from teaser_jax.solution import Selection, Solution, Status
    from teaser_jax.solve import select, solve
    from teaser_jax.solve_batch import solve_batch
    from teaser_jax.solve_rotation import solve_rotation
    from teaser_jax.uncertainty import covariance

# The module that each name of the front page lives in.
_HOMES = {
    "register_clouds": "clouds.register", "CloudRegistration": "clouds.registration",
    "prepare": "clouds.prepared", "all_to_all": "all_to_all", "AllToAll": "all_to_all",
    "register_many": "maps.register", "CloudMap": "maps.result",
    "register": "register", "Registration": "register", "warmup": "register", "profile": "profile",
    "solve": "solve", "select": "solve", "refit": "refit", "soft_solve": "soft",
    "solve_batch": "solve_batch", "solve_rotation": "solve_rotation",
    "make_problem": "problem", "host_problem": "problem", "stack_problems": "problem", "Problem": "problem",
    "Pose": "pose", "Settings": "settings", "Status": "solution", "Selection": "solution",
    "Solution": "solution", "certify": "certify.pose", "certify_rotation": "certify.rotation",
    "verify": "certify.verify", "Certificate": "certify.certificate",
    "error_bounds": "certify.error_bounds", "covariance": "uncertainty", "plot": "plots.either",
}  # fmt: skip
_MODULES = ("files", "learn", "metrics", "plots", "settings", "so3", "studies", "synthetic")

__all__ = [
    "AllToAll", "Certificate", "CloudMap", "CloudRegistration", "Pose", "Problem", "Registration",
    "Selection", "Settings", "Solution", "Status", "all_to_all", "certify", "certify_rotation", "covariance",
    "error_bounds", "files", "host_problem", "learn", "make_problem", "metrics", "plot", "plots", "prepare",
    "profile", "refit", "register", "register_clouds", "register_many", "select", "settings", "so3",
    "soft_solve", "solve", "solve_batch", "solve_rotation", "stack_problems", "studies", "synthetic",
    "verify", "warmup",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return import_module(f"teaser_jax.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'teaser_jax' has no attribute {name!r}")
    found = getattr(import_module(f"teaser_jax.{_HOMES[name]}"), name)
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*__all__, *(name for name in globals() if name.startswith("__"))})


class _FrontPage(ModuleType):
    """A package whose functions are not hidden by the modules of the same name that they live in."""

    def __setattr__(self, name: str, value: Any) -> None:
        # Python binds each module that loads to its package: `teaser_jax.solve` must stay the function.
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _FrontPage
