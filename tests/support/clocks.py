"""The machine's clocks as a test sets them: they stand still until it moves them on, or lets the machine sleep."""

from __future__ import annotations

import time

import pytest

from zsched.host import clock


class Clocks:
    """In place of the kernel's, for `zsched.host.clock`; a wait goes by the real ones."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.awake, self.slept = 1000.0, 0.0
        monkeypatch.setattr(time, "clock_gettime", self._read)
        monkeypatch.setattr(clock._Slept, "seconds", 0.0)

    def _read(self, which: int) -> float:
        return self.awake + (self.slept if which == time.CLOCK_BOOTTIME else 0.0)
