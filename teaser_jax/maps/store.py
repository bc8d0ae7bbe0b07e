"""Pairs that are done, each in a small file of its own: whatever ends the work, it goes on where it was.

A file is called by what its answer depends on, which is the points of both clouds and the options; so one of
other clouds is never taken for it. What cannot be read is asked anew.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path

from teaser_jax import __version__
from teaser_jax.ground.io import FileError, os_errors_named, replacing
from teaser_jax.maps.pair import MapPair, as_plain, from_plain
from teaser_jax.maps.shelf import Looked


@dataclass(frozen=True)
class Store:
    """A folder of pairs.

    Attributes:
        folder: Where it is.
        options: What else the answers depend on, in words.
    """

    folder: Path
    options: str

    def path(self, i: Looked, j: Looked) -> Path:
        """Name the file of a pair."""
        what = "\n".join((__version__, i.digest, j.digest, self.options))
        return self.folder / f"pair_{hashlib.blake2b(what.encode(), digest_size=10).hexdigest()}.json"

    def read(self, i: int, j: int, looked: list[Looked]) -> MapPair | None:
        """Read a pair; None: it is not there, or a file that something broke."""
        path = self.path(looked[i], looked[j])
        try:
            return from_plain(i, j, json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, KeyError, TypeError):
            return None

    def write(self, pair: MapPair, i: Looked, j: Looked) -> None:
        """Write a pair, whole or not at all. Raises FileError if that cannot be."""
        path = self.path(i, j)
        held = {"clouds": [i.name, j.name], **as_plain(pair)}
        with os_errors_named(path, "cannot be written"), replacing(path) as partial:
            partial.write_text(json.dumps(held, allow_nan=False), encoding="utf-8")


def open_store(folder: str | os.PathLike[str], options: str) -> Store:
    """Make the folder of a store where there is none.

    Raises:
        FileError: If it cannot be made, or written to.
    """
    path = Path(folder)
    with os_errors_named(path, "cannot be made"):
        path.mkdir(parents=True, exist_ok=True)
    if not os.access(path, os.W_OK):
        raise FileError(f"{path}: cannot be written to: no permission.")
    return Store(path, options)
