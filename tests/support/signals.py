"""Signals as the kernel gives them to a process of many threads."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from typing import Any

from support.waiting import until


def signal_at_once(process: subprocess.Popen[Any], *numbers: signal.Signals) -> None:
    """Let a process whose main thread sleeps have the signals together: whichever thread goes on first takes them."""
    _until_it_is(process, "S")
    process.send_signal(signal.SIGSTOP)
    _until_it_is(process, "T")
    for number in (*numbers, signal.SIGCONT):
        process.send_signal(number)


def stand_still(process: subprocess.Popen[Any]) -> None:
    """SIGSTOP; waits until no thread of the process runs any more.

    The first thread that has the signal stops the others. On a busy machine they go on until it gets a processor.
    """
    process.send_signal(signal.SIGSTOP)
    tasks = Path(f"/proc/{process.pid}/task")
    until(lambda: {_state(one) for one in tasks.iterdir()} == {"T"}, "all threads stopped")


def _state(task: Path) -> str:
    """proc_pid_stat(5), of one thread."""
    return (task / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0]


def _until_it_is(process: subprocess.Popen[Any], state: str) -> None:
    """``state`` of its main thread."""
    until(lambda: _state(Path(f"/proc/{process.pid}/task/{process.pid}")) == state, f"state {state}")


def signal_another_thread(process: subprocess.Popen[Any], number: signal.Signals) -> None:
    """Let another thread than the main one, which sleeps, have the signal; waits until it is so.

    So the kernel does when another signal is pending in the main thread. ``kill`` of a thread's number signals the
    whole process, and this thread has it first.
    """
    tasks = Path(f"/proc/{process.pid}/task")
    others = until(lambda: [int(one.name) for one in tasks.iterdir() if one.name != str(process.pid)], "another thread")
    _until_it_is(process, "S")
    os.kill(min(others), number)
