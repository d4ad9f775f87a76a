"""Keeps what a process takes of glibc's heap small: few heaps, and what a start has left over is given back.

Knows: glibc's ``mallopt`` and ``malloc_trim``; with another C library nothing happens. Does not know: whose process.
"""

from __future__ import annotations

import ctypes
from typing import Final

M_ARENA_MAX: Final = -8
ARENAS: Final = 2


def share_heaps() -> None:
    """Let all threads share two heaps: with one per thread and their leftovers a relay took 5 MB more (measured).

    Call it before there are threads.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(M_ARENA_MAX, ARENAS)


def give_back() -> None:
    """Give freed pages back to the kernel: imports and a session's opening leave more than a megabyte (decision 0081).

    Takes about a millisecond; call it once all is made.
    """
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
