"""The echo worker whose callback raises on what begins with ``bad``; while a file says so, it cannot run here."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from zsched.tasks.echo import Echo
from zsched.worker import Received, Worker


def main() -> int:
    if (Path(os.environ["TOUCHY_FOLDER"]) / f"broken-{os.environ['ZSCHED_NODE']}").exists():
        print("no model file here", flush=True)
        return 78
    with Worker.from_env() as worker:
        echo = Echo(worker, latest=True, delay_s=0.0)

        def on_sample(received: Received) -> None:
            if received.payload.to_bytes().startswith(b"bad"):
                raise ValueError("no such map")
            echo.on_sample(received)

        worker.subscribe("{prefix}/*/in", on_sample, keep_last=None)
        worker.ready()
        while worker.wait(0.1):
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
