"""`zsched.host.heap`: what is freed goes back to the kernel."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from zsched.host import heap
from zsched.host.heap import GIVE_BACK_S, Leftovers, give_back
from zsched.host.procfs import PAGE_MB


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


def test_what_a_running_process_frees_is_given_back_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    now, times = 0.0, list[float]()
    monkeypatch.setattr(heap, "give_back", lambda: times.append(now))
    leftovers = Leftovers()
    for now in (100.0, 101.0, 99.0 + GIVE_BACK_S, 100.0 + GIVE_BACK_S, 101.0 + GIVE_BACK_S, 200.0):
        leftovers.tend(now)
    assert times == [100.0, 100.0 + GIVE_BACK_S, 200.0]
