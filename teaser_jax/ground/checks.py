"""What arguments must be, said in the same words everywhere."""

from __future__ import annotations

from collections.abc import Iterable
from numbers import Integral
from typing import Any

import numpy as np

from teaser_jax.ground.arrays import is_traced

LONGEST = 80  # characters of a value that was received
BELOW = 2**31  # counts are 32-bit numbers on a device


def shown(value: Any) -> str:
    """Write what was received for an error, in one short line."""
    try:
        text = " ".join(repr(value).split())
    except ValueError:  # Python writes no integers of thousands of digits
        return f"{type(value).__name__} of too many digits"
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 3]}..."


def whole_number(
    name: str,
    value: Any,
    least: int,
    *,
    below: int | None = BELOW,
    what: str = "",
    error: type[ValueError] = ValueError,
) -> int:
    """Check an argument that counts something, and return it as an int.

    Args:
        name: The name of the argument.
        value: What was received; numpy's integers are welcome, True and False are not.
        least: The smallest number that makes sense.
        below: All numbers that make sense lie below this one; None: there is no end.
        what: What it counts, in the words of the error.
        error: The kind of error to raise.

    Raises:
        ValueError: Or ``error``, if the value is no whole number, or out of range.
    """
    words = f"a whole number, {what}" if what else "a whole number"
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise error(f"{name} is {shown(value)}: expected {words}, {least} or above.")
    if below is not None and int(value) >= below:
        raise error(f"{name} is {shown(value)}: expected {words} below {below}.")
    return int(value)


def one_of(name: str, value: Any, allowed: Iterable[Any], *, expected: str = "one of") -> None:
    """Raise ValueError unless a value is among the allowed ones, which the error lists.

    Args:
        name: The name of the argument.
        value: What was received.
        allowed: What makes sense.
        expected: The words before the list.
    """
    listed = list(allowed)
    if not any(value is known or (isinstance(value, str) and value == known) for known in listed):
        raise ValueError(f"{name} is {shown(value)}: expected {expected} {', '.join(map(repr, listed))}.")


def check_positive(**numbers: Any) -> None:
    """Raise ValueError for a number or an array that is not finite and above 0; tracers pass unseen.

    Args:
        numbers: The arguments by their names, which the error repeats.
    """
    for name, value in numbers.items():
        if is_traced(value):
            continue
        try:
            given = np.asarray(value, float)
        except (TypeError, ValueError, OverflowError):  # texts, lists of any length, integers without end
            given = np.asarray(np.nan)
        if not (np.isfinite(given).all() and (given > 0).all()):
            raise ValueError(f"{name} is {shown(value)}: expected a finite number above 0.")
