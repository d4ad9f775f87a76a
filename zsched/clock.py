"""The one place that reads clocks: monotonic seconds for decisions, wall time for display only.

CLOCK_BOOTTIME goes on while a machine sleeps, so that a laptop that was shut for a minute does not think its lease,
its peers' beats or its samples are fresh. Who waits for a process of this machine asks `awake_s`: that one slept, too.
"""

from __future__ import annotations

import time
from datetime import UTC, datetime


def monotonic_s() -> float:
    """Seconds of CLOCK_BOOTTIME; comparable only on this machine and boot."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def awake_s() -> float:
    """Seconds of CLOCK_MONOTONIC, which stands still while the machine is suspended: for waits on this machine only."""
    return time.clock_gettime(time.CLOCK_MONOTONIC)


def wall_time() -> str:
    """Now as an RFC 3339 string in UTC with milliseconds, for logs and people; never for decisions."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def wall_ns() -> int:
    """Nanoseconds since the Unix epoch, for stamps that others read; never for decisions."""
    return time.time_ns()


def wall_tenths() -> int:
    """Tenths of a second of the wall clock: the start counter of a blank state, so that it is above an earlier life's.

    Finer than a daemon can start, so that no count of starts gets ahead of it.
    """
    return int(time.time() * 10)
