"""The library of the extra ``clouds`` for voxels, neighbours and fine registration."""

from __future__ import annotations

from functools import cache
from types import ModuleType

from teaser_jax.ground.extras import needed


@cache
def small_gicp() -> ModuleType:
    """Import the library, or raise ImportError with the line that installs it."""
    return needed("small_gicp", "the registration of clouds needs small_gicp", "clouds")
