"""The clouds of a map: looked at once, and prepared again when they are asked for, a few being held."""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from teaser_jax.clouds.cloud import Cloud
from teaser_jax.clouds.prepared import Prepared, prepare

HELD = 32  # prepared clouds, of some 30 MB each


class Reading(NamedTuple):
    """How clouds are read: as in ``prepare``."""

    viewpoint: Any = None
    crop: Any = None
    max_range: float | None = None
    threads: int | None = None


class Looked(NamedTuple):
    """What is known of a cloud after it was read once.

    Attributes:
        name: What to call it.
        origin: Its middle, in its own frame [length].
        digest: A number of its points and viewpoint, in hexadecimal digits: another cloud has another.
        size: How many points it has that can be used.
    """

    name: str
    origin: Float[np.ndarray, "3"]
    digest: str
    size: int


@dataclass(frozen=True, eq=False)
class Shelf:
    """Clouds by their number.

    Attributes:
        values: What the user gave: arrays, paths, prepared clouds.
        names: What to call them.
        reading: How to read them.
    """

    values: Sequence[Any]
    names: Sequence[str]
    reading: Reading
    _held: OrderedDict[int, Prepared] = field(default_factory=OrderedDict)

    def __len__(self) -> int:
        return len(self.values)

    def __getitem__(self, k: int) -> Prepared:
        """Prepare a cloud, or take it from those that are held. Raises ValueError if it cannot be read."""
        value = self.values[k]
        if isinstance(value, Prepared):
            return value
        if k not in self._held:
            how = self.reading
            self._held[k] = prepare(
                value, name=self.names[k], viewpoint=how.viewpoint, crop=how.crop, max_range=how.max_range,
                threads=how.threads,
            )  # fmt: skip
            if len(self._held) > HELD:
                self._held.popitem(last=False)
        self._held.move_to_end(k)
        return self._held[k]

    def fresh(self, threads: int) -> Shelf:
        """Copy the shelf as other processes can receive it, without what was found of its clouds."""
        values = [
            Prepared(x.cloud, threads, is_kept=True) if isinstance(x, Prepared) else x for x in self.values
        ]
        return Shelf(values, self.names, self.reading._replace(threads=threads))

    def look(self) -> Iterator[Looked]:
        """Read each cloud once. Raises ValueError for one that cannot be read."""
        for k, name in enumerate(self.names):
            cloud = self[k].cloud
            yield Looked(name, cloud.origin, _digest(cloud), len(cloud))


def named(values: Sequence[Any], names: Sequence[str] | None) -> list[str]:
    """Call clouds by the names that were given, by those of their files, or by their numbers.

    Raises:
        ValueError: If there are names for another number of clouds.
    """
    if names is not None:
        if len(names) != len(values):
            raise ValueError(f"names has {len(names)} entries for {len(values)} clouds: give one for each.")
        return [str(name) for name in names]
    return [
        Path(value).name if isinstance(value, (str, PathLike)) else f"cloud {k}"
        for k, value in enumerate(values)
    ]


def _digest(cloud: Cloud) -> str:
    found = hashlib.blake2b(digest_size=12)
    for part in (cloud.points, cloud.origin, cloud.viewpoint):
        found.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
    return found.hexdigest()
