"""An echo worker that takes 10 ms for a sample, subscribed as its author wrote it: ``SLOW_KEEP_LAST`` or by default."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

from zsched.tasks.echo import Echo
from zsched.worker import Received, Worker


def main() -> int:
    text = os.environ.get("SLOW_KEEP_LAST", "")
    options: dict[str, Any] = {"keep_last": int(text)} if text else {}
    with Worker.from_env() as worker:
        echo = Echo(worker, latest=False, delay_s=0.0)

        def on_sample(received: Received) -> None:
            time.sleep(0.01)
            echo.on_sample(received)

        worker.subscribe("{prefix}/*/in", on_sample, **options)
        worker.ready()
        while worker.wait(0.1):
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
