"""The echo worker with one weak spot: on SIGUSR1 its dispatch thread turns in an endless loop; its token stays."""

from __future__ import annotations

import signal
import sys

from zsched.tasks.echo import Echo
from zsched.worker import Received, Worker


def main() -> int:
    hangs: list[int] = []
    with Worker.from_env() as worker:
        echo = Echo(worker, latest=True, delay_s=0.0)

        def on_sample(received: Received) -> None:
            while hangs:
                pass
            echo.on_sample(received)

        worker.subscribe("{prefix}/*/in", on_sample, keep_last=None)
        signal.signal(signal.SIGUSR1, lambda number, _frame: hangs.append(number))
        worker.ready()
        while worker.wait(0.1):
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
