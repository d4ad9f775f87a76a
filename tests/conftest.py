"""For all tests: signals are what they are at a terminal, however the tests were started.

A job in the background of a script has SIGINT and SIGQUIT ignored, one under nohup SIGHUP; Python and every process
that a test starts would inherit that, and tests of Ctrl-C would wait for ever.
"""

from __future__ import annotations

import signal


def pytest_configure() -> None:
    """In each process that runs tests, before any does."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGQUIT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
