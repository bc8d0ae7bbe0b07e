"""What a file of a cloud holds, whatever its kind."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, UInt8

from teaser_jax.ground.io import FileError, visible

COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
INTENSITY = ("intensity", "scalar_intensity", "reflectance", "reflectivity", "i")
MOST_NAMED = 8  # columns that are not read


@dataclass(frozen=True, eq=False)
class CloudFile:
    """A ``CloudFile`` holds what a file of a cloud says, as it stands there: nothing is left out yet.

    Attributes:
        points: (n, 3) in float64, in the frame of the file, NaN and zeros included [length].
        colours: (n, 3) red, green, blue, 0 to 255; None: the file has none.
        intensity: (n,) as it stands in the file [-]; None: the file has none.
        ignored: A sentence for what was not read, and for what was read otherwise than the name says.
        triangles: The number of triangles that the points were drawn from; 0: they stand in the file.
    """

    points: Float[np.ndarray, "n 3"]
    colours: UInt8[np.ndarray, "n 3"] | None = None
    intensity: Float[np.ndarray, " n"] | None = None
    ignored: tuple[str, ...] = ()
    triangles: int = 0

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        parts = [f"{len(self)} points"]
        parts += [name for name in ("colours", "intensity") if getattr(self, name) is not None]
        parts += [f"drawn from {self.triangles} triangles"] if self.triangles else []
        return f"CloudFile({', '.join(parts)})"


def from_columns(path: Path, columns: Mapping[str, np.ndarray]) -> CloudFile:
    """Make a cloud of columns with names: x, y, z, and colours and an intensity if they are there.

    Raises:
        FileError: If x, y or z is missing, or holds no numbers.
    """
    known = {name.lower(): column for name, column in columns.items()}
    missing = [axis for axis in "xyz" if axis not in known]
    if missing:
        found = visible(", ".join(columns), 80) or "nothing"
        raise FileError(f"{path}: has no column {missing[0]} (found: {found}): expected x, y, z.")
    if any(known[axis].dtype.kind not in "fiu" for axis in "xyz"):
        raise FileError(f"{path}: holds something else than real numbers as x, y, z.")
    points = np.stack([known[axis].astype(np.float64) for axis in "xyz"], axis=1)
    numbers = {name for name, column in known.items() if column.dtype.kind in "fiu" and column.ndim == 1}
    channels = next((names for names in COLOURS if set(names) <= numbers), ())
    bright = next((name for name in INTENSITY if name in numbers), None)
    colours = as_colours(np.stack([known[name] for name in channels], axis=1)) if channels else None
    intensity = None if bright is None else known[bright].astype(np.float64)
    read = {*"xyz", *channels, bright}
    return CloudFile(
        points, colours, intensity, not_read(name for name in columns if name.lower() not in read)
    )


def not_read(names: Iterable[str]) -> tuple[str, ...]:
    """Say in one sentence which columns were not read; none, if there are none."""
    listed = [visible(name) for name in names]
    if not listed:
        return ()
    more = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
    return (f"not read: {', '.join(listed[:MOST_NAMED])}{more}",)


def as_colours(channels: Any) -> UInt8[np.ndarray, "n 3"]:
    """Read colours of 0 to 1, of 0 to 255 or of 16 bits as 0 to 255; what is no number becomes 0."""
    values = np.nan_to_num(np.asarray(channels, np.float64), nan=0, posinf=0, neginf=0)
    largest = values.max(initial=0)
    fractions = np.asarray(channels).dtype.kind == "f" and largest <= 1
    factor = 255 if fractions else 1 if largest <= 255 else 1 / 257
    return np.clip(np.rint(values * factor), 0, 255).astype(np.uint8)


def wanted_columns(names: Iterable[str]) -> list[int] | None:
    """Tell which columns hold x, y, z, colours and intensity, by names in lower case; None: no x, y, z."""
    listed = list(names)
    if not set("xyz") <= set(listed):
        return None
    channels = next((group for group in COLOURS if set(group) <= set(listed)), ())
    bright = [name for name in INTENSITY if name in listed][:1]
    return [listed.index(name) for name in (*"xyz", *channels, *bright)]
