"""Keeps what a process takes of glibc's heap small: few heaps, and what a start has left over is given back.

Knows: glibc's ``mallopt`` and ``malloc_trim``; with another C library nothing happens. Does not know: whose process.
"""

from __future__ import annotations

import ctypes
import math
from typing import Final

M_ARENA_MAX: Final = -8
ARENAS: Final = 2
GIVE_BACK_S: Final = 10.0
"""How often a daemon gives back what has been freed: each time 0.4 to 2 MiB, for 0.2 to 0.5 ms (measured)."""


def share_heaps() -> None:
    """Let all threads share two heaps: with one per thread and their leftovers a relay took 5 MB more (measured).

    Call it before there are threads.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, ARENAS)


def give_back() -> None:
    """Give freed pages back to the kernel: imports and a session's opening leave more than a megabyte (decision 0049).

    Takes about a millisecond; call it once all is made.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)


class Leftovers:
    """What one process frees while it runs: its messages and answers leave holes in a heap that never shrinks."""

    def __init__(self) -> None:
        self._next = -math.inf

    def tend(self, now: float) -> None:
        """Give it back every `GIVE_BACK_S`; ``now``: monotonic seconds. For a thread that is awake anyway."""
        if now >= self._next:
            self._next = now + GIVE_BACK_S
            give_back()
