"""Named steps: the method runs its stages by a function that others may replace, to time them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeAlias

Run: TypeAlias = Callable[..., Any]  # (name of the stage, function, *inputs, **choices) -> its output


def plainly(name: str, stage: Callable[..., Any], *inputs: Any, **choices: Any) -> Any:
    """Run a stage; its name is for those who time it."""
    return stage(*inputs, **choices)
