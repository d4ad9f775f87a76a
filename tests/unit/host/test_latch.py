"""What a signal's handler sets while the main thread waits for it."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from support.signals import signal_another_thread, signal_at_once
from support.waiting import DEADLINE_S, within
from zsched.host.clock import monotonic_s
from zsched.host.latch import SLICE_S, Latch

ROUNDS = 8
WAITS = """
import os, signal, sys, threading, time
from zsched.host.latch import Latch

latch = Latch()
for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTERM):
    signal.signal(number, lambda *_: latch.set())
for _ in range(2):
    threading.Thread(target=threading.Event().wait, daemon=True).start()
for _ in range(int(sys.argv[1])):
    latch = Latch()
    print("waits", flush=True)
    assert latch.wait()
    time.sleep(0.05)  # the other signal's handler sets this latch, too, and not the next one
    print("is released", flush=True)
os._exit(0)  # a signal may be on its way, and Python gives up its handlers first
"""
STORM = """
import signal, time
from zsched.host.latch import Latch

latch = Latch()
signal.signal(signal.SIGALRM, lambda *_: latch.set())
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
until_s = time.monotonic() + 1.0
while time.monotonic() < until_s:
    latch = Latch()
    latch.set()
    assert latch.wait(1e-3)
    latch = Latch()
    assert latch.wait()
signal.setitimer(signal.ITIMER_REAL, 0.0)
"""


@pytest.fixture
def waiter() -> Iterator[subprocess.Popen[str]]:
    """A process whose main thread waits, `ROUNDS` times."""
    command = [sys.executable, "-c", WAITS, str(ROUNDS)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        watchdog = threading.Timer(DEADLINE_S / 2, process.kill)  # ends the test's reading, too
        watchdog.start()
        try:
            yield process
        finally:
            watchdog.cancel()
            process.kill()


def told(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline()


@pytest.mark.parametrize("pair", [(signal.SIGHUP, signal.SIGTERM), (signal.SIGINT, signal.SIGTERM)])
def test_two_signals_close_together_release_the_main_thread(
    waiter: subprocess.Popen[str], pair: tuple[signal.Signals, ...]
) -> None:
    for _ in range(ROUNDS):
        assert told(waiter) == "waits\n"
        signal_at_once(waiter, *pair)
        assert told(waiter) == "is released\n"
    assert waiter.wait(DEADLINE_S) == 0


def test_a_signal_that_another_thread_has_releases_the_main_thread(waiter: subprocess.Popen[str]) -> None:
    assert told(waiter) == "waits\n"
    signal_another_thread(waiter, signal.SIGTERM)
    assert told(waiter) == "is released\n"


def test_a_handler_may_set_it_whatever_it_interrupts() -> None:
    """An event's lock would be held by the call that the handler has interrupted."""
    done = subprocess.run([sys.executable, "-c", STORM], timeout=DEADLINE_S, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


def test_all_who_wait_are_released() -> None:
    latch, released = Latch(), list[bool]()
    waiting = [threading.Thread(target=lambda: released.append(latch.wait(DEADLINE_S))) for _ in range(5)]
    for thread in waiting:
        thread.start()
    latch.set()
    for thread in waiting:
        thread.join(DEADLINE_S)
    assert released == [True] * 5
    assert latch.is_set()
    assert latch.wait()


@pytest.mark.parametrize("timeout_s", [0.0, 0.05, 2.4 * SLICE_S])
def test_a_wait_ends_at_its_time(timeout_s: float) -> None:
    latch, began_s = Latch(), monotonic_s()
    assert not latch.wait(timeout_s)
    took_s = monotonic_s() - began_s
    assert took_s >= timeout_s
    within(took_s, timeout_s + 0.2)
    assert not latch.is_set()
    assert not latch.wait(-1.0)
