"""A process of zsched that is aborted (systemd's watchdog) or crashes says in its log where every thread stood."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path

from zsched_lab.fleet.netbed import descendants_running
from zsched_lab.fleet.testbed import Testbed, echo_fleet

LAST_WORDS = "Fatal Python error: Aborted"
TRIPPED = "Fatal Python error: Segmentation fault"
"""faulthandler looks at threads that run on meanwhile, and trips over one of them now and then."""
TRIES = 3
WAIT_S = 40.0


def test_daemon_relay_and_worker_tell_where_they_stood(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        aborted: list[int | None] = [None]

        def words(place: str, end: Callable[[], None]) -> str:
            """The last words of a process that ``end`` aborts, once they name the place, or break off."""
            before = len(bed.log("robot1"))
            end()

            def told() -> str:
                said = bed.log("robot1")[before:].partition(LAST_WORDS)[2]
                return said if place in said or TRIPPED in said else ""

            return bed.wait(told, WAIT_S, f"the last words of {place}")

        def tells(process: Callable[[], int | None], place: str) -> bool:
            """Whether one of a few processes, each started after the other, tells it whole."""
            for _ in range(TRIES):
                bed.wait(lambda: process() not in aborted, WAIT_S, f"a process of {place}")
                aborted.append(pid := process())
                if pid is not None and place in words(place, lambda: os.kill(pid, signal.SIGABRT)):
                    return True
            return False

        def worker() -> int | None:
            return next(iter(descendants_running(bed.pid("robot1"), "zsched.tasks.echo")), None)

        bed.init()
        bed.start()
        bed.wait_settled()
        assert tells(worker, "tasks/echo")
        assert tells(lambda: bed.relay_pid("robot1"), "relay/process.py")
        assert words("zsched/daemon.py", lambda: bed.send("robot1", signal.SIGABRT))
