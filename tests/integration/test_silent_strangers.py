"""Connections that say nothing take a process's descriptors; daemon and relay work on, and take others afterwards."""

from __future__ import annotations

import contextlib
import resource
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from zsched.core.values.errors import AdapterError
from zsched.link.sessions import config as zenoh_config
from zsched.runtime.descriptors import WANTED
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

SPARE = 12
"""Descriptors that the process has left when the strangers come."""


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


@contextlib.contextmanager
def strangers(endpoint: str) -> Iterator[None]:
    stop = threading.Event()
    threads = [threading.Thread(target=swarm, args=(endpoint, stop)) for _ in range(2)]
    for thread in threads:
        thread.start()
    try:
        yield
    finally:
        stop.set()
        for thread in threads:
            thread.join(30)


def leave_few(pid: int) -> int:
    """Take all but a few descriptors from a process; how many it may have now."""
    most = len(list(Path(f"/proc/{pid}/fd").iterdir())) + SPARE
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (most, resource.prlimit(pid, resource.RLIMIT_NOFILE)[1]))
    return most


def test_status_answers_after_thousands_of_silent_connections(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        leave_few(bed.pid("robot1"))
        with strangers(bed.fleet.node("robot1").listen_control):
            bed.wait(lambda: asked_in_vain(bed), 60, "the daemon to be without descriptors")
        bed.wait(lambda: bed.status("robot1"), 60, "an answer once the strangers are gone")
        assert bed.wait_settled() == "robot1"


def test_a_relay_takes_applications_after_thousands_of_silent_connections(tmp_path: Path) -> None:
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        relay, endpoint = bed.relay_pid("robot1") or 0, bed.fleet.node("robot1").listen_data
        most = leave_few(relay)
        with strangers(endpoint):
            bed.wait(lambda: len(list(Path(f"/proc/{relay}/fd").iterdir())) >= most, 60, "a relay without descriptors")
            bed.wait(lambda: not opens(endpoint), 60, "an application that is not let in")
        bed.wait(lambda: opens(endpoint), 60, "an application that is let in once the strangers are gone")
        back: list[bytes] = []
        session = bed.app("robot1")
        session.declare_subscriber("robot1/out", lambda sample: back.append(sample.payload.to_bytes()))

        def is_answered() -> bool:
            session.put("robot1/in", b"one")
            return bool(back)

        bed.wait(is_answered, 60, "an answer")
        assert bed.relay_pid("robot1") == relay


def opens(endpoint: str) -> bool:
    """Whether the relay takes one application more."""
    try:
        zenoh.open(zenoh.Config.from_json5(zenoh_config.client_config(connect=(endpoint,)))).close()
    except zenoh.ZError:
        return False
    return True


def test_a_daemon_and_its_relay_take_all_the_descriptors_that_they_may_have(tmp_path: Path) -> None:
    """A login's usual limit is 1024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with Testbed(tmp_path, echo_fleet(robots=1, edges=0)) as bed:
        bed.init()
        resource.setrlimit(resource.RLIMIT_NOFILE, (1024, hard))
        try:
            bed.start()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        bed.wait_settled()
        most = WANTED if hard == resource.RLIM_INFINITY else min(hard, WANTED)
        for pid in (bed.pid("robot1"), bed.relay_pid("robot1") or 0):
            assert resource.prlimit(pid, resource.RLIMIT_NOFILE)[0] == most


def asked_in_vain(bed: Testbed) -> bool:
    with contextlib.suppress(AdapterError):
        bed.status("robot1", 0.3)
    return "no_connection_taken" in bed.log("robot1")
