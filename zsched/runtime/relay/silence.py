"""Decides when a relay that says nothing is wedged, and not merely short of a processor.

Knows: what /proc says of a process: its threads' states, the processor time it had, how long it waited for one. Does
not know: what a relay says, how it is replaced.

Only time in which the daemon itself was there to listen counts: not a suspended machine's, nor a stopped daemon's. Of
that, only the time in which the relay slept counts against it. A relay that wants a processor and gets none is never
wedged, however long that takes: another one would have to begin from the start, and make the machine busier still. One
that works for `WORK_S` and says nothing all the same is.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Final

from zsched.core.values.struct import Struct
from zsched.host.procfs import names, parse_process_stat, parse_schedstat, read_file

WORK_S: Final = 10.0
"""Processor time in which any relay would have said something; starting one takes 0.2 to 2 s."""
LOOK_S: Final = 0.25
LOOKS, LOOK_APART_S = 5, 0.02


class Silence:
    """How long one process has been silent for, while we listened."""

    def __init__(self, pid: int, limit_s: float) -> None:
        self.limit_s = limit_s
        self.silent_s = 0.0
        self._pid = pid
        self._awake_s = 0.0
        """How much of the silence it ran or waited for a processor; at most all of it, however many its threads are."""
        self._seen: _Use | None = use_of(pid)
        self._work_s = 0.0

    @property
    def left_s(self) -> float:
        """How long to listen before the next call of `go_on`.

        A relay that speaks in time is not looked at, which would cost more than its words. So the first half of a
        silence is not measured, but for a new relay's.
        """
        limit_s = self.limit_s / 2 if self._seen is None else self.limit_s
        return max(LOOK_S, limit_s - (self.silent_s - self._awake_s))

    def end(self) -> None:
        """It has said something."""
        self.silent_s = self._awake_s = self._work_s = 0.0
        self._seen = None

    def go_on(self, asked_s: float, took_s: float) -> str:
        """Nothing came while we listened for ``took_s`` and wanted to for ``asked_s``; why it is wedged, or ``""``.

        What it took longer, we did not run ourselves. Nor did the relay, maybe, and it needs a moment to say so: then
        the verdict waits for the next time.
        """
        has_stood_still = took_s > asked_s + LOOK_S
        self.silent_s += min(took_s, asked_s + LOOK_S)
        use, seen = use_of(self._pid), self._seen
        self._seen = use
        if use is not None and seen is not None:
            worked_s = use.processor_s - seen.processor_s
            self._work_s += worked_s
            self._awake_s = min(self.silent_s, self._awake_s + worked_s + max(0.0, use.waited_s - seen.waited_s))
        if has_stood_still or self.silent_s < self.limit_s:
            return ""
        verdict = f"no sign of life for {self.silent_s:.1f} s"
        if use is None:
            return verdict
        if self._work_s >= WORK_S:
            return f"{verdict}, {self._work_s:.1f} s of them on a processor"
        has_slept = self.silent_s - self._awake_s >= self.limit_s
        return verdict if has_slept and is_idle(self._pid) else ""


class _Use(Struct, frozen=True):
    """What all threads of a process have had and lacked so far."""

    processor_s: float
    waited_s: float
    """In a run queue, also while its cgroup is throttled. A wait counts when it ends; 0 where the kernel tells none."""


def use_of(pid: int) -> _Use | None:
    """What a process has had of the processor so far; ``None`` when there is no such process."""
    had_s = processor_s(pid)
    return None if had_s is None else _Use(had_s, waited_s(pid))


def waited_s(pid: int) -> float:
    """How long the threads that a process has now have waited for a processor."""
    found = (parse_schedstat(content) for content in _of_threads(pid, "schedstat"))
    return sum(times[1] for times in found if times is not None)


def processor_s(pid: int) -> float | None:
    """Processor time that a process has had so far, with all its threads; ``None`` when there is no such process."""
    times = parse_process_stat(read_file(f"/proc/{pid}/stat"))
    return None if times is None else times.own_s


def is_idle(pid: int) -> bool:
    """True when no thread of the process runs or wants to: its silence is not for want of a processor.

    A stopped process is idle, too. Looks several times within 0.1 s, so that a thread that wakes up now and then counts
    as idle; a process that is gone is not.
    """
    idle = 0
    for _ in range(LOOKS):
        states = _thread_states(pid)
        if not states:
            return False
        idle += not states & {"R", "D"}
        time.sleep(LOOK_APART_S)
    return idle > LOOKS // 2


def _thread_states(pid: int) -> set[str]:
    found = (parse_process_stat(content) for content in _of_threads(pid, "stat"))
    return {times.state for times in found if times is not None}


def _of_threads(pid: int, file: str) -> Iterator[bytes]:
    """What /proc says under that name of each thread there is; nothing of one that ends meanwhile."""
    folder = f"/proc/{pid}/task"
    return (read_file(f"{folder}/{thread}/{file}") for thread in names(folder))
