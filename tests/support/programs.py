"""Modules of ours as processes."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator


@contextlib.contextmanager
def running(*commands: list[str]) -> Iterator[list[subprocess.Popen[bytes]]]:
    """``python -m`` of every command; at the end they are asked to stop, must do so with 0, and are reaped."""
    processes = [subprocess.Popen([sys.executable, "-m", *command]) for command in commands]
    try:
        yield processes
        for process in processes:
            process.terminate()
        assert [process.wait(timeout=15.0) for process in processes] == [0] * len(processes)
    finally:
        for process in processes:
            process.kill()
            process.wait()
