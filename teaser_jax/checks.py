"""What arguments must be, said in the same words everywhere."""

from __future__ import annotations

from numbers import Integral
from typing import Any

BELOW = 2**31  # counts are 32-bit numbers on a device


def whole_number(
    name: str,
    value: Any,
    least: int,
    *,
    below: int | None = BELOW,
    what: str = "a whole number",
    error: type[ValueError] = ValueError,
) -> int:
    """An argument that counts something.

    Args:
        name: Of the argument.
        value: What was received; numpy's integers are welcome, True and False are not.
        least: The smallest that makes sense.
        below: All that make sense lie below it; None: no end.
        what: It is.
        error: What to raise.

    Raises:
        ValueError: Or ``error``, if it is none, or out of range.
    """
    if isinstance(value, bool) or not isinstance(value, Integral) or value < least:
        raise error(f"{name} is {value!r}: expected {what}, {least} or above.")
    if below is not None and int(value) >= below:
        raise error(f"{name} is {value!r}: expected {what} below {below}.")
    return int(value)
