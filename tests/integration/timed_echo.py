"""An echo worker without zsched's library; ``KEEPS_STAMP=0``: it does not put the inputs' timestamps on its answers.

After SIGUSR1 it takes inputs and answers none.
"""

from __future__ import annotations

import os
import queue
import signal
import sys
import time
from types import FrameType

import zenoh

PREFIX = f"{os.environ['ZSCHED_NODE']}/{os.environ['ZSCHED_TASK']}"
KEEPS_STAMP = os.environ.get("KEEPS_STAMP", "1") == "1"
WAIT_S = 0.06


def main() -> int:
    ends: list[int] = []

    def end(number: int, _frame: FrameType | None) -> None:
        ends.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, end)
    hangs: list[int] = []
    signal.signal(signal.SIGUSR1, lambda number, _frame: hangs.append(number))
    waiting: queue.SimpleQueue[zenoh.Sample] = queue.SimpleQueue()
    with zenoh.open(zenoh.Config.from_file(os.environ["ZSCHED_ZENOH_CONFIG"])) as session:
        subscriber = session.declare_subscriber(f"{PREFIX}/*/in", waiting.put)
        while not ends:
            try:
                sample = waiting.get(timeout=0.2)
            except queue.Empty:
                continue
            if hangs:
                continue
            time.sleep(WAIT_S)
            robot = str(sample.key_expr).split("/")[-2]
            stamp = sample.timestamp if KEEPS_STAMP else None
            session.put(f"{PREFIX}/{robot}/out", sample.payload, timestamp=stamp)
        subscriber.undeclare()
    return 0


if __name__ == "__main__":
    sys.exit(main())
