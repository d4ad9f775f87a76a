"""What is set once, and waited for: by the main thread, too, when it is a signal's handler that sets it.

Knows: what a handler may do, when Python runs it. Does not know: which signals, what ends.
"""

from __future__ import annotations

import queue
from typing import Final

from zsched.host.clock import monotonic_s

SLICE_S: Final = 0.25


class Latch:
    """Is set once, and stays so."""

    def __init__(self) -> None:
        self._is_set = False
        self._news: queue.SimpleQueue[None] = queue.SimpleQueue()
        """Holds something once it is set; of an event, the lock may be held by what a handler has interrupted."""

    def set(self) -> None:
        """Release all who wait. Any thread, and a signal's handler, whatever it has interrupted."""
        self._is_set = True
        self._news.put(None)

    def is_set(self) -> bool:
        """Whether it is."""
        return self._is_set

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for it, at most this long; whether it is set.

        In slices of `SLICE_S`: while one signal is pending in the main thread, the kernel gives the next one to another
        thread. Python only notes it there, for the main thread to run its handler: a wait without an end would not let
        it, and nobody would end that wait.
        """
        until_s = float("inf") if timeout_s is None else monotonic_s() + timeout_s
        while not self._is_set and (left_s := until_s - monotonic_s()) > 0:
            try:
                self._news.get(timeout=min(SLICE_S, left_s))
            except queue.Empty:
                continue
            self._news.put(None)  # for whoever else waits
        return self._is_set
