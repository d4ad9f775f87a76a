"""An application that receives, as a process of its own: what it gets stands in a file, a number a line."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from support.waiting import until


class Reader:
    """Runs ``code``, which prints a line once it has subscribed, and then the number of each sample."""

    def __init__(self, code: str, path: Path, *arguments: str) -> None:
        self._path = path
        with path.open("w") as out:
            self.process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=out)
        until(self._lines, "the reader has subscribed")

    def _lines(self) -> list[str]:
        return self._path.read_text().splitlines()

    @property
    def numbers(self) -> list[int]:
        return [int(line) for line in self._lines()[1:] if line.isdigit()]

    def end(self) -> None:
        self.process.kill()
        self.process.wait(60)
