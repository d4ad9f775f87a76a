"""A real browser for tests of pages: headless Chromium, driven by the DevTools protocol over two pipes.

Knows: the process, commands and their answers, what the console said. Does not know: what is shown.
"""

from __future__ import annotations

import base64
import contextlib
import json
import os
import select
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from support.waiting import DEADLINE_S, until

NAMES = ("chromium-headless-shell", "chromium", "chromium-browser", "google-chrome")
PATH = next((path for name in NAMES if (path := shutil.which(name))), None)
WHY_NOT = "no Chromium here (Debian: chromium-headless-shell)"


class Browser:
    """One page of one browser."""

    def __init__(self, reading: int, writing: int) -> None:
        self._reading, self._writing = reading, writing
        self._kept, self._number, self._session = b"", 0, ""
        self.said: list[str] = []
        """What the console, the log (violations of the policy) and uncaught exceptions told."""
        target = self._call("Target.createTarget", url="about:blank")["targetId"]
        self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Runtime", "Log", "Page"):
            self._call(f"{domain}.enable")

    def open(self, address: str, width: int, height: int) -> None:
        """Show a page in a window of so many pixels."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        self.value("window.wasBefore = true")
        self._call("Page.navigate", url=address)
        self.wait_for("!window.wasBefore && document.readyState === 'complete'")

    def value(self, script: str) -> Any:
        """The value of an expression in the page; promises are waited for."""
        found = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        assert "exceptionDetails" not in found, found
        return found["result"].get("value")

    def wait_for(self, script: str) -> Any:
        """The first true value of an expression in the page."""
        return until(lambda: self.value(script), script)

    def picture(self, file: Path) -> None:
        """Write what the window shows as PNG."""
        file.write_bytes(base64.b64decode(self._call("Page.captureScreenshot", format="png")["data"]))

    def _call(self, method: str, **params: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": params}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._writing, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                assert "error" not in answer, (method, answer)
                result: dict[str, Any] = answer["result"]
                return result
            if answer.get("method") in ("Runtime.consoleAPICalled", "Runtime.exceptionThrown", "Log.entryAdded"):
                self.said.append(json.dumps(answer["params"]))

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._kept:
            assert select.select([self._reading], [], [], DEADLINE_S)[0], "the browser says nothing"
            more = os.read(self._reading, 1 << 20)
            assert more, "the browser has ended"
            self._kept += more
        line, _, self._kept = self._kept.partition(b"\0")
        answer: dict[str, Any] = json.loads(line)
        return answer


@contextlib.contextmanager
def browsing(folder: Path) -> Iterator[Browser]:
    """A browser while the block runs; its profile lies in ``folder``."""
    assert PATH is not None
    to_read, write = os.pipe()
    read, to_write = os.pipe()
    # the protocol's pipes are descriptors 3 and 4: a shell puts them there
    script = f'exec 3<&{to_read} 4>&{to_write}; exec "$@"'
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--remote-debugging-pipe", "--hide-scrollbars"]
    command = ["bash", "-c", script, "bash", PATH, *options, f"--user-data-dir={folder / 'browser'}", "about:blank"]
    with subprocess.Popen(
        command, pass_fds=(to_read, to_write), env={**os.environ, "HOME": str(folder)}, stderr=subprocess.DEVNULL
    ) as process:
        os.close(to_read)
        os.close(to_write)
        try:
            yield Browser(read, write)
        finally:
            os.close(write)
            os.close(read)
            process.kill()
