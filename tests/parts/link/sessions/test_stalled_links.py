"""`zsched.link.sessions.stalled_links`: a put that waits for a frozen receiver is let go; no other link ends."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zenoh

from support.hand_relay import INPUT, KEYS, Relay, environment
from support.sessions import hub_and_neighbour
from support.waiting import free_endpoint, until, within
from zsched.core.values.plan import StreamClass, StreamSettings, WorkerRole
from zsched.host.clock import monotonic_s
from zsched.link.sessions.config import worker_config
from zsched.link.sessions.stalled_links import StalledLinks
from zsched.relay.streams.acks import Acks
from zsched.relay.streams.outlet import Outlet
from zsched.worker import Worker

OUT = "edge1/t/1/shared/out"
LISTENER = """
import sys, time, zenoh
session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))
kept = session.declare_subscriber(sys.argv[2], lambda sample: print(len(sample.payload), flush=True))
time.sleep(600)
"""


class Links:
    """Connections that stand in for those of a session."""

    def __init__(self) -> None:
        self.links: list[Any] = []
        self.info = SimpleNamespace(links=lambda: tuple(self.links))
        self.open = contextlib.ExitStack()

    def add(self) -> tuple[socket.socket, socket.socket]:
        """(ours, theirs); nothing fits into ours."""
        with socket.create_server(("127.0.0.1", 0)) as server:
            ours = self.open.enter_context(socket.create_connection(server.getsockname()))
            theirs = self.open.enter_context(server.accept()[0])
        ours.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                ours.send(bytes(1 << 20))
        ends = [f"tcp/{host}:{port}" for host, port in (ours.getsockname(), ours.getpeername())]
        self.links.append(SimpleNamespace(zid=str(len(self.links)), src=ends[0], dst=ends[1]))
        return ours, theirs


@pytest.fixture
def links() -> Iterator[Links]:
    made = Links()
    with made.open:
        yield made


def is_ended(theirs: socket.socket) -> bool:
    """Read all there is; whether the end is behind it."""
    theirs.setblocking(False)
    try:
        while theirs.recv(1 << 20):
            pass
    except BlockingIOError:
        return False
    except ConnectionResetError:
        pass
    return True


def test_who_is_not_heard_and_has_no_room_loses_its_link_and_nobody_else(links: Links) -> None:
    _, frozen = links.add()
    heard, alive = links.add()
    _, roomy = links.add()
    is_ended(roomy)
    stalled = StalledLinks(cast("Any", links), 1.0)

    def talk() -> bool:
        alive.send(b"x")
        heard.recv(64)
        return stalled.ended == 1

    with stalled:
        until(talk, "one link is ended")
    assert is_ended(frozen)
    assert not is_ended(alive)
    assert not is_ended(roomy)
    stalled.close()


def test_who_is_heard_and_takes_nothing_is_waited_for_no_longer_than_that(links: Links) -> None:
    """What has come by it is not read: zenoh would take it for samples of other keys (test_stale_keys)."""
    heard, alive = links.add()
    alive.sendall(b"late")
    stalled = StalledLinks(cast("Any", links), 1000.0, full_s=0.3)
    with stalled:
        until(lambda: stalled.ended == 1, "its link is ended")
    with pytest.raises(ConnectionResetError):
        heard.recv(4)
    assert is_ended(alive)
    stalled.close()


def test_while_nothing_is_put_no_link_is_ended(links: Links) -> None:
    _, theirs = links.add()
    stalled = StalledLinks(cast("Any", links), 0.1, full_s=0.1)
    for _ in range(30):
        with stalled:
            pass
        time.sleep(0.02)  # each put is a short one
    assert stalled.ended == 0
    assert not is_ended(theirs)
    stalled.close()


def test_a_frozen_robot_holds_the_answers_of_the_others_up_for_less_than_zenoh_does(
    relay: Relay, tmp_path: Path
) -> None:
    """It had its lease and 5 s more: zenoh took back what was queued for it, behind the put that waited for it."""
    text = worker_config(connect=(relay.endpoint,), shared_memory=False)
    with (
        Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker,
        subprocess.Popen([sys.executable, "-c", LISTENER, text, OUT], stdout=subprocess.PIPE, text=True) as other,
    ):
        try:
            out = worker.publisher("{prefix}/{epoch}/shared/out", reliable=True)
            worker.ready()
            until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
            relay.tell(WorkerRole.ACTIVE, 1)
            lines: list[str] = []
            reader = threading.Thread(target=lambda: lines.extend(other.stdout or ()), daemon=True)
            reader.start()
            until(lambda: out.put(b"x") and relay.outputs and lines, "both hear")
            other.send_signal(signal.SIGSTOP)
            took: list[float] = []
            large = bytes(200_000)  # what sockets may hold is several MB by now
            began = monotonic_s()
            while monotonic_s() - began < 4.0:
                before = monotonic_s()
                out.put(large)
                took.append(monotonic_s() - before)
                time.sleep(0.015)
        finally:
            other.kill()
        reader.join()
    assert max(took) > 0.2, "the put has waited for the frozen one"
    within(max(took), 2.0)


def test_a_relay_ends_the_link_of_a_frozen_worker_behind_its_put(tmp_path: Path) -> None:
    """Whatever else the relay puts to that worker's machine waits behind that put: by zenoh alone for 5 s and more."""
    endpoint, path = free_endpoint(), tmp_path / "worker.json5"
    path.write_text(worker_config(connect=(endpoint,), shared_memory=False))
    variables = {"FLEET": "test", "NODE": "edge1", "TASK": "t", "INCARNATION": "3", "ZENOH_CONFIG": str(path)}
    env = os.environ | {f"ZSCHED_{name}": value for name, value in variables.items()}
    samples: list[zenoh.Sample] = []
    with (
        hub_and_neighbour(endpoint) as (relay, _),
        subprocess.Popen([sys.executable, "-m", "zsched.tasks.echo"], env=env) as worker,
    ):
        try:
            acks = Acks(relay, KEYS, "robot1", lambda _node, _task, _life: True)
            settings = StreamSettings(stream_class=StreamClass.RELIABLE, depth=100)
            outlet = Outlet(relay, "robot1/in", INPUT, settings, acks.of("edge1", "t"))
            lane = outlet._main
            assert lane is not None
            taken = relay.declare_subscriber("robot1/in", samples.append)
            relay.put("robot1/in", bytes(800_000))  # 70 of them are more than any sockets hold: 32 + 4 MB (tcp(7))
            until(lambda: samples, "a sample")
            outlet.send(samples[0])

            def has_come() -> bool:
                outlet.look_after()
                return lane.ack is not None and lane.ack.arrived == 1

            until(has_come, "the worker has it")
            worker.send_signal(signal.SIGSTOP)
            for _ in range(70):
                outlet.send(samples[0])
            until(lambda: acks.stalled.ended, "its link is ended")

            def longest_s() -> float:
                with outlet._lock:
                    return max(sent.took_s for sent in lane.kept)

            until(lambda: longest_s() > 0.2, "the end of the put that has waited")
            within(longest_s(), 2.0, "in a put")
            taken.undeclare()
        finally:
            worker.kill()
        outlet.undeclare()
