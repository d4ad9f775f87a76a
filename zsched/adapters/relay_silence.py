"""Decides when a relay that says nothing is wedged, and not merely short of a processor.

Knows: threads' states and processor time from /proc. Does not know: what a relay says, how it is replaced.

Only time in which the daemon itself was there to listen counts: not a suspended machine's, nor a stopped daemon's. A
relay that wants a processor and gets none is never wedged, however long that takes: another one would have to begin
from the start, and make the machine busier still. One that gets its processor time and says nothing all the same is.
"""

from __future__ import annotations

import contextlib
import os
import time
from pathlib import Path
from typing import Final

WORK_S: Final = 10.0
"""Processor time in which any relay would have said something; starting one takes 0.2 to 2 s."""
LOOK_S: Final = 0.25
LOOKS, LOOK_APART_S = 5, 0.02
_TICK_S: Final = 1.0 / os.sysconf("SC_CLK_TCK")


class Silence:
    """How long one process has been silent for, while we listened."""

    def __init__(self, pid: int, patience_s: float) -> None:
        self.patience_s = patience_s
        self.silent_s = 0.0
        self._pid = pid
        self._began_at_s: float | None = None
        """Its processor time when the silence began."""

    @property
    def left_s(self) -> float:
        """How long to listen before the next verdict."""
        return max(LOOK_S, self.patience_s - self.silent_s)

    def end(self) -> None:
        """It has said something."""
        self.silent_s, self._began_at_s = 0.0, None

    def go_on(self, asked_s: float, took_s: float) -> str:
        """Nothing came while we listened for ``took_s`` and wanted to for ``asked_s``; why it is wedged, or ``""``.

        What it took longer, we did not run ourselves. Nor did the relay, maybe, and it needs a moment to say so: then
        the verdict waits for the next time.
        """
        has_stood_still = took_s > asked_s + LOOK_S
        self.silent_s += min(took_s, asked_s + LOOK_S)
        had_s = processor_s(self._pid)
        if self._began_at_s is None:
            self._began_at_s = had_s
        if self.silent_s < self.patience_s or has_stood_still:
            return ""
        if had_s is None or self._began_at_s is None or is_idle(self._pid):
            return f"no sign of life for {self.silent_s:.1f} s"
        if had_s - self._began_at_s < WORK_S:
            return ""
        return f"no sign of life for {self.silent_s:.1f} s, {had_s - self._began_at_s:.1f} s of them on a processor"


def processor_s(pid: int) -> float | None:
    """Processor time that a process has had so far, with all its threads; ``None`` when there is no such process."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) * _TICK_S
    except (OSError, IndexError, ValueError):
        return None


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
    states = set()
    with contextlib.suppress(OSError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with contextlib.suppress(OSError, IndexError):
                states.add((thread / "stat").read_text().rsplit(")", 1)[1].split()[0])
    return states
