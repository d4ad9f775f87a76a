"""Counts what a worker's own callbacks raise, logs a little of it, and lets its node know.

Knows: how often a failure is worth a line or a message. Does not know: zenoh, keys, what a callback does.

A callback that raises on every sample raises a thousand times a second: the log has one traceback per kind of error in
`LOG_S`, and `status` the count and the newest error's first line.
"""

from __future__ import annotations

import contextlib
import logging
import sysconfig
import threading
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Final

from zsched.core.values.model import MAX_REASON
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded

TELL_S: Final = 1.0
"""Shortest time between two reports to the node."""
LOG_S: Final = 10.0
MAX_KINDS: Final = 32
"""At most this many kinds of errors are kept apart in the log."""
_ROOM: Final = 60
"""Of `MAX_REASON`, for the words before the error's own."""
MAX_NAME: Final = 60
"""Characters of a file's name."""
TRACEBACK: Final = "traceback in the worker's log"
_OF_PYTHON: Final = tuple(sysconfig.get_paths()[name] for name in ("stdlib", "purelib", "platlib"))
_LIBRARIES: Final = tuple(Path(folder) for folder in (str(Path(__file__).parents[1]), *_OF_PYTHON))

_log = logging.getLogger("zsched.worker")


class Troubles:
    """One worker's failures. `note` may be called from any thread; ``tell`` runs in a thread of its own."""

    def __init__(self, tell: Callable[[int, str], None]) -> None:
        """``tell`` takes (how many callbacks have failed so far, the newest error in one line)."""
        self._tell = tell
        self._lock = threading.Lock()
        self._count = 0
        self._newest: BaseException | None = None
        """The newest error that is not told yet: where it came from is looked up only then."""
        self._told_at = -TELL_S
        self._timer: threading.Thread | None = None
        self._log_at: dict[str, float] = {}
        self._closed = threading.Event()

    def note(self, where: str, error: BaseException) -> None:
        """A callback for ``where`` raised (to be called while the error is handled)."""
        now, kind = monotonic_s(), type(error).__name__
        with self._lock:
            self._count += 1
            count = self._count
            self._newest = error
            known = kind if kind in self._log_at or len(self._log_at) < MAX_KINDS else "another"
            is_worth_a_line = now >= self._log_at.get(known, now)
            if is_worth_a_line:
                self._log_at[known] = now + LOG_S
            if self._timer is None and not self._closed.is_set():
                delay_s = max(self._told_at + TELL_S - now, 0.0)
                timer = guarded(self._send_after, delay_s, name="zsched troubles", is_lasting=False)
                with contextlib.suppress(RuntimeError):  # no thread is to be had: the next failure tells of this one
                    timer.start()
                    self._timer = timer
        if is_worth_a_line:
            so_far = "" if count == 1 else f", {count} times in all; at most one line in {LOG_S:g} s"
            _log.exception("%s: the worker's callback failed%s", where, so_far)

    def close(self) -> None:
        """Tell nothing any more."""
        self._closed.set()

    def _send_after(self, delay_s: float) -> None:
        if self._closed.wait(delay_s):
            return
        with self._lock:
            self._timer, self._told_at = None, monotonic_s()
            count, newest, self._newest = self._count, self._newest, None
        text = "" if newest is None else _told(newest)
        with contextlib.suppress(Exception):  # the session closes: an asker without an answer sees the worker's end
            self._tell(count, text)


def _told(error: BaseException) -> str:
    """The first line of an error and where it came from, as short as it has to be to be carried."""
    kind = type(error).__name__
    line = (f"{kind}: {error}" if str(error) else kind).strip().partition("\n")[0]
    where = f" ({place}; {TRACEBACK})" if (place := _place(error)) else f" ({TRACEBACK})"
    return f"{line[: MAX_REASON - _ROOM - len(where)]}{where}"


def _place(error: BaseException) -> str:
    """``file:line`` of the innermost frame that is the author's: in no library, and not ours; empty when none is."""
    place = ""
    for frame, line in traceback.walk_tb(error.__traceback__):
        path = Path(frame.f_code.co_filename)
        if not any(path.is_relative_to(folder) for folder in _LIBRARIES):
            place = f"{path.name[-MAX_NAME:]}:{line}"
    return place
