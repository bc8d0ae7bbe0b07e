"""A browser without a window, driven through the pipe of its developer tools by nothing but Python."""

from __future__ import annotations

import base64
import io
import json
import os
import select
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.image import imread

SECONDS = 60.0  # that one answer may take
NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
FLAGS = (
    "--headless=new", "--no-sandbox", "--remote-debugging-pipe", "--window-size=1000,700", "--no-first-run",
    "--hide-scrollbars", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip


def find_browser() -> str | None:
    """Where Chromium is: named by CHROMIUM, on the path, or where playwright keeps it."""
    named = [os.environ.get("CHROMIUM"), *(shutil.which(name) for name in NAMES)]
    kept = Path(os.environ.get("PLAYWRIGHT_BROWSERS_PATH", Path.home() / ".cache/ms-playwright"))
    named += sorted(map(str, kept.glob("chromium-*/chrome-linux*/chrome")))
    return next((name for name in named if name), None)


class Page:
    """A tab. ``told`` holds all that it reported: requests, errors, words on its console."""

    def __init__(self, to: int, back: int) -> None:
        self.to, self.back, self.count, self.rest, self.session = to, back, 0, b"", None
        self.told: list[dict] = []
        target = self.ask("Target.createTarget", url="about:blank")["targetId"]
        self.session = self.ask("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.ask(f"{domain}.enable")

    def ask(self, method: str, **parameters: Any) -> dict:
        self.count += 1
        message = {"id": self.count, "method": method, "params": parameters}
        if self.session is not None:
            message["sessionId"] = self.session
        os.write(self.to, json.dumps(message).encode() + b"\0")
        end = time.monotonic() + SECONDS
        while True:
            answer = self._next(end)
            if answer.get("id") == self.count:
                assert "error" not in answer, answer
                return answer["result"]
            self.told.append(answer)

    def _next(self, end: float) -> dict:
        while b"\0" not in self.rest:
            if not select.select([self.back], [], [], max(0.0, end - time.monotonic()))[0]:
                raise TimeoutError(f"the browser said nothing for {SECONDS} s")
            some = os.read(self.back, 1 << 20)
            assert some, "the browser ended"
            self.rest += some
        line, _, self.rest = self.rest.partition(b"\0")
        return json.loads(line)

    def run(self, script: str) -> Any:
        """What a script gives; a promise is waited for."""
        found = self.ask("Runtime.evaluate", expression=script, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def open(self, path: Path) -> None:
        """Open a file, and wait until a condition that every page of ours meets is met."""
        self.ask("Page.navigate", url=path.resolve().as_uri())
        end = time.monotonic() + SECONDS
        while not self.run("document.readyState === 'complete' && !!document.querySelector('#view canvas')"):
            assert time.monotonic() < end, "no picture appeared"
            time.sleep(0.1)
        self.rest_a_while()

    def rest_a_while(self) -> None:
        """Let what was asked for be drawn."""
        wait = "new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))"
        self.run(wait)
        time.sleep(0.3)
        self.run(wait)

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 5) -> None:
        """Drag the mouse, as a hand does."""
        path = np.linspace(start, end, steps + 1)
        kinds = ["mousePressed", *["mouseMoved"] * steps, "mouseReleased"]
        for kind, (x, y) in zip(kinds, [*path, path[-1]], strict=True):
            self.ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)
        self.rest_a_while()

    def photograph(self) -> np.ndarray:
        """The pixels, (height, width, 3), from 0 to 1."""
        data = self.ask("Page.captureScreenshot", format="png")["data"]
        return imread(io.BytesIO(base64.b64decode(data)), format="png")[..., :3]

    @property
    def errors(self) -> list[dict]:
        """What went wrong on the page, in its own words."""
        return [
            x for x in self.told
            if x.get("method") == "Runtime.exceptionThrown"
            or (x.get("method") == "Runtime.consoleAPICalled" and x["params"]["type"] == "error")
            or (x.get("method") == "Log.entryAdded" and x["params"]["entry"]["level"] == "error")
        ]  # fmt: skip

    @property
    def requests(self) -> list[str]:
        """All addresses that were asked for."""
        return [
            x["params"]["request"]["url"] for x in self.told if x.get("method") == "Network.requestWillBeSent"
        ]


@contextmanager
def page(browser: str, folder: Path) -> Iterator[Page]:
    """A tab of a browser of one's own, which ends with the block."""
    theirs, to = os.pipe()
    back, ours = os.pipe()
    # The browser reads from 3 and writes to 4: a process that becomes it puts the pipes there.
    become = (
        f"import os, sys; a, b = os.dup({theirs}), os.dup({ours}); "
        "os.dup2(a, 3), os.dup2(b, 4); os.set_inheritable(3, True), os.set_inheritable(4, True); "
        "os.execv(sys.argv[1], sys.argv[1:])"
    )
    process = subprocess.Popen(
        [sys.executable, "-ISc", become, browser, *FLAGS, f"--user-data-dir={folder}"],
        pass_fds=(theirs, ours), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(theirs), os.close(ours)
    try:
        tab = Page(to, back)
        yield tab
        tab.session = None
        tab.ask("Browser.close")
        process.wait(timeout=SECONDS)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait()
        os.close(to), os.close(back)
