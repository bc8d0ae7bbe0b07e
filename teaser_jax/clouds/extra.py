"""The libraries of the extra ``clouds``, or the one line that installs them."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from types import ModuleType


def needed(module: str, what: str) -> ModuleType:
    """Import a library of the extra. Raises ImportError with the line that installs it."""
    try:
        return import_module(module)
    except ImportError as error:
        raise ImportError(
            f"{what} needs {module.split('.')[0]}: install it with  pip install 'teaser-jax[clouds]'"
        ) from error


@cache
def small_gicp() -> ModuleType:
    """Import the library of voxels, neighbours and fine registration."""
    return needed("small_gicp", "the registration of clouds")
