"""For all tests: signals are what they are at a terminal, however the tests were started.

A job in the background of a script has SIGINT and SIGQUIT ignored, one under nohup SIGHUP; Python and every process
that a test starts would inherit that, and tests of Ctrl-C would wait for ever. A test that leaves them otherwise fails.

A test that finds a measured time too long is run up to three times: a machine is busy once, a fault is slow each time.
Only tests of modules that measure times are marked for that: it costs a marked test 40 ms beside other processes.

The end of a run with skipped tests says what to install for them (`support.tools`).

Below a red test with real processes stands how the machine was meanwhile (`support.stalls`).

The garbage collector does not look again at what the collection of tests has made, and looks more seldom at the rest:
that is 8 % of the CPU time of tests that play schedules.

The commands of a program are built from their functions once, not for each call of one: that was four fifths of the
CPU time of the tests of verbs.

Bytecode is kept, whatever the environment says: else each process that a test starts compiles all its modules anew.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import os
import signal
import sys
import tempfile
from collections.abc import Generator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer.testing

from support.shares import left_out
from support.stalls import Moment, Stalls, now
from support.tools import to_install

MEASURES = ("TooSlowError", "between", "within")
"""Names of `support.waiting` that a module imports whose tests measure times."""

REAL = ("integration", "system", "booted", "parts", "bench", "ros")
"""Folders of tests with real processes."""
ENDS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
BEGAN = pytest.StashKey[Moment]()
HANDLED = pytest.StashKey[tuple[dict[signal.Signals, Any], set[signal.Signals]]]()
STALLS = pytest.StashKey[Stalls]()


def _draw_the_same_everywhere() -> None:
    """Let no module that happens to be loaded change what Hypothesis draws.

    It draws constants out of all of them, so a test would meet other examples alone, beside others, or in another
    worker: red there, and green for whoever looks.
    """
    with contextlib.suppress(ImportError):
        providers = importlib.import_module("hypothesis.internal.conjecture.providers")
        if hasattr(providers, "is_local_module_file"):
            setattr(providers, "is_local_module_file", lambda _path: False)  # noqa: B010 - mypy knows no such attribute


def pytest_configure() -> None:
    """In each process that runs tests, before any does."""
    _draw_the_same_everywhere()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    typer.testing._get_command = cache(typer.testing._get_command)
    sys.dont_write_bytecode = False
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    for number in (signal.SIGQUIT, signal.SIGHUP):
        if signal.getsignal(number) is signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)


def pytest_addoption(parser: pytest.Parser) -> None:
    """For `.ci/run`."""
    parser.addoption("--long-share", default="", metavar="OWN/COUNT", help="of long tests only this share, from 0")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the long tests of other shares; let pytest-rerunfailures run again what was too slow, nothing else."""
    long = [item for item in items if item.get_closest_marker("long") is not None]
    others = left_out((str(item.path) for item in long), config.getoption("--long-share"))
    left = [item for item in long if str(item.path) in others]
    if left:
        config.hook.pytest_deselected(items=left)
        items[:] = [item for item in items if item not in left]
    again = pytest.mark.flaky(reruns=2, only_rerun=["TooSlowError"])
    for item in items:
        module = item.getparent(pytest.Module)
        if module is not None and any(hasattr(module.obj, name) for name in MEASURES):
            item.add_marker(again)


def pytest_collection_finish(session: pytest.Session) -> None:
    """All modules of tests are imported."""
    if any(_is_real(item) for item in session.items) and not session.config.option.collectonly:
        file = Path(tempfile.gettempdir()) / f"zsched-tests-{os.getpid()}"
        session.config.stash[STALLS] = Stalls(file)
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 20, 20)


def _is_real(item: pytest.Item) -> bool:
    return item.path.relative_to(item.config.rootpath).parts[1:2] in {(one,) for one in REAL}


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """A test begins, with its fixtures."""
    item.stash[BEGAN] = now()
    item.stash[HANDLED] = _handled()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item) -> Generator[None]:
    """What a test makes of signals ends with it: another test, far from here, would hang or end by it."""
    yield
    left = _handled()
    if left != item.stash[HANDLED]:
        for number, handler in item.stash[HANDLED][0].items():
            signal.signal(number, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, item.stash[HANDLED][1])
        raise AssertionError(f"the test has changed what signals do, or which are blocked: {left}")


def _handled() -> tuple[dict[signal.Signals, Any], set[signal.Signals]]:
    return {number: signal.getsignal(number) for number in ENDS}, signal.pthread_sigmask(signal.SIG_BLOCK, ())


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Say of a red test how the machine was."""
    report = yield
    stalls = item.config.stash.get(STALLS, None)
    if report.failed and stalls is not None and BEGAN in item.stash:
        report.sections.append(("The machine meanwhile", stalls.told(item.stash[BEGAN])))
    return report


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """The last line: what lets the skipped tests run."""
    if terminalreporter.stats.get("skipped") and (command := to_install()):
        terminalreporter.write_line(f"some tests are skipped for want of a program: {command}")


def pytest_unconfigure(config: pytest.Config) -> None:
    """This process runs no more tests."""
    if STALLS in config.stash:
        config.stash[STALLS].close()
