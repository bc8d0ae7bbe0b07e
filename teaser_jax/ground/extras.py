"""Libraries that only some work needs, or the one line that installs them."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


class MissingExtra(ImportError):
    """A library that is not installed. The message is the line that installs it."""


def needed(module: str, what: str, extra: str) -> ModuleType:
    """Import a library of an extra.

    Args:
        module: The module to import.
        what: Who needs which library, as in "plots need matplotlib".
        extra: The extra that brings it.

    Raises:
        MissingExtra: If it is missing, with the line that installs it.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise MissingExtra(f"{what}: pip install 'teaser-jax[{extra}]'") from error
