"""For all tests: signals are what they are at a terminal, however the tests were started.

A job in the background of a script has SIGINT and SIGQUIT ignored, one under nohup SIGHUP; Python and every process
that a test starts would inherit that, and tests of Ctrl-C would wait for ever.

A test that finds a measured time too long is run up to three times: a machine is busy once, a fault is slow each time.
Only tests of modules that measure times are marked for that: it costs a marked test 40 ms beside other processes.

The garbage collector does not look again at what the collection of tests has made, and looks more seldom at the rest:
that is 8 % of the CPU time of tests that play schedules.
"""

from __future__ import annotations

import gc
import signal

import pytest

MEASURES = ("TooSlowError", "between", "within")
"""Names of `support.waiting` that a module imports whose tests measure times."""


def pytest_configure() -> None:
    """In each process that runs tests, before any does."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGQUIT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Let pytest-rerunfailures run again what was too slow, and nothing else."""
    again = pytest.mark.flaky(reruns=2, only_rerun=["TooSlowError"])
    for item in items:
        module = item.getparent(pytest.Module)
        if module is not None and any(hasattr(module.obj, name) for name in MEASURES):
            item.add_marker(again)


def pytest_collection_finish() -> None:
    """All modules of tests are imported."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)
