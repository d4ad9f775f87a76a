"""An application that publishes at a steady rate."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from zsched_lab.fleet.pace import at_pace
from zsched_lab.fleet.testbed import Testbed


@contextmanager
def fed(bed: Testbed, hz: float) -> Iterator[None]:
    """robot1's application publishes at this rate."""
    publisher = bed.app("robot1").declare_publisher("robot1/in")
    with at_pace(hz, lambda: publisher.put("x")):
        yield
