"""Runs what must be done neither in zenoh's threads nor in the dispatch thread, one after another.

Knows: order, failure. Does not know: what an errand does.
"""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable

from zsched.host.guard import guarded

_log = logging.getLogger("zsched.worker")

Errand = Callable[[], None]


class Errands:
    """A queue and a thread; `put` may be called from any thread."""

    def __init__(self, stop: threading.Event, name: str = "zsched errands", limit: int | None = None) -> None:
        """Start; failures are of no interest once ``stop`` is set. Where ``limit`` wait already, no more are taken."""
        self._stop, self._limit = stop, limit
        self._queue: queue.SimpleQueue[Errand | None] = queue.SimpleQueue()
        guarded(self._run, name=name).start()

    def put(self, errand: Errand) -> None:
        """Run this behind everything that waits."""
        if self._limit is None or self._queue.qsize() < self._limit:
            self._queue.put(errand)

    def close(self) -> None:
        """End the thread behind what waits."""
        self._queue.put(None)

    def _run(self) -> None:
        while (errand := self._queue.get()) is not None:
            try:
                errand()
            except Exception:  # noqa: BLE001 - an errand that fails (session closing) must not end the others
                if not self._stop.is_set():
                    _log.exception("an errand failed")
