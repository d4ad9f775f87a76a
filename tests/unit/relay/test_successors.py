"""How long a relay without a daemon waits for the next one: for the time in which that one could come."""

from __future__ import annotations

import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import pytest

from support.clocks import Clocks
from zsched.ipc.pipe import write_frame
from zsched.ipc.protocol import RelayHello
from zsched.relay.successors import Successors
from zsched.wire import codec as wire


class Listener(socket.socket):
    """Says when a wait at it has begun."""

    begun: Callable[[], None] = staticmethod(lambda: None)

    def fileno(self) -> int:
        """As the poller asks for it, behind the first reading of the clock."""
        self.begun()
        return super().fileno()


@pytest.fixture
def listener(tmp_path: Path) -> Iterator[Listener]:
    with closing(Listener(socket.AF_UNIX)) as listening:
        listening.bind(str(tmp_path / "relay.sock"))
        listening.listen(4)
        yield listening


def hello(incarnation: int) -> RelayHello:
    return RelayHello(fleet="hall", node="robot1", incarnation=incarnation, digest="words")


def come(listener: Listener, incarnation: int = 8) -> socket.socket:
    daemon = socket.socket(socket.AF_UNIX)
    daemon.connect(listener.getsockname())
    write_frame(daemon.fileno(), wire.encode(hello(incarnation)))
    return daemon


def test_a_daemon_at_the_door_is_let_in_though_the_time_is_over(
    listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The relay stood still for a minute, as under a debugger or on a machine that swaps."""
    clocks = Clocks(monkeypatch)
    listener.begun = lambda: setattr(clocks, "awake", clocks.awake + 60.0)
    with closing(come(listener)):
        found = Successors(listener, hello(7)).wait(10.0)
    assert found is not None
    found.link.close()


def test_a_sleep_of_the_machine_takes_nothing_from_the_wait(
    listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its next daemon slept, too, and comes only behind it."""
    clocks, come_in = Clocks(monkeypatch), list[socket.socket]()
    later = threading.Timer(0.1, lambda: come_in.append(come(listener)))

    def sleep() -> None:
        if not clocks.slept:
            clocks.slept = 60.0
            later.start()

    listener.begun = sleep
    found = Successors(listener, hello(7)).wait(10.0)
    later.join()
    come_in[0].close()
    assert found is not None
    found.link.close()


def test_nobody_and_one_that_may_not_are_waited_for_no_longer(
    listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    clocks = Clocks(monkeypatch)
    assert Successors(listener, hello(7)).wait(0.0) is None
    with closing(come(listener, 7)), closing(come(listener, 6)):
        assert Successors(listener, hello(7)).wait(0.0) is None, "one look, whoever comes on"
    assert clocks.awake == 1000.0
