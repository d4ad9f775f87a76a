"""The one place that reads clocks: monotonic seconds for decisions, wall time for display only.

Decisions go by CLOCK_MONOTONIC_RAW, which no time service slews (chrony does by up to 8.3 %, and a lease may err by
0.1 %), plus the time that the machine has slept, so that a laptop that was shut for a minute does not think its lease,
its peers' beats or its samples are fresh. `ClockWatch` holds it against CLOCK_BOOTTIME, which is slewed.
`SleepWatch` tells of a sleep before anything is judged by the time after it: some machines know its length to a second.
A wait for a process of this machine goes by `awake_s`: that process slept, too.
"""

from __future__ import annotations

import time
from collections import deque
from datetime import UTC, datetime
from typing import NamedTuple

READ_S = 20e-6
"""Two clocks that are read within this time are read at the same time."""
READ_TRIES = 20
NAP_S = 1e-3
"""A shorter sleep is none: it is how long this process was put aside between two readings."""
WINDOW_S = 1.0
LEAST_WINDOW_S = 0.15
"""In a shorter time the clocks' rates cannot be told apart from the readings' own time."""
JUMP_RATIO = 0.2
"""Clocks that move apart faster have jumped: Linux slews by at most a tenth."""


def _apart(one: int, other: int) -> float:
    """How far ``other`` is ahead of ``one``, read as nearly at the same time as this process can."""
    best, apart = float("inf"), 0.0
    for _ in range(READ_TRIES):
        before = time.clock_gettime(one)
        reading = time.clock_gettime(other)
        after = time.clock_gettime(one)
        if after - before < best:
            best, apart = after - before, reading - (before + after) / 2
        if best <= READ_S:
            break
    return apart


class _Slept:
    """How long the machine has slept since its boot."""

    seconds = _apart(time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME)


def monotonic_s() -> float:
    """Seconds since about the boot, sleep included, at the crystal's own rate; comparable only on this machine."""
    slept = time.clock_gettime(time.CLOCK_BOOTTIME) - time.clock_gettime(time.CLOCK_MONOTONIC)
    if abs(slept - _Slept.seconds) > NAP_S:
        slept = _apart(time.CLOCK_MONOTONIC, time.CLOCK_BOOTTIME)
        if slept - _Slept.seconds > NAP_S:
            _Slept.seconds = slept
    return time.clock_gettime(time.CLOCK_MONOTONIC_RAW) + _Slept.seconds


class SleepWatch:
    """Tells of each sleep of the machine once, as soon as `monotonic_s` counts it."""

    def __init__(self) -> None:
        self._told_s = _Slept.seconds

    def look(self) -> float:
        """How long the machine has slept since the look before, seconds, by what `monotonic_s` counts; mostly zero."""
        before, self._told_s = self._told_s, _Slept.seconds
        return self._told_s - before


class Drift(NamedTuple):
    """How CLOCK_BOOTTIME ran against CLOCK_MONOTONIC_RAW."""

    error_ratio: float
    """Over the last `WINDOW_S` or less: 0.083 is 8.3 % faster; what was before a jump is left out, and the jump."""
    jump_s: float
    """How far it got ahead since the reading before."""
    since_s: float
    """How long ago that was."""


class ClockWatch:
    """Compares the machine's clocks every time it is asked."""

    def __init__(self) -> None:
        self._readings: deque[tuple[float, float]] = deque()

    def look(self) -> Drift | None:
        """Read both; ``None`` when the first reading is too young to tell anything."""
        ahead_s = _apart(time.CLOCK_MONOTONIC_RAW, time.CLOCK_BOOTTIME)
        return self.judge(time.clock_gettime(time.CLOCK_MONOTONIC_RAW), ahead_s)

    def judge(self, raw_s: float, ahead_s: float) -> Drift | None:
        """Take one reading in: ``ahead_s`` is how far the slewed clock is ahead at ``raw_s``."""
        last_raw_s, last_ahead_s = self._readings[-1] if self._readings else (raw_s, ahead_s)
        if abs(ahead_s - last_ahead_s) > JUMP_RATIO * max(raw_s - last_raw_s, LEAST_WINDOW_S):
            self._readings = deque([(raw_s, ahead_s)])
            return Drift(0.0, ahead_s - last_ahead_s, raw_s - last_raw_s)
        self._readings.append((raw_s, ahead_s))
        while len(self._readings) > 2 and raw_s - self._readings[1][0] >= WINDOW_S:
            self._readings.popleft()
        first_raw_s, first_ahead_s = self._readings[0]
        if raw_s - first_raw_s < LEAST_WINDOW_S:
            return None
        return Drift((ahead_s - first_ahead_s) / (raw_s - first_raw_s), ahead_s - last_ahead_s, raw_s - last_raw_s)


def awake_s() -> float:
    """Seconds of CLOCK_MONOTONIC, which stands still while the machine is suspended: for waits on this machine only."""
    return time.clock_gettime(time.CLOCK_MONOTONIC)


def boot_s() -> float:
    """Seconds of CLOCK_BOOTTIME, by which the kernel tells when a process began; `monotonic_s` parts from it."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def wall_time() -> str:
    """Now as an RFC 3339 string in UTC with milliseconds, for logs and people; never for decisions."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def wall_ns() -> int:
    """Nanoseconds since the Unix epoch, for stamps that others read; never for decisions."""
    return time.time_ns()


def wall_s() -> float:
    """Seconds since the Unix epoch, for people; never for decisions."""
    return time.time()


def wall_tenths() -> int:
    """Tenths of a second of the wall clock: the start counter of a blank state, so that it is above an earlier life's.

    Finer than a daemon can start, so that no count of starts gets ahead of it.
    """
    return int(time.time() * 10)
