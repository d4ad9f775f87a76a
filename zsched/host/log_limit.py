"""No log line repeats without limit: a burst passes, then a few a second, with a count of what was left out.

And no text in a line can look like a line of its own, nor tell a terminal what to do: an operator's reason, a worker's
output and a peer's words are logged on every node.

Knows: where in the source a line comes from. Does not know: what it says.
"""

from __future__ import annotations

import logging
import threading
from typing import Final

from zsched.host.clock import monotonic_s
from zsched.host.screen import harmless

BURST: Final = 100.0
RATE_HZ: Final = 5.0
MAX_PLACES: Final = 1024
PASSED: Final = {"zsched_limited": True}
"""``extra`` of lines that have a limit of their own: a worker's output comes from one place in our source."""


class LogLimit(logging.Filter):
    """A filter for handlers and loggers: per place in the source `BURST` lines at once, then `RATE_HZ`."""

    def __init__(self, burst: float = BURST, rate_hz: float = RATE_HZ) -> None:
        super().__init__()
        self._burst, self._rate_hz = burst, rate_hz
        self._lock = threading.Lock()
        self._places: dict[tuple[str, str, int], tuple[float, float, int]] = {}
        """{(logger, file, line): (tokens, when, lines left out)}."""

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the line may pass; one that passes behind others that did not says how many those were."""
        if hasattr(record, "zsched_limited"):
            return True  # a logger's filter has let it pass, this is its handler's
        place, now = (record.name, record.pathname, record.lineno), monotonic_s()
        with self._lock:
            tokens, at, left_out = self._places.pop(place, (self._burst, now, 0))
            tokens = min(tokens + (now - at) * self._rate_hz, self._burst)
            passes = tokens >= 1.0
            self._places[place] = (tokens - 1.0, now, 0) if passes else (tokens, now, left_out + 1)
            if len(self._places) > MAX_PLACES:
                del self._places[next(iter(self._places))]
        if passes:
            record.zsched_limited = True
            if left_out:
                record.msg = f"{record.getMessage()} [{left_out} more from here were left out]"
                record.args = None
        return passes


LIMIT: Final = LogLimit()
LIBRARY: Final = ("zsched.guard", "zsched.introduction", "zsched.relay", "zsched.streams", "zsched.worker")
"""The loggers of the worker library, whose handlers are the program's own."""


class PlainLines(logging.Formatter):
    """A formatter whose records begin in the first column, and only they."""

    def format(self, record: logging.LogRecord) -> str:
        """The record; what follows a line end is indented, and control characters are replaced by ``?``."""
        return harmless(super().format(record)).replace("\n", "\n  ")


def log_to_stderr(level: str, form: str) -> None:
    """Let this process (a daemon, a relay) log to stderr by ``form``, in plain lines and with the limit."""
    handler = logging.StreamHandler()
    handler.setFormatter(PlainLines(form))
    handler.addFilter(LIMIT)
    logging.basicConfig(level=level, handlers=[handler])


def limit_library() -> None:
    """Limit what the worker library logs, wherever the worker's program sends it."""
    for name in LIBRARY:
        logging.getLogger(name).addFilter(LIMIT)
