"""The relay as a process: how it starts, speaks, dies and comes back."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from zsched import wire
from zsched.adapters import streams
from zsched.adapters.streams import RelayHandle
from zsched.core.events import ProblemReported, RelayChanged, StreamsCounted
from zsched.core.plan import (
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
from zsched.core.relay_protocol import HandleReport, RelayStarted, RelayStop
from zsched.relay_pipe import REPORTS, read_frame, write_frame
from zsched.zenoh_config import data_config

CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=())


def until(condition: Callable[[], Any], what: str, deadline_s: float = 10.0) -> Any:
    end = time.monotonic() + deadline_s
    while time.monotonic() < end:
        value = condition()
        if value:
            return value
        time.sleep(0.005)
    raise AssertionError(f"not within {deadline_s} s: {what}")


def is_there(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.fixture
def process() -> Iterator[subprocess.Popen[bytes]]:
    command = [sys.executable, "-m", "zsched.relay", "--fleet", "test", "--node", "robot1"]
    child = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0)
    try:
        yield child
    finally:
        child.kill()
        child.wait(5)
        for pipe in (child.stdin, child.stdout):
            if pipe is not None:
                pipe.close()


def begin(child: subprocess.Popen[bytes], config: str = CONFIG) -> tuple[int, int]:
    assert child.stdin is not None
    assert child.stdout is not None
    write_frame(child.stdin.fileno(), config.encode())
    return child.stdin.fileno(), child.stdout.fileno()


def next_report(descriptor: int) -> Any:
    frame = read_frame(descriptor)
    assert frame is not None
    return wire.decode(frame, *REPORTS)


def test_it_says_that_it_started_and_counts_every_second(process: subprocess.Popen[bytes]) -> None:
    _, reports = begin(process)
    started = next_report(reports)
    assert isinstance(started, RelayStarted)
    assert started.pid == process.pid
    assert isinstance(next_report(reports), StreamsCounted)


def test_it_ends_within_a_second_when_the_pipe_ends(process: subprocess.Popen[bytes]) -> None:
    _, reports = begin(process)
    next_report(reports)
    assert process.stdin is not None
    process.stdin.close()
    assert process.wait(1.0) == 0


@pytest.mark.parametrize("how", ["stop", "sigterm"])
def test_it_ends_within_a_second_when_told(process: subprocess.Popen[bytes], how: str) -> None:
    commands, reports = begin(process)
    next_report(reports)
    if how == "stop":
        write_frame(commands, wire.encode(RelayStop()))
    else:
        process.send_signal(signal.SIGTERM)
    assert process.wait(1.0) == 0


def test_ctrl_c_on_the_terminal_is_the_daemons_business(process: subprocess.Popen[bytes]) -> None:
    _, reports = begin(process)
    next_report(reports)
    process.send_signal(signal.SIGINT)
    assert isinstance(next_report(reports), StreamsCounted)


def test_a_port_that_is_taken_is_a_problem_in_words(process: subprocess.Popen[bytes]) -> None:
    import socket

    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        config = data_config(listen=(f"tcp/127.0.0.1:{taken.getsockname()[1]}",), connect=())
        _, reports = begin(process, config)
        problem = next_report(reports)
    assert isinstance(problem, ProblemReported)
    assert "cannot be opened" in str(problem.problem)
    assert process.wait(5) == 1


def test_garbage_and_bad_plans_are_reported_and_survived(process: subprocess.Popen[bytes]) -> None:
    commands, reports = begin(process)
    next_report(reports)
    write_frame(commands, b"garbage")
    route = Route(
        stream="t/in/0",
        direction=Direction.INPUT,
        from_expr="robot1/in",
        to_expr="edge1/*/in",
        settings=StreamSettings(),
    )
    bad = Slot(epoch=1, owner="edge1", routes=(route,), ready_when=ReadyWhen.TOKEN)
    write_frame(commands, wire.encode(RoutePlan(task="t", phase=RoutePhase.PREPARE, current=bad)))
    said = [next_report(reports) for _ in range(3)]
    problems = [str(report.problem) for report in said if isinstance(report, ProblemReported)]
    assert any("unreadable command" in problem for problem in problems)
    assert any("more wildcards" in problem for problem in problems)


# --- the handle ------------------------------------------------------------------------------------------------------


class Daemon:
    """What the handle reported."""

    def __init__(self) -> None:
        self.reports: list[HandleReport] = []
        self.handle = RelayHandle(fleet="test", node="robot1", zenoh_config=CONFIG, on_report=self.reports.append)

    def changes(self) -> list[bool]:
        return [report.is_running for report in tuple(self.reports) if isinstance(report, RelayChanged)]


@pytest.fixture
def daemon() -> Iterator[Daemon]:
    made = Daemon()
    made.handle.start()
    try:
        until(lambda: made.changes() == [True], "the relay runs")
        yield made
    finally:
        pid = made.handle.pid
        made.handle.stop(2.0)
        assert pid is None or not is_there(pid)


def test_a_killed_relay_is_replaced(daemon: Daemon) -> None:
    pid = daemon.handle.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    until(lambda: daemon.changes() == [True, False, True], "gone and back")
    assert daemon.handle.pid != pid


def test_a_wedged_relay_is_replaced(monkeypatch: pytest.MonkeyPatch, daemon: Daemon) -> None:
    monkeypatch.setattr(streams, "SILENCE_S", 1.5)
    os.kill(daemon.handle.pid or 0, signal.SIGKILL)  # the next one is watched with the short patience
    until(lambda: daemon.changes() == [True, False, True], "gone and back")
    os.kill(daemon.handle.pid or 0, signal.SIGSTOP)
    until(lambda: daemon.changes() == [True, False, True, False, True], "wedged, killed and back")
    assert any(isinstance(r, RelayChanged) and "no sign of life" in r.reason for r in daemon.reports)


def test_a_stopped_relay_never_blocks_the_daemon(daemon: Daemon) -> None:
    pid = daemon.handle.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    started = time.monotonic()
    for epoch in range(20_000):
        daemon.handle.set_role(Role(task=f"t{epoch % 50}", role=WorkerRole.ACTIVE, epoch=epoch))
    assert time.monotonic() - started < 2.0
    started = time.monotonic()
    daemon.handle.stop(0.5)
    assert time.monotonic() - started < 2.0
    assert not is_there(pid)


def test_the_relay_dies_with_its_daemon() -> None:
    script = (
        "import sys, time\n"
        "from zsched.adapters.streams import RelayHandle\n"
        "handle = RelayHandle(fleet='test', node='robot1', zenoh_config=sys.argv[1], on_report=lambda r: None)\n"
        "handle.start()\n"
        "while handle.pid is None: time.sleep(0.01)\n"
        "print(handle.pid, flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", script, CONFIG], stdout=subprocess.PIPE)
    try:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        time.sleep(0.3)
        assert is_there(pid)
    finally:
        parent.kill()
        parent.wait(5)
        if parent.stdout is not None:
            parent.stdout.close()
    until(lambda: not is_there(pid), "the relay is gone too", deadline_s=2.0)
