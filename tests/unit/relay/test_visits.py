"""How long a relay without a daemon waits for the next one: for the time in which that one could come."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from support.clocks import Clocks
from zsched.core.values import codec as wire
from zsched.link.pipe.frames import write_frame
from zsched.link.pipe.protocol import RelayHello
from zsched.link.pipe.relay_socket import PROTOCOL
from zsched.relay import visits as relay_visits
from zsched.relay.visits import Visits


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "relay"


@pytest.fixture
def visits(path: Path) -> Iterator[Visits]:
    with closing(Visits(path)) as listening:
        yield listening


def come(path: Path) -> socket.socket:
    daemon = socket.socket(socket.AF_UNIX)
    daemon.connect(str(path))
    hello = RelayHello(protocol=PROTOCOL, fleet="hall", node="robot1", threads=6)
    for frame in (wire.encode(hello), b"{}"):
        write_frame(daemon.fileno(), frame)
    return daemon


def test_a_daemon_that_waits_is_let_in_though_the_time_is_over(
    visits: Visits, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay stood still for a minute, as under a debugger or on a machine that swaps."""
    clocks, wait = Clocks(monkeypatch), visits._wait

    def stood_still(link: socket.socket | None, timeout_s: float) -> set[int]:
        clocks.awake += 60.0
        return wait(link, timeout_s)

    monkeypatch.setattr(visits, "_wait", stood_still)
    with closing(come(path)):
        found = visits.next_daemon(10.0)
    assert found is not None
    assert (found.hello.node, found.session) == ("robot1", "{}")
    found.link.close()


def test_a_sleep_of_the_machine_takes_nothing_from_the_wait(
    visits: Visits, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its next daemon slept, too, and comes only behind it."""
    clocks, come_in, wait = Clocks(monkeypatch), list[socket.socket](), visits._wait
    later = threading.Timer(0.1, lambda: come_in.append(come(path)))

    def sleeps(link: socket.socket | None, timeout_s: float) -> set[int]:
        if not clocks.slept:
            clocks.slept = 60.0
            later.start()
        return wait(link, timeout_s)

    monkeypatch.setattr(visits, "_wait", sleeps)
    found = visits.next_daemon(10.0)
    later.join()
    come_in[0].close()
    assert found is not None
    found.link.close()


def test_nobody_and_one_that_says_nothing_are_waited_for_no_longer(
    visits: Visits, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(relay_visits, "HELLO_S", 0.05)
    clocks = Clocks(monkeypatch)
    assert visits.next_daemon(0.0) is None
    silent = [socket.socket(socket.AF_UNIX) for _ in range(2)]
    for one in silent:
        one.connect(str(path))
    assert visits.next_daemon(0.0) is None, "one look, whoever comes on"
    assert clocks.awake == 1000.0
    for one in silent:
        one.close()
