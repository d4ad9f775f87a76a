"""A worker of an exclusive task that writes down every moment at which it passed its own check: is the lease mine?

Knows: `zsched.worker`. Does not know: other workers; `zsched_lab.fleet.chaos` compares the files of all workers.

``python -m zsched_lab.fleet.active_worker FOLDER``: a hundred times a second it puts ``NUMBER NOW EPOCH`` on
``{node}/{task}/{epoch}/tick``; when that was admitted it adds a line ``EPOCH NOW`` to ``FOLDER/<node>-<pid>.ticks``,
NOW in seconds of CLOCK_BOOTTIME, read before the check.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

from zsched.host.clock import monotonic_s
from zsched.worker import Worker

PERIOD_S = 0.01


def main() -> int:
    """Run until told to stop; the exit code."""
    with Worker.from_env() as worker:
        node = worker.prefix.partition("/")[0]
        output = worker.publisher("{prefix}/{epoch}/tick")
        worker.ready()
        number = 0
        with Path(sys.argv[1], f"{node}-{os.getpid()}.ticks").open("ab", buffering=0) as file:
            while worker.wait(PERIOD_S):
                epoch, now = worker.role.epoch, monotonic_s()
                message = f"{number:010d} {now:.6f} {epoch}".encode()
                if output.put(message, encoding=f"application/octet-stream;{node}"):
                    file.write(f"{epoch} {now:.6f}\n".encode())
                    number += 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
