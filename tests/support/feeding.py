"""An application that publishes at a steady rate."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from zsched_lab.fleet.testbed import Testbed


@contextmanager
def fed(bed: Testbed, hz: float) -> Iterator[None]:
    """robot1's application publishes at this rate."""
    publisher, stop = bed.app("robot1").declare_publisher("robot1/in"), threading.Event()

    def feed() -> None:
        while not stop.wait(1.0 / hz):
            publisher.put("x")

    thread = threading.Thread(target=feed)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
