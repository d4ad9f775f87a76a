"""A worker's output as log lines, the guard over process groups, and the launcher: each by itself."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys

import psutil
import pytest

from support.waiting import until
from zsched.host.clock import awake_s
from zsched.host.log_limit import LogLimit
from zsched.host.workers.kept_lines import KeptLines
from zsched.host.workers.process import (
    LAUNCHER,
    LINES_BURST,
    LineLog,
    ProcessWatch,
    WorkerGuard,
    WorkerProcess,
)


def words_of(process: psutil.Process) -> list[str]:
    """Its command line; empty for another test's child that has ended."""
    try:
        words: list[str] = process.cmdline()
    except psutil.Error:
        return []
    return words


def test_line_log_cuts_long_lines_and_counts_suppressed_ones(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "flood")
    lines = LineLog(logging.getLogger("flood"))
    lines.feed(b"a" * 5000 + b"\nhalf", 0.0)
    lines.feed(b" line\n" * 3, 0.0)
    assert [len(caplog.messages[0]), *caplog.messages[1:]] == [2052, "half line", " line", " line"]
    lines.feed(b"y\n" * 1000, 0.0)
    lines.feed(b"z\n" * 1000 + b"last words\n", 0.1)
    assert lines.last_line == "last words"
    lines.feed(b"still muted\n", 0.9)
    lines.feed(b"", 1.1)
    assert caplog.messages[-1] == f"suppressed lines={2002 - int(LINES_BURST) + 4} limit_per_s=50"


def test_lines_that_were_left_out_are_told_although_the_worker_prints_nothing_more(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """What it said before it hung was known to nobody."""
    caplog.set_level(logging.INFO, "flood")
    kept = KeptLines()
    lines = LineLog(logging.getLogger("flood"), kept)
    assert lines.tells_s() is None
    lines.feed(b"y\n" * 1000 + b"no route to the camera\n", 3.0)
    due_s = lines.tells_s()
    assert due_s is not None
    assert due_s == pytest.approx(4.0, abs=0.05)
    lines.feed(b"", due_s)
    left_out = 1001 - int(LINES_BURST)
    assert (caplog.messages[-1], lines.tells_s()) == (f"suppressed lines={left_out} limit_per_s=50", None)
    told = f"... {left_out} lines left out: more than 50 a second; the newest: no route to the camera"
    assert [line.text for line in kept.behind(int(LINES_BURST))[0]] == [told]


def test_a_worker_that_floods_and_hangs_is_told_of_by_the_watch(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "flood")
    watch = ProcessWatch()
    script = "print('y\\n' * 1000, flush=True); import time; time.sleep(600)"
    process = WorkerProcess((sys.executable, "-c", script), dict(os.environ), logging.getLogger("flood"))
    watch.add(process)

    def is_told() -> bool:
        watch.wait(awake_s() + 1.0)
        return any("suppressed" in text for text in caplog.messages)

    try:
        until(is_told, "the count of the lines that were left out")
    finally:
        watch.discard(process)
        process.finish(awake_s())
        watch.close()


def test_line_log_disarms_control_characters(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO, "flood")
    lines = LineLog(logging.getLogger("flood"))
    lines.feed(b"\x1b[2Jgone\tbad: \xff\r\n", 0.0)
    assert caplog.messages == ["?[2Jgone\tbad: \ufffd"]
    assert lines.last_line == caplog.messages[0]


def test_a_worker_s_output_has_one_limit_and_not_that_of_the_daemon_s_own_lines_too(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """All of it comes from one place of the daemon's source."""
    caplog.set_level(logging.INFO, "chatty")
    limit = LogLimit(burst=2.0, rate_hz=0.0)
    caplog.handler.addFilter(limit)
    try:
        LineLog(logging.getLogger("chatty")).feed(b"line\n" * 50, 0.0)
    finally:
        caplog.handler.removeFilter(limit)
    assert len(caplog.messages) == 50


def guarding() -> psutil.Process | None:
    """The guard's process."""
    return next((child for child in psutil.Process().children() if "zsched-guard" in words_of(child)), None)


def test_guard_that_was_killed_is_replaced_and_knows_all_groups() -> None:
    with (
        subprocess.Popen(["sleep", "60"], start_new_session=True) as first,
        subprocess.Popen(["sleep", "60"], start_new_session=True) as second,
        subprocess.Popen(["sleep", "60"], start_new_session=True) as forgotten,
    ):
        try:
            guard = WorkerGuard()
            guard.add(first.pid)
            shell = until(guarding, "the guard's process, which is not yet what it will be when it has just been made")
            shell.kill()
            shell.wait(timeout=60)
            guard.add(forgotten.pid)
            guard.add(second.pid)
            guard.discard(forgotten.pid)
            guard.close()
            assert (first.wait(timeout=60), second.wait(timeout=60)) == (-signal.SIGKILL, -signal.SIGKILL)
            assert forgotten.poll() is None
        finally:
            for process in (first, second, forgotten):
                process.kill()


def launch(parent: int, *command: str) -> subprocess.CompletedProcess[str]:
    arguments = [sys.executable, "-I", "-S", LAUNCHER, str(parent), *command]
    return subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)


def test_launcher_becomes_the_command_with_default_signals() -> None:
    done = launch(os.getpid(), "grep", "-E", "SigIgn|SigBlk", "/proc/self/status")
    assert done.returncode == 0
    masks = {name: int(bits, 16) for name, bits in (line.split(":\t") for line in done.stdout.splitlines())}
    ordinary = (1 << 31) - 1  # signals 1..31; the C library keeps the first real-time ones for itself
    assert {name: mask & ordinary for name, mask in masks.items()} == {"SigBlk": 0, "SigIgn": 0}


def test_launcher_whose_parent_has_gone_runs_nothing() -> None:
    done = launch(1, "echo", "still here")
    assert (done.returncode, done.stdout) == (1, "")


def test_launcher_says_what_it_cannot_run() -> None:
    done = launch(os.getpid(), "/no/such/program")
    assert done.returncode == 78
    assert done.stderr == "cannot run '/no/such/program': No such file or directory\n"
