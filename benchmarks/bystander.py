"""Another application of the robot that receives every answer and freezes now and then: nobody else may notice.

Knows: a process that subscribes, signals. Does not know: what the others' answers should be.
"""

from __future__ import annotations

import random
import signal
import subprocess
import sys
import threading
from types import TracebackType
from typing import Self

from zsched.core.values.fleet import Timing
from zsched.host.guard import guarded
from zsched.link.sessions.config import client_config

PATIENT = Timing(zenoh_lease_s=20.0)
"""The end of its lease helps nobody."""


class Bystander:
    """Receives ``watch`` from a relay; stopped for 1 to 6 s, every 5 to 15 s."""

    def __init__(self, endpoint: str, watch: str, seed: int) -> None:
        config = client_config(connect=(endpoint,), timing=PATIENT)
        command = [sys.executable, "-m", "zsched_lab.fleet.probe", config, "--watch", watch]
        self._random = random.Random(seed)
        self._stop = threading.Event()
        self.freezes = 0
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL)
        self._thread = guarded(self._run, name="bystander", is_lasting=False)

    def _run(self) -> None:
        while not self._stop.wait(self._random.uniform(5, 15)):
            self._process.send_signal(signal.SIGSTOP)
            self.freezes += 1
            self._stop.wait(self._random.uniform(1, 6))
            self._process.send_signal(signal.SIGCONT)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join(10)
        self._process.kill()
        self._process.communicate(timeout=10)
