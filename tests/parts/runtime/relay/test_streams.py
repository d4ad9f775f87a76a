"""The handle on the relay: restarts, never blocks its caller, leaves no process behind."""

from __future__ import annotations

import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.events import ProblemReported, RelayChanged
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
from zsched.core.values.relay_protocol import HandleReport, RelayStarted, RelayStop
from zsched.link.pipe.frames import write_frame
from zsched.link.sessions.config import data_config
from zsched.runtime.relay import streams
from zsched.runtime.relay.process import RelayProcess
from zsched.runtime.relay.streams import TOO_LARGE, RelayHandle
from zsched_lab.fleet.relays import hello_of

CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=())


def is_there(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


def handle_of(folder: Path, reports: list[HandleReport], **more: Any) -> RelayHandle:
    given: dict[str, Any] = {"zenoh_config": CONFIG, "on_report": reports.append}
    return RelayHandle(hello=hello_of("test", "robot1"), path=folder / "robot1.relay", **given | more)


class Daemon:
    """What the handle reported."""

    def __init__(self, folder: Path) -> None:
        self.reports: list[HandleReport] = []
        self.handle = handle_of(folder, self.reports)

    def changes(self) -> list[bool]:
        return [report.is_running for report in tuple(self.reports) if isinstance(report, RelayChanged)]


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[Daemon]:
    made = Daemon(tmp_path)
    made.handle.start()
    try:
        until(lambda: made.changes() == [True], "the relay runs")
        yield made
    finally:
        pid = made.handle.pid
        made.handle.stop(2.0)
        assert pid is None or not is_there(pid)


def test_a_plan_that_is_too_large_is_told_until_one_fits(daemon: Daemon) -> None:
    """The problem stood until the relay's next start, beside streams that flowed."""

    def plan(routes: int, task: str = "t") -> RoutePlan:
        key = "k" * 500
        route = Route(stream="t/in/0", direction=Direction.INPUT, from_expr=key, to_expr=key, settings=StreamSettings())
        slot = Slot(epoch=1, owner="edge1", routes=(route,) * routes, ready_when=ReadyWhen.MATCHING)
        return RoutePlan(task=task, phase=RoutePhase.PREPARE, current=slot)

    def told() -> list[str | None]:
        found = [one for one in tuple(daemon.reports) if isinstance(one, ProblemReported)]
        return [one.problem for one in found if one.source == TOO_LARGE]

    daemon.handle.apply(plan(2000))
    until(lambda: len(told()) == 1, "the problem")
    assert "a plan of t is too large" in str(told()[0])
    daemon.handle.apply(plan(1, "other"))
    daemon.handle.apply(plan(1))
    until(lambda: told()[1:] == [None], "its end")


def test_a_killed_relay_is_replaced(daemon: Daemon) -> None:
    pid = daemon.handle.pid
    assert pid is not None
    os.kill(pid, signal.SIGKILL)
    until(lambda: daemon.changes() == [True, False, True], "gone and back")
    assert daemon.handle.pid != pid


def test_a_relay_that_cannot_start_ends_with_its_own_reason(tmp_path: Path) -> None:
    """Also when it leaves plans unread, which resets the pipe."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        endpoint = f"tcp/127.0.0.1:{taken.getsockname()[1]}"
        config = data_config(listen=(endpoint,), connect=())
        reports: list[HandleReport] = []
        handle = handle_of(tmp_path, reports, zenoh_config=config)
        handle.set_role(Role(task="t", role=WorkerRole.ACTIVE, epoch=1))
        handle.start()
        try:
            until(lambda: sum(isinstance(report, RelayChanged) for report in reports) >= 2, "two in vain")
        finally:
            handle.stop(2.0)
    ends = [report for report in reports if isinstance(report, RelayChanged)]
    assert all(f"cannot listen on {endpoint}" in end.reason and not end.is_running for end in ends)


def test_a_relay_that_ends_by_itself_is_reported_with_its_exit_code(daemon: Daemon) -> None:
    """What it complained of while it worked is not why it ended."""
    os.kill(daemon.handle.pid or 0, signal.SIGKILL)
    until(lambda: daemon.changes()[:2] == [True, False], "gone")
    ends = [r for r in daemon.reports if isinstance(r, RelayChanged) and not r.is_running]
    assert ends[0].reason == "exit code -9"


def test_a_wedged_relay_is_replaced(daemon: Daemon) -> None:
    os.kill(daemon.handle.pid or 0, signal.SIGSTOP)
    until(lambda: daemon.changes() == [True, False, True], "wedged, killed and back")
    assert any(isinstance(r, RelayChanged) and "no sign of life" in r.reason for r in daemon.reports)


SILENT = """#!{python}
import os, sys, time
sys.path[:0] = {path!r}
from pathlib import Path
from zsched.core.values import codec as wire
from zsched.core.values.relay_protocol import RelayStarted
from zsched.link.pipe.frames import write_frame
from zsched.relay.visits import Visits
link = Visits(Path(sys.argv[-1])).next_daemon(60).link
while True:
    write_frame(link.fileno(), wire.encode(RelayStarted(pid=os.getpid(), zid="1")))
    end = time.monotonic() + 3.0
    while time.monotonic() < end:
        {deed}
"""


@pytest.mark.parametrize(("deed", "is_replaced"), [("pass", False), ("time.sleep(0.5)", True)], ids=["busy", "asleep"])
def test_only_a_silent_relay_that_wants_no_processor_is_wedged(tmp_path: Path, deed: str, *, is_replaced: bool) -> None:
    """A process in the relay's place says a word every 3 s, where 1.5 s of silence are too long."""
    program = tmp_path / "silent"
    program.write_text(SILENT.format(python=sys.executable, path=sys.path, deed=deed))
    program.chmod(0o755)
    reports: list[HandleReport] = []
    handle = handle_of(tmp_path, reports, python=str(program))
    handle.start()
    try:
        until(lambda: sum(isinstance(report, RelayChanged) for report in reports) >= 2, "it speaks again, or is gone")
        changes = [report for report in reports if isinstance(report, RelayChanged)]
        assert changes[1].is_running is not is_replaced
    finally:
        handle.stop(0.5)


def test_a_report_of_an_unknown_kind_is_passed_over(tmp_path: Path) -> None:
    """A relay that was started after the program's files were replaced is newer than its daemon."""
    ours, theirs = socket.socketpair()
    reports: list[HandleReport] = []
    handle = handle_of(tmp_path, reports)
    for frame in (wire.encode(RelayStop()), wire.encode(RelayStarted(pid=7, zid="1"))):
        write_frame(theirs.fileno(), frame)
    theirs.close()
    relay = RelayProcess(os.getpid(), ours)
    assert handle._listen(relay) == ""
    assert [type(report).__name__ for report in reports] == ["RelayChanged", "RelayStarted"]
    relay.close()


def test_a_relay_that_is_wedged_before_its_first_word_is_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(streams, "START_S", 0.5)
    reports: list[HandleReport] = []
    handle = handle_of(tmp_path, reports)
    handle.start()
    try:
        os.kill(until(lambda: handle.pid, "a process"), signal.SIGSTOP)
        until(lambda: any(isinstance(r, RelayChanged) and r.is_running for r in reports), "another one runs")
        assert any(isinstance(r, RelayChanged) and "no sign of life" in r.reason for r in reports)
    finally:
        handle.stop(2.0)


RELAY = """#!{python}
import os, runpy, sys, time
sys.path[:0] = {path!r}
{deed}
sys.argv[1:4] = []
runpy.run_module("zsched.relay", run_name="__main__", alter_sys=True)
"""
SUSPENDED = """
real, began = time.clock_gettime, time.monotonic()
def now(clock):
    slept = 60.0 * ((time.monotonic() - began) // 0.7) if clock == time.CLOCK_BOOTTIME else 0.0
    return real(clock) + slept
time.clock_gettime = now
"""
SLOW_TO_OPEN = """
import zenoh
real = zenoh.open
def late(config):
    time.sleep(3.0)
    return real(config)
zenoh.open = late
"""


def changes_with(folder: Path, deed: str, seconds: float) -> list[RelayChanged]:
    """What is heard of a relay whose process does ``deed`` first, until so long after it runs."""
    program = folder / "program"
    program.write_text(RELAY.format(python=sys.executable, path=sys.path, deed=deed))
    program.chmod(0o755)
    reports: list[HandleReport] = []
    handle = handle_of(folder, reports, python=str(program))
    handle.start()
    try:
        until(lambda: any(isinstance(report, RelayChanged) for report in reports), "it runs, or is replaced")
        threading.Event().wait(seconds)
    finally:
        handle.stop(2.0)
    return [report for report in reports if isinstance(report, RelayChanged)]


def test_a_healthy_relay_stays_when_its_machine_was_suspended(tmp_path: Path) -> None:
    """Boot time is a minute later every 0.7 s, as the kernel shows it after a suspend; all else goes on."""
    assert [one.is_running for one in changes_with(tmp_path, SUSPENDED, 5.0)] == [True]


def test_a_relay_whose_session_opens_slowly_is_not_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "STILL_S", 1.0)
    assert [one.is_running for one in changes_with(tmp_path, SLOW_TO_OPEN, 0.5)] == [True]


def test_a_relay_whose_session_never_opens_is_replaced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "OPEN_S", 1.0)
    changes = changes_with(tmp_path, SLOW_TO_OPEN.replace("3.0", "60.0"), 0.0)
    assert "its session does not open" in changes[0].reason


def test_a_handle_that_fails_replaces_the_relay_and_goes_on(tmp_path: Path) -> None:
    """Whatever the daemon's own side raises, its streams have a relay again, and it is told."""
    reports: list[HandleReport] = []

    def take(report: HandleReport) -> None:
        if isinstance(report, RelayStarted) and not any(isinstance(one, RelayStarted) for one in reports):
            reports.append(report)
            raise RuntimeError("a bug")
        reports.append(report)

    handle = handle_of(tmp_path, reports, on_report=take)
    handle.start()
    try:
        until(lambda: sum(isinstance(one, RelayStarted) for one in reports) == 2, "another relay")
    finally:
        handle.stop(2.0)
    ends = [one.reason for one in reports if isinstance(one, RelayChanged) and not one.is_running]
    assert ends == ["its handle failed: RuntimeError('a bug')"]


def test_a_stopped_relay_never_blocks_the_daemon(daemon: Daemon) -> None:
    pid = daemon.handle.pid
    assert pid is not None
    os.kill(pid, signal.SIGSTOP)
    started = time.monotonic()
    for epoch in range(20_000):
        daemon.handle.set_role(Role(task=f"t{epoch % 50}", role=WorkerRole.ACTIVE, epoch=epoch))
    daemon.handle.stop(0.5)
    assert time.monotonic() - started < 60.0
    assert not is_there(pid)
