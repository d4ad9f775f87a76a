"""Waits for conditions. Knows: deadlines. Does not know: what is waited for.

A deadline costs nothing when the condition comes true, so it is generous: the machine may be busy with other things.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from zsched.lab.loopback import free_endpoint

__all__ = ["DEADLINE_S", "POLL_S", "free_endpoint", "until"]

DEADLINE_S = 20.0
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
