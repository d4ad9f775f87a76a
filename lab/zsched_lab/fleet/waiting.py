"""Waits for conditions. Knows: deadlines. Does not know: what is waited for.

A deadline costs nothing when the condition comes true, so it is generous: the machine may be busy with other things.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

DEADLINE_S = 60.0
POLL_S = 0.002


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
