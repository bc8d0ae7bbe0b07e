"""A person before a long search: told how far it is, and free to end it."""

from __future__ import annotations

import signal
import threading
import time
from types import FrameType, TracebackType
from typing import Any

PATIENCE = 2.0  # seconds without a word


class Watch:
    """Shows a search on a terminal, and hands an interrupt on between two of its slices.

    An interrupt that arrives inside a compiled loop ends as ``SystemError``, or not at all. So it is only
    noted there, and whoever handled it before handles it at the next look. In threads other than the main
    one neither is done: signals do not come there, and bars of several would overwrite each other.
    """

    def __init__(self) -> None:
        self.start = time.perf_counter()
        self.in_main = threading.current_thread() is threading.main_thread()
        self.before: Any = None
        self.interrupted = False
        self.bar: Any = None
        self.shown = self.start + PATIENCE

    def __enter__(self) -> Watch:
        # None: whoever handles it was not set from Python, and could not be set again.
        if self.in_main and signal.getsignal(signal.SIGINT) is not None:
            self.before = signal.signal(signal.SIGINT, self._note)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.bar is not None:
            self.bar.close()
        self._hand_back()

    def look(self, size: int, upper: int) -> None:
        """Show how far the search is, and hand on an interrupt that was noted."""
        if self.interrupted:
            self._hand_back()
        now = time.perf_counter()
        if self.in_main and now >= self.shown:
            self.shown = now + 0.2
            self._show(
                f"{now - self.start:.0f} s: largest clique so far {size} matches, none has more than {upper}"
            )

    def _note(self, number: int, frame: FrameType | None) -> None:
        self.interrupted = True

    def _hand_back(self) -> None:
        """Give interrupts back to whoever handled them, and with them one that was noted."""
        if self.before is None:
            return
        signal.signal(signal.SIGINT, self.before)
        self.before = None
        if self.interrupted:
            self.interrupted = False
            signal.raise_signal(signal.SIGINT)

    def _show(self, text: str) -> None:
        if self.bar is None:
            from tqdm import tqdm

            # disable=None: on a terminal only.
            self.bar = tqdm(bar_format="{desc}", leave=False, disable=None)
        self.bar.set_description_str(text)
