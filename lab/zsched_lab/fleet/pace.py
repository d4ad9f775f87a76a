"""Something done at a steady rate beside a fleet."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from zsched.host.guard import guarded


@contextmanager
def at_pace(hz: float, act: Callable[[], object]) -> Iterator[None]:
    """Do something so often, in a thread of its own."""
    stop = threading.Event()

    def run() -> None:
        due = time.monotonic()
        while not stop.wait(max(0.0, due - time.monotonic())):
            due = max(due + 1 / hz, time.monotonic() - 1.0)
            act()

    thread = guarded(run, name="pace", is_lasting=False)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
