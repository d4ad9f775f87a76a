"""The one queue into the loop: all threads post events, the loop takes them one by one.

Knows: its bound, what may wait until the loop is awake anyway. Does not know: what an event means.
"""

from __future__ import annotations

import queue
from collections import deque
from collections.abc import Iterator

from zsched.core.values import events as ev

INBOX_LIMIT = 20_000
WAITING_LIMIT = 64


class Inbox:
    """The one queue into the loop; bounded, and what does not fit is counted."""

    def __init__(self) -> None:
        self._queue: queue.SimpleQueue[ev.Event] = queue.SimpleQueue()
        self._first: ev.Event | None = None
        self._waiting: deque[ev.Event] = deque(maxlen=WAITING_LIMIT)
        self.overflowed = 0

    def post(self, event: ev.Event) -> None:
        """Enqueue; from any thread, never blocks."""
        if self._queue.qsize() >= INBOX_LIMIT and not isinstance(event, ev.StopRequested):
            self.overflowed += 1
            return
        self._queue.put(event)

    def post_quietly(self, event: ev.Event) -> None:
        """Enqueue without waking the loop: it is taken by `waiting` when the loop is awake anyway; the oldest go."""
        self._waiting.append(event)

    def waiting(self) -> Iterator[ev.Event]:
        """What has been posted quietly, in order."""
        while self._waiting:
            yield self._waiting.popleft()

    def put_first(self, event: ev.Event) -> None:
        """Let ``event`` be the next one taken; from the loop only."""
        self._first = event

    def take_first(self) -> ev.Event | None:
        """What must be taken before anything else, if there is something."""
        event, self._first = self._first, None
        return event

    def take(self, timeout_s: float) -> ev.Event | None:
        """The next event, waiting at most ``timeout_s`` (<= 0: not at all); ``None`` when there is none."""
        event = self.take_first()
        if event is not None:
            return event
        try:
            return self._queue.get(timeout=timeout_s) if timeout_s > 0 else self._queue.get_nowait()
        except queue.Empty:
            return None
