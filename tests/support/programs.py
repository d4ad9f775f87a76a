"""Programs as processes: modules of ours, and such as answer line by line."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path


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


@contextlib.contextmanager
def process(command: Sequence[str | Path], **environment: str) -> Iterator[Callable[[str], str]]:
    """What to say to it, and what it answers; it has begun."""
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True, env={**os.environ, **environment}) as made:
        assert made.stdin is not None
        assert made.stdout is not None
        made.stdout.readline()

        def ask(line: str) -> str:
            assert made.stdin is not None
            assert made.stdout is not None
            made.stdin.write(line + "\n")
            made.stdin.flush()
            return made.stdout.readline().strip()

        try:
            yield ask
        finally:
            made.kill()
