"""A relay outlives its daemon for a while, and the next daemon takes it over: the right one, and only one."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import zsched
from support.waiting import until
from zsched.adapters.relay import silence as relay_silence
from zsched.adapters.relay.child import RelayChild
from zsched.adapters.relay.streams import Bequest, RelayHandle
from zsched.core.events import ProblemReported, RelayChanged, StreamsCounted
from zsched.core.relay_protocol import HandleReport
from zsched.core.values.plan import RoutePhase, RoutePlan
from zsched.ipc.pipe import read_frame, write_frame
from zsched.ipc.protocol import RelayHello
from zsched.ipc.takeover import GREETING_S, PROTOCOL, Door, digest_of
from zsched.sessions.config import data_config
from zsched.wire import codec as wire

CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=(), shared_memory=False)
OTHER_CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=("tcp/127.0.0.1:1",), shared_memory=False)
ORPHAN_S = 5.0

FIRST_DAEMON = """
import sys, time
from pathlib import Path
from zsched.adapters.relay.streams import Bequest, RelayHandle
from zsched.core.relay_protocol import RelayStarted
from zsched.ipc.takeover import Door
config, folder, orphan_s = sys.argv[1], Path(sys.argv[2]), float(sys.argv[3])
bequest = Bequest(door=Door(folder, "robot1"), orphan_s=orphan_s, incarnation=7, digest="fleet", listen="tcp/h:1")
started = []
handle = RelayHandle(
    fleet="test", node="robot1", zenoh_config=config, bequest=bequest,
    on_report=lambda report: started.append(report) if isinstance(report, RelayStarted) else None,
)
handle.start()
while not started: time.sleep(0.005)
print(started[0].pid, started[0].zid, flush=True)
sys.stdin.readline()
handle.leave()
print("left", flush=True)
"""


def is_there(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


class First:
    """A daemon in a process of its own; its relay is left to the test."""

    def __init__(self, folder: Path, orphan_s: float = ORPHAN_S, package: Path | None = None) -> None:
        """``package``: where the code is that it runs, when not this one's."""
        env = os.environ if package is None else os.environ | {"PYTHONPATH": str(package)}
        command = [sys.executable, "-c", FIRST_DAEMON, CONFIG, str(folder), str(orphan_s)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=package, env=env
        )
        assert self.process.stdout is not None
        pid, self.zid = self.process.stdout.readline().split()
        self.relay = int(pid)

    def crash(self) -> None:
        self.process.kill()
        self.process.wait(60)

    def leave(self) -> None:
        said, _ = self.process.communicate("\n", timeout=60)
        assert "left" in said

    def close(self) -> None:
        self.crash()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                pipe.close()
        if is_there(self.relay):
            os.kill(self.relay, signal.SIGKILL)


class Second:
    """The next daemon of a node, in this process."""

    def __init__(self, folder: Path, *, config: str = CONFIG, fleet: str = "test", **changes: Any) -> None:
        bequest = Bequest(door=Door(folder, "robot1"), orphan_s=ORPHAN_S, incarnation=8, digest="fleet")
        self.reports: list[HandleReport] = []
        self.handle = RelayHandle(
            fleet=fleet,
            node="robot1",
            zenoh_config=config,
            on_report=self.reports.append,
            bequest=replace(bequest, **changes),
        )
        self.handle.start()
        until(lambda: any(isinstance(report, RelayChanged) for report in self.reports), "a relay")


@pytest.fixture
def first(tmp_path: Path) -> Iterator[First]:
    made = First(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.mark.parametrize("end", [First.crash, First.leave], ids=["crashed", "restarted"])
def test_the_next_daemon_takes_the_relay_over(first: First, tmp_path: Path, end: Callable[[First], None]) -> None:
    end(first)
    second = Second(tmp_path)
    try:
        assert second.handle.pid == first.relay
        assert [report.is_running for report in second.reports if isinstance(report, RelayChanged)] == [True]
        until(lambda: first.zid in str(second.reports), "its session is the very same")
    finally:
        second.handle.stop(2.0)
    assert not is_there(first.relay)
    assert Door(tmp_path, "robot1").note() is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    "other",
    [{"fleet": "other"}, {"incarnation": 7}, {"digest": "another fleet file"}, {"config": OTHER_CONFIG}],
    ids=["foreign fleet", "stale daemon", "changed fleet file", "other sessions"],
)
def test_a_relay_that_is_not_ours_is_replaced_never_doubled(
    first: First, tmp_path: Path, other: dict[str, Any]
) -> None:
    first.crash()
    second = Second(tmp_path, **other)
    try:
        assert second.handle.pid != first.relay
        assert not is_there(first.relay)
        note = Door(tmp_path, "robot1").note()
        assert note is not None
        assert note.pid == second.handle.pid
    finally:
        second.handle.stop(2.0)


def test_a_relay_that_is_replaced_carries_on_until_the_next_one_is_ready(
    first: First, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So the host's applications are without one for a moment only."""
    seen: list[tuple[bool, bool]] = []
    followers: list[RelayChild] = []
    end, speaks = RelayChild.end, RelayChild.speaks

    def speaking(child: RelayChild, timeout_s: float) -> bool:
        followers.append(child)
        return speaks(child, timeout_s)

    def ending(child: RelayChild, timeout_s: float) -> None:
        seen.append((is_there(first.relay), bool(followers) and speaks(followers[0], 0.0)))
        end(child, timeout_s)

    monkeypatch.setattr(RelayChild, "speaks", speaking)
    monkeypatch.setattr(RelayChild, "end", ending)
    first.crash()
    second = Second(tmp_path, digest="another fleet file")
    try:
        assert seen == [(True, True)], "it is there, and the next one has said its first word"
        assert second.handle.pid == followers[0].pid
        assert not is_there(first.relay)
    finally:
        second.handle.stop(2.0)
    assert list(tmp_path.iterdir()) == []


OTHER_CODE = ("relay/task.py", "", "# a line more\n")
OTHER_PROTOCOL = ("ipc/takeover.py", f"PROTOCOL: Final = {PROTOCOL}\n", f"PROTOCOL: Final = {PROTOCOL - 1}\n")


@pytest.fixture
def older(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[First]:
    """A daemon of another version, whose files are gone when it has crashed: a text of one of them is another one."""
    package = Path(zsched.__file__).parent
    copy = shutil.copytree(package, tmp_path / "code" / "zsched", ignore=shutil.ignore_patterns("__pycache__"))
    name, before, after = request.param
    text = (copy / name).read_text()
    (copy / name).write_text(text.replace(before, after, 1) if before else text + after)
    assert (copy / name).read_text() != text
    (copy / "_version.py").write_text('__version__ = "0+older"\n')
    run = tmp_path / "run"
    run.mkdir()
    first = First(run, package=tmp_path / "code")
    try:
        note = Door(run, "robot1").note()
        assert note is not None
        assert note.version == "0+older", "who asks learns of what version it is"
        first.crash()
        shutil.rmtree(tmp_path / "code")
        yield first
    finally:
        first.close()


@pytest.mark.parametrize(
    ("older", "stays"), [(OTHER_CODE, True), (OTHER_PROTOCOL, False)], indirect=["older"], ids=["code", "protocol"]
)
def test_a_relay_of_another_version_goes_on_if_its_protocol_is_the_same(
    tmp_path: Path, older: First, *, stays: bool
) -> None:
    """And needs nothing of its version, which an upgrade has taken away by then."""
    second = Second(tmp_path / "run")
    try:
        assert (second.handle.pid == older.relay) is stays
        plan = RoutePlan(task="merge", phase=RoutePhase.CLOSE, current=None)
        second.handle.apply(plan)
        until(lambda: any(isinstance(report, StreamsCounted) for report in second.reports), "it counts streams")
        assert not [one for one in second.reports if isinstance(one, ProblemReported)], second.reports
        assert (second.handle.pid == older.relay) is stays
    finally:
        second.handle.stop(2.0)
    assert list((tmp_path / "run").iterdir()) == []


def test_an_orphan_that_waits_for_a_processor_is_waited_for(
    first: First, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It answers after twice the time in which one that has the processor must."""
    first.crash()
    monkeypatch.setattr(relay_silence, "is_idle", lambda _pid: False)
    os.kill(first.relay, signal.SIGSTOP)
    goes_on = threading.Timer(2.5 * GREETING_S, os.kill, (first.relay, signal.SIGCONT))
    goes_on.start()
    second = Second(tmp_path)
    try:
        assert second.handle.pid == first.relay
    finally:
        goes_on.join(60)
        second.handle.stop(2.0)


def test_a_wedged_orphan_is_replaced(first: First, tmp_path: Path) -> None:
    os.kill(first.relay, signal.SIGSTOP)
    first.crash()
    second = Second(tmp_path)
    try:
        assert second.handle.pid != first.relay
        assert not is_there(first.relay)
    finally:
        second.handle.stop(2.0)


def test_an_orphan_ends_by_itself(tmp_path: Path) -> None:
    first = First(tmp_path, orphan_s=0.5)
    try:
        first.crash()
        assert is_there(first.relay)
        until(lambda: not is_there(first.relay), "the orphan has ended")
    finally:
        first.close()


def test_an_orphan_obeys_sigterm_at_once(first: First, tmp_path: Path) -> None:
    first.crash()
    stranger = RelayHello(fleet="other", node="robot1", incarnation=99, digest="")
    door = Door(tmp_path, "robot1")
    until(lambda: "this is the relay of test/robot1" in str(door.connect(stranger)), "it knows that it is an orphan")
    os.kill(first.relay, signal.SIGTERM)
    until(lambda: not is_there(first.relay), "the orphan has ended")


def test_a_daemon_that_stops_takes_its_relay_with_it(tmp_path: Path) -> None:
    second = Second(tmp_path)
    pid = second.handle.pid
    assert pid is not None
    second.handle.stop(2.0)
    assert not is_there(pid)


def test_a_relay_with_a_daemon_lets_no_other_in(first: First, tmp_path: Path) -> None:
    digest = digest_of("fleet", sys.executable, "")
    hello = RelayHello(fleet="test", node="robot1", incarnation=9, digest=digest, session=digest_of(CONFIG, ""))
    found = Door(tmp_path, "robot1").connect(hello)
    assert isinstance(found, str)
    assert "does not answer" in found
    assert first.process.poll() is None
    first.crash()
    link, here = until(lambda: _taken(tmp_path, hello), "the same is welcome once the daemon is gone")
    assert here.pid == first.relay
    link.close()


def _taken(folder: Path, hello: RelayHello) -> Any:
    found = Door(folder, "robot1").connect(hello)
    return None if isinstance(found, str) else found


def test_garbage_at_the_door_is_refused_and_survived(first: First, tmp_path: Path) -> None:
    first.crash()
    for frame in (b"", b"garbage", wire.encode(RelayHello(fleet="test", node="robot1", incarnation=99, digest=""))):
        with socket.socket(socket.AF_UNIX) as link:
            link.settimeout(3.0)
            link.connect(str(tmp_path / "robot1.relay"))
            link.settimeout(None)
            write_frame(link.fileno(), frame)
            while read_frame(link.fileno()) is not None:
                pass
    second = Second(tmp_path)
    try:
        assert second.handle.pid == first.relay
    finally:
        second.handle.stop(2.0)
