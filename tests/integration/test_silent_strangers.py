"""Connections that say nothing take a daemon's descriptors; it works on, and answers its operator afterwards."""

from __future__ import annotations

import contextlib
import resource
import socket
import threading
from pathlib import Path

from zsched.errors import AdapterError
from zsched.lab.testbed import Testbed, echo_fleet

SPARE = 12
"""Descriptors that the daemon has left when the strangers come."""


def swarm(endpoint: str, stop: threading.Event) -> None:
    """Keep some hundred silent connections open, each given up after a while and opened again."""
    host, _, port = endpoint.removeprefix("tcp/").rpartition(":")
    held: list[socket.socket] = []
    while not stop.is_set():
        with contextlib.suppress(OSError):
            held.append(socket.create_connection((host, int(port)), 0.2))
        if len(held) > 400:
            held.pop(0).close()
    for one in held:
        one.close()


def test_status_answers_after_thousands_of_silent_connections(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        pid, endpoint = bed.pid("robot1"), bed.fleet.node("robot1").listen_control
        most = len(list(Path(f"/proc/{pid}/fd").iterdir())) + SPARE
        resource.prlimit(pid, resource.RLIMIT_NOFILE, (most, most))
        stop = threading.Event()
        threads = [threading.Thread(target=swarm, args=(endpoint, stop)) for _ in range(2)]
        for thread in threads:
            thread.start()
        try:
            bed.wait(lambda: asked_in_vain(bed), 60, "the daemon to be without descriptors")
        finally:
            stop.set()
            for thread in threads:
                thread.join(30)
        bed.wait(lambda: bed.status("robot1"), 60, "an answer once the strangers are gone")
        assert bed.wait_settled() == "robot1"


def asked_in_vain(bed: Testbed) -> bool:
    with contextlib.suppress(AdapterError):
        bed.status("robot1", 0.3)
    return "no_connection_taken" in bed.log("robot1")
