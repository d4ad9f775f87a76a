"""An echo worker that computes for ``BUSY_MS`` of CPU time a sample."""

from __future__ import annotations

import os
import sys
import time

from zsched.tasks.echo import Echo
from zsched.worker import Received, Worker


def main() -> int:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # beside the test's busy loops, whatever else runs here
    busy_s = float(os.environ["BUSY_MS"]) / 1e3
    with Worker.from_env() as worker:
        echo = Echo(worker, latest=False, delay_s=0.0)

        def on_sample(received: Received) -> None:
            until = time.thread_time() + busy_s
            while time.thread_time() < until:
                pass
            echo.on_sample(received)

        worker.subscribe("{prefix}/*/in", on_sample, keep_last=1)
        worker.ready()
        while worker.wait(0.1):
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
