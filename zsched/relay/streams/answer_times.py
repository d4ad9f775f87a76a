"""How long a task's answers take at this robot: from an input as it left to an output as it came.

Knows: timestamps, times. Does not know: workers, what follows.

An answer that has its input's timestamp (the library's do, and a foreign worker's that copies it) is measured exactly,
the network included. Any other one is at least as old as the newest input before it. What a worker says again under a
timestamp that a stream has had is no answer: a program that publishes at a rate of its own would seem later and later.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Final

from zenoh import Timestamp

from zsched.host.clock import monotonic_s

MAX_SENT: Final = 256
"""At most this many inputs wait for their answer; a slower worker is measured by the newest one."""


class AnswerTimes:
    """Of one task's streams. Any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: OrderedDict[Timestamp, tuple[float, set[str]]] = OrderedDict()
        """{timestamp of an input: (when it left, the streams that had its answer)}."""
        self._newest_at: float | None = None

    def sent(self, stamp: Timestamp | None) -> None:
        """An input leaves for the owner, maybe once more: for another one, or for a worker that has started again."""
        now = monotonic_s()
        with self._lock:
            self._newest_at = now
            if stamp is not None:
                self._sent.pop(stamp, None)  # a value that is sent again is a newest one
                self._sent[stamp] = now, set()
                if len(self._sent) > MAX_SENT:
                    self._sent.popitem(last=False)

    def answered(self, stamp: Timestamp | None, stream: str) -> tuple[float, bool] | None:
        """An output of ``stream`` has come: (seconds since its input, whether it had its timestamp).

        ``None``: without any input, or said again.
        """
        now = monotonic_s()
        with self._lock:
            sent, newest_at = None if stamp is None else self._sent.get(stamp), self._newest_at
            if sent is not None:
                sent_at, streams = sent
                if stream in streams:
                    return None
                streams.add(stream)
                return now - sent_at, True
        return None if newest_at is None else (now - newest_at, False)
