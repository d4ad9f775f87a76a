"""An operator at the command line of one machine of a real fleet, and an application whose stream runs meanwhile."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from pathlib import Path

import zenoh

from zsched_lab.fleet.testbed import Testbed

PERIOD_S = 0.01


class Operator:
    """The command line of one machine."""

    def __init__(self, bed: Testbed, runtime: Path | None = None) -> None:
        """``runtime``: a folder with the operator sockets of that machine alone."""
        kept = {name: value for name, value in os.environ.items() if not name.startswith("ZSCHED_")}
        self._env = {**kept, "ZSCHED_RUNTIME_DIR": str(runtime or bed.folder), "ZSCHED_NODE": "robot1"}

    def zsched(self, *words: object) -> subprocess.CompletedProcess[bytes]:
        """One verb, to its end."""
        command = [sys.executable, "-m", "zsched.cli", *map(str, words)]
        return subprocess.run(command, env=self._env, capture_output=True, timeout=60, check=False)

    def done(self, *words: object) -> str:
        """What a verb prints that must succeed."""
        result = self.zsched(*words)
        assert result.returncode == 0, (words, result.stderr.decode())
        return result.stdout.decode()


class Stream:
    """An application that puts numbers into the first task's input and keeps what comes back."""

    def __init__(self, session: zenoh.Session, period_s: float = PERIOD_S, *, robot: str = "robot1") -> None:
        self.back: list[int] = []
        self.sent = 0
        self._sub = session.declare_subscriber(
            f"{robot}/out", lambda sample: self.back.append(int(sample.payload.to_bytes()))
        )
        self.publisher = session.declare_publisher(f"{robot}/in", congestion_control=zenoh.CongestionControl.BLOCK)
        self._period_s = period_s
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(self._period_s):
            self.publisher.put(str(self.sent).encode())
            self.sent += 1

    def end(self) -> None:
        self._ended.set()
        self._thread.join(60)
