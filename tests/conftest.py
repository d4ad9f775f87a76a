"""For all tests: signals are what they are at a terminal, and who measured a time that was too long measures again.

A job in the background of a script has SIGINT and SIGQUIT ignored, one under nohup SIGHUP; Python and every process
that a test starts would inherit that, and tests of Ctrl-C would wait for ever.

A test that ends with `TooSlowError` is run from its beginning, three times in all: a fault takes too long every time,
a machine that is busy with other things does not. No other failure is ever repeated.
"""

from __future__ import annotations

import signal
from collections.abc import Generator
from typing import Any

import pytest
from _pytest.runner import runtestprotocol

from support.waiting import TooSlowError

TRIES = 3
SLOW = pytest.StashKey[bool]()
_again: list[str] = []


def pytest_configure() -> None:
    """In each process that runs tests, before any does."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGQUIT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Note whose failure is one of time."""
    if call.when == "call":
        item.stash[SLOW] = call.excinfo is not None and call.excinfo.errisinstance(TooSlowError)
    return (yield)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_protocol(item: Any, nextitem: pytest.Item | None) -> bool:
    """Run a test, and again while it is only too slow."""
    item.ihook.pytest_runtest_logstart(nodeid=item.nodeid, location=item.location)
    for attempt in range(1, TRIES + 1):
        item.stash[SLOW] = False
        reports = runtestprotocol(item, nextitem=nextitem, log=False)
        if not item.stash[SLOW] or attempt == TRIES or any(one.failed for one in reports if one.when != "call"):
            break
        _again.append(item.nodeid)
        item._initrequest()
    for report in reports:
        item.ihook.pytest_runtest_logreport(report=report)
    item.ihook.pytest_runtest_logfinish(nodeid=item.nodeid, location=item.location)
    return True


def pytest_terminal_summary(terminalreporter: Any) -> None:
    """Say which times had to be measured again."""
    for name in _again:
        terminalreporter.write_line(f"measured again, too slow at first: {name}")
