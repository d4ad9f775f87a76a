"""The relay as a process: how it starts, speaks, dies and comes back."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from support.relay_rig import FLEET, TASK, relay_rig
from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.events import ProblemReported, StreamsCounted
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Role,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamSettings,
    WorkerRole,
)
from zsched.core.values.relay_protocol import RelayStarted, RelayStop, TaskEnded
from zsched.link.keyspace import Keyspace
from zsched.link.pipe.frames import REPORTS, read_frame, set_timeout, write_frame
from zsched.link.pipe.protocol import RelayHere, RelayPulse
from zsched.link.pipe.relay_socket import ask_relay, dial
from zsched.link.sessions.config import data_config
from zsched_lab.fleet.relays import hello_of

ROUTE = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="robot1/in",
    to_expr="edge1/in",
    settings=StreamSettings(),
)
CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=())
END_S = 5.0
"""A relay ends itself within a second; a busy machine may need longer to let it."""


@dataclass
class Relay:
    """A relay's process, and the link to it once it has been greeted."""

    process: subprocess.Popen[bytes]
    path: Path
    link: socket.socket | None = None

    def begin(self, config: str = CONFIG) -> int:
        """Greet it; the link's descriptor."""
        link: socket.socket = until(lambda: dial(self.path), "it listens")
        self.link = link
        set_timeout(link, 0.0)
        for frame in (wire.encode(hello_of(FLEET, "robot1")), config.encode()):
            write_frame(link.fileno(), frame)
        answer = read_frame(link.fileno())
        assert answer is not None
        wire.decode(answer, RelayHere)
        return link.fileno()


@pytest.fixture
def relay(tmp_path: Path) -> Iterator[Relay]:
    path = tmp_path / "relay"
    made = Relay(subprocess.Popen([sys.executable, "-m", "zsched.relay", "--socket", str(path)]), path)
    try:
        yield made
    finally:
        made.process.kill()
        made.process.wait(60)
        if made.link is not None:
            made.link.close()


def next_word(descriptor: int) -> Any:
    frame = read_frame(descriptor)
    assert frame is not None
    return wire.decode(frame, *REPORTS)


def next_report(descriptor: int) -> Any:
    """The next word that says more than that the relay lives."""
    while isinstance(word := next_word(descriptor), RelayPulse):
        pass
    return word


def test_it_says_that_it_started_and_counts_every_second(relay: Relay) -> None:
    reports = relay.begin()
    started = next_report(reports)
    assert isinstance(started, RelayStarted)
    assert started.pid == relay.process.pid
    assert isinstance(next_report(reports), StreamsCounted)


def test_it_gives_a_sign_of_life_between_its_counts(relay: Relay) -> None:
    reports = relay.begin()
    words = [next_word(reports) for _ in range(5)]
    ages = [word.counted_s for word in words if isinstance(word, RelayPulse)]
    assert ages
    assert all(age < 5.0 for age in ages)


def test_it_ends_when_told(relay: Relay) -> None:
    link = relay.begin()
    next_report(link)
    write_frame(link, wire.encode(RelayStop()))
    assert relay.process.wait(END_S) == 0
    assert not relay.path.exists()


@pytest.mark.parametrize("has_daemon", [False, True])
def test_a_sigterm_ends_it(relay: Relay, *, has_daemon: bool) -> None:
    if has_daemon:
        next_report(relay.begin())
    else:
        until(lambda: ask_relay(relay.path), "it answers")
    relay.process.send_signal(signal.SIGTERM)
    assert relay.process.wait(END_S) == 0
    assert not relay.path.exists()


def test_ctrl_c_on_the_terminal_is_the_daemons_business(relay: Relay) -> None:
    reports = relay.begin()
    next_report(reports)
    relay.process.send_signal(signal.SIGINT)
    assert isinstance(next_report(reports), StreamsCounted)


def test_a_port_that_is_taken_is_a_problem_in_words(relay: Relay) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        config = data_config(listen=(f"tcp/127.0.0.1:{port}",), connect=())
        reports = relay.begin(config)
        problem = next_report(reports)
    assert isinstance(problem, ProblemReported)
    assert f"cannot listen on tcp/127.0.0.1:{port}: another program has that port" in str(problem.problem)
    assert relay.process.wait(60) == 1


def test_garbage_and_bad_plans_are_reported_and_survived(relay: Relay) -> None:
    commands = reports = relay.begin()
    next_report(reports)
    write_frame(commands, b"garbage")
    bad = Slot(epoch=1, owner="edge1", routes=(replace(ROUTE, to_expr="edge1/*/in"),), ready_when=ReadyWhen.TOKEN)
    write_frame(commands, wire.encode(RoutePlan(task="t", phase=RoutePhase.PREPARE, current=bad)))
    said = [next_report(reports) for _ in range(3)]
    problems = [str(report.problem) for report in said if isinstance(report, ProblemReported)]
    assert any("unreadable command" in problem for problem in problems)
    assert any("more wildcards" in problem for problem in problems)


def test_what_a_plan_could_not_open_is_over_with_the_next_one_that_opens_whole(
    relay: Relay,
) -> None:
    """The operator mends the template: the problem stayed in the status until the daemon began again."""
    commands = reports = relay.begin()
    next_report(reports)
    bad, other = replace(ROUTE, to_expr="edge1/*/in"), replace(ROUTE, to_expr="edge1/*/*/in")
    told: list[str] = []
    for epoch, route in ((1, bad), (1, bad), (2, other), (3, ROUTE), (3, bad)):
        slot = Slot(epoch=epoch, owner="edge1", routes=(route,), ready_when=ReadyWhen.TOKEN)
        write_frame(commands, wire.encode(RoutePlan(task="t", phase=RoutePhase.PREPARE, current=slot)))
    write_frame(commands, wire.encode(TaskEnded(task="t")))
    while len(told) < 5:
        report = next_report(reports)
        if isinstance(report, ProblemReported):
            assert report.source == "relay/t"
            told.append("" if report.problem is None else report.problem.partition(": ")[2].partition(":")[0])
    assert told == ["robot1/in -> edge1/*/in", "robot1/in -> edge1/*/*/in", "", "robot1/in -> edge1/*/in", ""]


def test_a_role_whose_token_goes_is_told_again_by_the_relay(tmp_path: Path) -> None:
    """The worker has been told something else, or has lost its link for a while: its daemon's word still holds."""
    key = Keyspace(FLEET).role("edge1", TASK)
    told: list[Role] = []
    with relay_rig(tmp_path) as rig:
        watch = rig.app.declare_subscriber(
            key, lambda sample: told.append(wire.decode(sample.payload.to_bytes(), Role))
        )
        worker = rig.start_worker("edge1")

        def is_heard() -> bool:
            rig.role("edge1", WorkerRole.ACTIVE, 1)
            return bool(told)

        def works() -> bool:
            return any(reply.ok is not None for reply in rig.app.liveliness().get(f"{key}/2"))

        def is_told_again() -> bool:
            nonlocal worker
            until(works, "the token of the role")
            until(lambda: told and told[-1].epoch == 2, "the role, behind all that was put before")
            told.clear()
            worker.kill()
            with contextlib.suppress(AssertionError):
                until(lambda: told, "the role again", 10)
                return True
            worker = rig.start_worker("edge1")  # the relay may have heard of the token when it was gone already
            return False

        until(is_heard, "a put under the role's key")
        rig.role("edge1", WorkerRole.ACTIVE, 2)
        until(is_told_again, "the role again")
        assert told == [Role(task=TASK, role=WorkerRole.ACTIVE, epoch=2)]
        watch.undeclare()
