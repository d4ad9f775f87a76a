"""The control session's beginning and end: tokens, taken ports, closing from every state, interpreters that exit."""

from __future__ import annotations

import signal
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator

import pytest

from support.beats import beat_of
from support.profiles import load_of, profile_of
from support.waiting import free_endpoint, until, within
from zsched.core.values import events as ev
from zsched.core.values.errors import AdapterError
from zsched.core.values.fleet import Timing
from zsched.link.bus.control_bus import ControlBus
from zsched.link.sessions.config import control_config

CHILD = textwrap.dedent(
    """
    import sys
    from zsched.link.bus.control_bus import ControlBus
    from zsched.link.sessions.config import control_config

    events = []
    connect = tuple(sys.argv[2:])
    config = control_config(listen=("tcp/127.0.0.1:0",), connect=connect)
    bus = ControlBus(fleet="f", node="child", incarnation=int(sys.argv[1]), zenoh_config=config, post=events.append)
    bus.open()
    print("open", flush=True)
    what = sys.stdin.readline().strip()
    if what == "ask":  # and close while the questions are open
        bus.ask_utilities(1, 5.0)
        bus.ask_learnt("parent", 5.0)
    bus.close()
    if what == "twice":
        bus.close()
    print("closed", flush=True)
    """
)


class Parent:
    """A bus in this process."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.events: list[ev.Event] = []
        self.bus = self.make()

    def make(self) -> ControlBus:
        config = control_config(listen=(self.endpoint,), connect=(), timing=Timing())
        return ControlBus(fleet="f", node="parent", incarnation=1, zenoh_config=config, post=self.events.append)

    def has(self, event: ev.Event) -> bool:
        return event in tuple(self.events)


@pytest.fixture
def parent() -> Iterator[Parent]:
    made = Parent()
    made.bus.open()
    try:
        yield made
    finally:
        made.bus.close()


Spawn = Callable[[int], "subprocess.Popen[str]"]


@pytest.fixture
def spawn(parent: Parent) -> Iterator[Spawn]:
    """Starts children that are connected to the parent; ends them whatever happens."""
    children: list[subprocess.Popen[str]] = []

    def start(incarnation: int) -> subprocess.Popen[str]:
        child = subprocess.Popen(
            [sys.executable, "-c", CHILD, str(incarnation), parent.endpoint],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        children.append(child)
        seen = ev.TokenSeen(node="child", incarnation=incarnation)
        until(lambda: parent.has(seen) or child.poll() is not None, "the child's token")
        assert child.poll() is None
        return child

    yield start
    for child in children:
        child.kill()
        child.communicate(timeout=60)


def test_token_of_a_killed_process_goes_within_milliseconds_and_names_its_life(parent: Parent, spawn: Spawn) -> None:
    for incarnation in (5, 6):
        within(until_lost(parent, spawn, incarnation, signal.SIGKILL), 0.5)


def until_lost(parent: Parent, spawn: Spawn, incarnation: int, fault: signal.Signals) -> float:
    """Seconds from the fault of a child to the end of the token of just this life."""
    child = spawn(incarnation)
    child.send_signal(fault)
    start = time.monotonic()
    until(lambda: parent.has(ev.TokenLost(node="child", incarnation=incarnation)), "the token's end")
    return time.monotonic() - start


def test_token_of_a_stopped_process_goes_within_its_lease(parent: Parent, spawn: Spawn) -> None:
    within(until_lost(parent, spawn, 5, signal.SIGSTOP), Timing().control_lease_s + 1.0)


def test_orderly_close_withdraws_the_token(parent: Parent, spawn: Spawn) -> None:
    child = spawn(5)
    out, _ = child.communicate("close\n", timeout=60)
    assert out == "open\nclosed\n"
    until(lambda: parent.has(ev.TokenLost(node="child", incarnation=5)), "the token's end")


@pytest.mark.parametrize("what", ["close", "twice", "ask"])
def test_interpreter_exits_by_itself_after_close(spawn: Spawn, what: str) -> None:
    """No thread of zenoh's is left that it would wait for, not even with questions open."""
    child = spawn(5)
    start = time.monotonic()
    out, _ = child.communicate(f"{what}\n", timeout=60)
    assert (child.returncode, out) == (0, "open\nclosed\n")
    within(time.monotonic() - start, 3.0)


def closed_within(bus: ControlBus, seconds: float) -> None:
    start = time.monotonic()
    bus.close()
    assert time.monotonic() - start < seconds


def test_close_takes_less_than_a_second_from_every_state(spawn: Spawn, parent: Parent) -> None:
    closed_within(Parent().bus, 0.1)  # never opened
    spawn(5)
    parent.bus.ask_utilities(1, 5.0)
    closed_within(parent.bus, 1.0)
    closed_within(parent.bus, 0.1)


def test_close_towards_a_stopped_peer_takes_less_than_a_second(spawn: Spawn, parent: Parent) -> None:
    """zenoh itself waits for a peer that does not read; a daemon that is told to stop must not."""
    child = spawn(5)
    child.send_signal(signal.SIGSTOP)
    load = load_of("x" * 60)
    large = profile_of(
        "parent", cpu_cores=1, cpu_used_cores=None, memory_mb=10, memory_used_mb=None, workers=(load,) * 250
    )
    for _ in range(500):  # more than the socket and zenoh's queue take
        parent.bus.publish("profile", large)
    closed_within(parent.bus, 1.0)


def test_closed_bus_takes_calls_and_does_nothing() -> None:
    bus = Parent().bus
    bus.publish("beat", beat_of("parent"))
    bus.ask_utilities(1, 0.1)
    bus.ask_learnt("child", 0.1)
    bus.answer(1, beat_of("parent"))
    assert bus.peers() == 0
    with pytest.raises(AdapterError, match="closed"):
        bus.ask_node("child", None, 0.1)


def test_taken_port_is_an_error_that_says_so(parent: Parent) -> None:
    second = parent.make()
    with pytest.raises(
        AdapterError, match=r"control session cannot listen on tcp/\S+: another program has that port; end"
    ):
        second.open()
    second.close()
