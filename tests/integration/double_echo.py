"""An echo worker that gives every sample two answers: ``1 <number>`` and ``2 <number>``.

``double_echo.py [N]``: between those to sample N it stands still for ever.
"""

from __future__ import annotations

import sys
import threading

from zsched.worker import Received, Worker


def main() -> int:
    stops_at = sys.argv[1].encode() if len(sys.argv) > 1 else None
    with Worker.from_env() as worker:
        out = worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)

        def on_sample(received: Received) -> None:
            number = received.payload.to_bytes()
            out.put(b"1 " + number)
            if number == stops_at:
                threading.Event().wait()
            out.put(b"2 " + number)

        worker.subscribe("{prefix}/*/in", on_sample)
        worker.ready()
        while worker.wait(0.1):
            pass
    return 0


if __name__ == "__main__":
    sys.exit(main())
