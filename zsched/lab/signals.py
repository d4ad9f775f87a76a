"""What the lab's processes do with the signals that ask them to stop.

Knows: SIGINT, SIGTERM, SIGHUP. Does not know: what is to be stopped.
"""

from __future__ import annotations

import signal

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class StopFlag:
    """Set by the first stop signal; whoever holds it looks between two pieces of work."""

    def __init__(self) -> None:
        self.is_set = False

    def install(self) -> None:
        """Route the stop signals here (main thread only)."""
        for number in STOP_SIGNALS:
            signal.signal(number, self._stop)

    def _stop(self, number: int, frame: object) -> None:
        del number, frame
        self.is_set = True
