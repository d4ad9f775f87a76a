"""Waits for conditions. Knows: deadlines. Does not know: what is waited for.

A deadline costs nothing when the condition comes true, so it is generous: the machine may be busy with other things.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from zsched_lab.fleet.loopback import free_endpoint

__all__ = ["DEADLINE_S", "POLL_S", "TooSlowError", "between", "free_endpoint", "until", "within"]

DEADLINE_S = 60.0
POLL_S = 0.003


def until(condition: Callable[[], Any], what: str, deadline_s: float = DEADLINE_S) -> Any:
    """The condition's first true value; `AssertionError` with ``what`` when there is none in time."""
    end = time.monotonic() + deadline_s
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > end:
            raise AssertionError(f"not within {deadline_s:g} s: {what}")
        time.sleep(POLL_S)


class TooSlowError(AssertionError):
    """What was measured took longer than it may: the test is run again, three times in all (``tests/conftest.py``).

    A machine is busy once, a fault is slow each time.
    """


def between(low: float, value: float, high: float) -> None:
    """A measured rate is in its range, in one of three runs of the test."""
    if not low < value < high:
        raise TooSlowError(f"{value:g}, not between {low:g} and {high:g}")


def within(took_s: float, bound_s: float, what: str = "") -> None:
    """A measured time is within its bound, in one of three runs of the test."""
    if took_s > bound_s:
        raise TooSlowError(f"{took_s:.2f} s, more than {bound_s:g} s {what}".rstrip())
