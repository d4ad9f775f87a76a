"""Verbs that go on until they are stopped: what the signals do meanwhile, and behind it."""

from __future__ import annotations

import os
import signal

import pytest

from zsched.commands.common import stopped_by_signal


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_is_an_event_and_does_what_it_did_again(number: signal.Signals) -> None:
    before = signal.getsignal(number)
    with stopped_by_signal() as stop:
        assert not stop.is_set()
        os.kill(os.getpid(), number)
        assert stop.wait(30.0)
    assert signal.getsignal(number) is before


def test_what_is_ignored_stays_ignored() -> None:
    """As `nohup` and a shell's `&` have it."""
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with stopped_by_signal() as stop:
            os.kill(os.getpid(), signal.SIGHUP)
            assert not stop.is_set()
    finally:
        signal.signal(signal.SIGHUP, before)
