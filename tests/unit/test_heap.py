"""`zsched.heap`: what is freed goes back to the kernel."""

from __future__ import annotations

import os
from pathlib import Path

from zsched.heap import give_back, share_heaps
from zsched.procfs import PAGE_MB


def rss_mb() -> float:
    return int(Path(f"/proc/{os.getpid()}/statm").read_text().split()[1]) * PAGE_MB


def test_freed_memory_beneath_what_stays_is_given_back() -> None:
    pieces = [bytearray(b"x" * 50_000) for _ in range(1000)]  # glibc maps larger ones one by one, and unmaps them
    stays = bytearray(b"x" * 50_000)
    pieces.clear()
    before = rss_mb()
    give_back()
    assert before - rss_mb() > 25.0
    assert stays


def test_heaps_may_be_shared_again_and_again() -> None:
    share_heaps()
    share_heaps()
