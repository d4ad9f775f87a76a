"""Verbs that go on until they are stopped: what the signals do meanwhile, and behind it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

from zsched.commands.base.common import stopped_by_signal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_sets_a_latch_and_does_what_it_did_again(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stopped_by_signal() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), number)
        assert stop.wait(30.0)
    assert signal.getsignal(number) is before


STORM = """
import signal, time
from zsched.commands.base.common import stopped_by_signal
until_s = time.monotonic() + 2.0
while time.monotonic() < until_s:
    with stopped_by_signal() as stop:
        signal.signal(signal.SIGALRM, signal.getsignal(signal.SIGTERM))
        signal.setitimer(signal.ITIMER_REAL, 5e-5, 5e-5)
        for _ in range(100):
            stop.wait(0.0)
        assert stop.wait(9.0)
        signal.setitimer(signal.ITIMER_REAL, 0.0)
"""


def test_a_signal_that_comes_in_the_middle_of_another_one_s_handler_hangs_nothing() -> None:
    """The handler took a lock that the wait, or the handler, which it had interrupted, held."""
    done = subprocess.run([sys.executable, "-c", STORM], timeout=60, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr


def test_what_is_ignored_stays_ignored() -> None:
    """As `nohup` and a shell's `&` have it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)
