"""Answers in a file, a line each as soon as it is there, so that a run that ended goes on where it was."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import teaser_jax
from teaser_jax.files import FileError
from teaser_jax.ground.io import or_file_error, replacing

Key = tuple[str, str, str]  # kind or scene, pair, method


class Kept:
    """Rows by kind, pair and method, as they stand in a file.

    Args:
        path: Made if it does not exist. A last line that a kill cut off is dropped.
        origin: What the answers belong to, as JSON holds it.

    Raises:
        FileError: If the file is broken, or its answers belong to something else.
        OSError: If it cannot be written.
    """

    def __init__(self, path: Path, origin: dict[str, Any]) -> None:
        self.path = path
        if not path.exists():
            path.write_text(json.dumps(origin) + "\n")
        text = path.read_text()
        whole = text[: text.rfind("\n") + 1]
        if whole != text:
            with replacing(path) as partial:
                partial.write_text(whole)
        head, *rows = or_file_error(
            path, "is broken", lambda: [*map(json.loads, whole.splitlines())] or [None]
        )
        if head != origin:
            raise FileError(
                f"{path}: answers other pairs, or is of other code: name another folder, or remove it."
            )
        self.rows: dict[Key, dict[str, Any]] = {(kind, pair, name): row for kind, pair, name, row in rows}

    def add(self, key: Key, row: dict[str, Any]) -> None:
        """Keep one more."""
        with self.path.open("a") as file:
            file.write(json.dumps([*key, row]) + "\n")
        self.rows[key] = row


def code() -> int:
    """A number that tells this state of the library and of these benchmarks from others."""
    folders = Path(teaser_jax.__file__).parent, Path(__file__).parent
    files = (path for folder in folders for path in sorted(folder.rglob("*.py")))
    return zlib.crc32(b"".join(path.read_bytes() for path in files))
