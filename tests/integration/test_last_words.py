"""A process of zsched that is aborted (systemd's watchdog) or crashes says in its log where every thread stood."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from zsched.lab.netbed import descendants_running
from zsched.lab.testbed import Testbed, echo_fleet

LAST_WORDS = "Fatal Python error: Aborted"
WAIT_S = 40.0


def test_daemon_relay_and_worker_tell_where_they_stood(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:

        def has_told(count: int, place: str) -> bool:
            _, *words = bed.log("robot1").split(LAST_WORDS)
            return len(words) == count and place in words[-1]

        bed.init()
        bed.start()
        bed.wait_settled()
        (worker,) = descendants_running(bed.pid("robot1"), "zsched.tasks.echo")
        os.kill(worker, signal.SIGABRT)
        bed.wait(lambda: has_told(1, "tasks/echo"), WAIT_S, "the worker's words")
        os.kill(bed.relay_pid("robot1") or 0, signal.SIGABRT)
        bed.wait(lambda: has_told(2, "relay/process.py"), WAIT_S, "the relay's words")
        bed.send("robot1", signal.SIGABRT)
        bed.wait(lambda: has_told(3, "zsched/daemon.py"), WAIT_S, "the daemon's words")
