"""Fields of method records: numbers that programs are sent, and counts that programs are compiled for.

A record of a method (``Gnc(factor=1.4, iterations=100)``) states each default and what may be asked for
where it is defined. *Numbers* are traced: to change one compiles nothing, so whole numbers and numpy's are
made plain floats at once. *Counts* are static: to change one compiles anew. JAX rebuilds records all the
time, also from placeholders that are no numbers; only what is a number is checked then.
"""

from __future__ import annotations

import enum
from dataclasses import Field, dataclass, field, fields
from numbers import Real
from typing import Any, TypeAlias

import numpy as np
from jaxtyping import Num

from teaser_jax.ground.arrays import AnyArray, Placeholder, is_traced
from teaser_jax.ground.checks import one_of, shown, whole_number

# What a traced field holds: a number that is known, or an array of one; with the axes of a batch, of many.
TracedNumber: TypeAlias = float | Num[AnyArray, "..."] | Placeholder

RULE, NAME = "rule", "name"


class NamedNumber(enum.IntEnum):
    """Numbers with names: a number inside JAX, and printed by its name."""

    def __str__(self) -> str:
        return self.name

    def __format__(self, spec: str) -> str:
        return format(int(self), spec) if spec.endswith("d") else format(self.name, spec)


@dataclass(frozen=True)
class NumberRule:
    """What a number may be: at least ``least``, or above ``above``, and finite unless ``infinite``."""

    least: float = -np.inf
    above: float = -np.inf
    infinite: bool = False

    def admits(self, value: float) -> bool:
        """Tell whether a number keeps the rule."""
        return value >= self.least and value > self.above and (self.infinite or bool(np.isfinite(value)))

    @property
    def words(self) -> str:
        """What is expected, for an error."""
        return f"a number above {self.above:g}" if self.above > -np.inf else f"{self.least:g} or more"


@dataclass(frozen=True)
class CountRule:
    """What a count may be: a whole number of at least ``least``."""

    least: int


def number(default: float, *, least: float = -np.inf, above: float = -np.inf, infinite: bool = False) -> Any:
    """Make a traced field of a record.

    Args:
        default: What the field is unless it is given.
        least, above: The smallest number that makes sense, or the one below all that do.
        infinite: Whether infinity makes sense.
    """
    return field(default=default, metadata={RULE: NumberRule(least, above, infinite)})


def count(default: int, *, least: int = 1, traced: bool = False) -> Any:
    """Make a field of a record that holds a whole number; static unless ``traced``.

    Args:
        default: What the field is unless it is given.
        least: The smallest number that makes sense.
        traced: Whether the number is sent to programs instead of being compiled into them.
    """
    return field(default=default, metadata={RULE: CountRule(least), "static": not traced})


def named(name: str) -> Any:
    """Make a static field that tells a method from every other, which JAX does not.

    JAX takes two records for one structure if their fields are alike, whatever their classes are: without a
    name, a program compiled for one method would be run for another.
    """
    return field(default=name, repr=False, kw_only=True, metadata={"static": True, NAME: True})


def settle(record: Any) -> None:
    """Check the numbers that a new record holds, and make plain Python numbers of them.

    Raises:
        ValueError: If one breaks its rule, or is a text or a truth value.
    """
    _check_name(record)
    for each in fields(record):
        value, rule = getattr(record, each.name), each.metadata.get(RULE)
        if rule is not None and isinstance(value, str | Real | np.bool_):
            object.__setattr__(record, each.name, _checked(record, each, value))


def as_record(name: str, choice: Any, known: dict[str, Any]) -> Any:
    """Return the record that a name stands for; anything else, a record or a placeholder of JAX, passes.

    Raises:
        ValueError: If the name is unknown.
    """
    if not isinstance(choice, str):
        return choice
    one_of(name, choice, known)
    return known[choice]()


def check_concrete(record: Any) -> None:
    """Check that every number of a record is known and keeps its rule; tracers pass.

    Raises:
        ValueError: If one is missing, no number at all, or out of range.
    """
    _check_name(record)
    for each in fields(record):
        value, rule = getattr(record, each.name), each.metadata.get(RULE)
        if rule is None or is_traced(value):
            continue
        _checked(record, each, _as_scalar(value))


def _check_name(record: Any) -> None:
    """Raise ValueError if the name that tells a method from every other was given as if it were a choice."""
    for each in fields(record):
        given = getattr(record, each.name)
        if each.metadata.get(NAME) and not (isinstance(given, str) and given == each.default):
            raise ValueError(
                f"{type(record).__name__}.{each.name} is {shown(given)}: it is always {each.default!r}, "
                "so leave it out."
            )


def _as_scalar(value: Any) -> Any:
    """Take the number out of an array of no axes; whatever else comes is returned."""
    is_array = hasattr(value, "dtype") and np.ndim(value) == 0 and not np.ma.is_masked(value)
    return np.asarray(value).item() if is_array else value


def as_float(value: Any) -> float:
    """Convert a number; an integer beyond all floats becomes infinite."""
    try:
        return float(value)
    except OverflowError:
        return np.inf if value > 0 else -np.inf


def _checked(record: Any, which: Field[Any], value: Any) -> float | int:
    """Turn a number into a Python float or int; ValueError if it breaks its rule."""
    name, rule = f"{type(record).__name__}.{which.name}", which.metadata[RULE]
    if isinstance(rule, CountRule):
        return whole_number(name, value, rule.least)
    return checked_number(name, value, rule)


def checked_number(name: str, value: Any, rule: NumberRule) -> float:
    """Check a number by a rule, and make a Python float of it.

    Raises:
        ValueError: If it is no number, or breaks the rule.
    """
    value = _as_scalar(value)
    if isinstance(value, bool | np.bool_) or not isinstance(value, Real) or not rule.admits(as_float(value)):
        raise ValueError(f"{name} is {shown(value)}: expected {rule.words}.")
    return as_float(value)
