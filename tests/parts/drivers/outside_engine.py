"""An engine whose worker is a `sleep` that is nobody's child, as a unit or a container is not the driver's."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from zsched.drivers.engine import Ended, drive
from zsched.drivers.place import Place


class Outside:
    """``mode``: refuse, late (a signal comes while it begins), deaf (hears SIGKILL only), or anything else.

    messy: it leaves something to be cleared away.
    """

    is_child = False

    def __init__(self, mode: str) -> None:
        self._mode, self._pid = mode, 0
        self.leaves_nothing = mode != "messy"

    def begin(self, tell_end: Callable[[Ended], None]) -> Ended | None:
        del tell_end
        if self._mode == "refuse":
            return Ended(reason="there is no such thing here", is_final=True)
        if self._mode == "late":
            os.kill(os.getpid(), signal.SIGTERM)
            return None
        deaf = "trap '' TERM; " if self._mode == "deaf" else ""
        script = f'setsid sh -c "{deaf}echo it runs; while :; do sleep 0.05; done" >&2 & echo $!'
        done = subprocess.run(["sh", "-c", script], stdout=subprocess.PIPE, text=True, check=True)
        self._pid = int(done.stdout)
        return None

    def run(self) -> Sequence[str]:
        if self._mode == "late":
            print("it is started", flush=True)
        return ("tail", f"--pid={self._pid}", "-s", "0.05", "-f", "/dev/null")

    def log(self) -> Sequence[str]:
        return ()

    def pid(self) -> int | None:
        return self._pid

    def stop(self, *, is_hard: bool) -> None:
        os.kill(self._pid, signal.SIGKILL if is_hard else signal.SIGTERM)

    def why(self, status: int) -> Ended:
        return Ended(reason=f"it has ended, status {status}")

    def last_resort(self) -> str:
        cleared = Path(os.environ["ZSCHED_ZENOH_CONFIG"]).with_name("cleared")
        return f"kill -KILL {self._pid}; : > {cleared}"


if __name__ == "__main__":
    sys.exit(drive(Outside(sys.argv[1]), Place.from_env(os.environ)))
