"""Waits for conditions, and bounds of measured times. Knows: deadlines. Does not know: what is waited for."""

from __future__ import annotations

from zsched_lab.fleet.loopback import free_endpoint
from zsched_lab.fleet.waiting import DEADLINE_S, POLL_S, until

__all__ = ["DEADLINE_S", "POLL_S", "TooSlowError", "between", "free_endpoint", "until", "within"]


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
