"""A relay outlives its daemon for a while, and the next daemon connects to it: the right one, and only one."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import zsched
from support.waiting import until
from zsched.core.values import codec as wire
from zsched.core.values.events import ProblemReported, RelayChanged, StreamsCounted
from zsched.core.values.plan import RoutePhase, RoutePlan
from zsched.core.values.relay_protocol import HandleReport
from zsched.link.pipe.frames import read_frame, write_frame
from zsched.link.pipe.protocol import RelayHere, RelayRefused
from zsched.link.pipe.relay_socket import GREETING_S, PROTOCOL, ask_relay, relay_pid
from zsched.link.sessions.config import data_config
from zsched.runtime.relay import silence as relay_silence
from zsched.runtime.relay.streams import RelayHandle
from zsched_lab.fleet.relays import hello_of

CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=(), shared_memory=False)
OTHER_CONFIG = data_config(listen=("tcp/127.0.0.1:0",), connect=("tcp/127.0.0.1:1",), shared_memory=False)

FIRST_DAEMON = """
import sys, time
from pathlib import Path
from zsched.runtime.relay.streams import RelayHandle
from zsched.core.values.relay_protocol import RelayStarted
from zsched.link.pipe.protocol import RelayHello
from zsched.link.pipe.relay_socket import PROTOCOL
config, path = sys.argv[1], Path(sys.argv[2])
hello = RelayHello(protocol=PROTOCOL, fleet="test", node="robot1", threads=6, listen="tcp/h:1")
started = []
handle = RelayHandle(
    hello=hello, path=path, zenoh_config=config,
    on_report=lambda report: started.append(report) if isinstance(report, RelayStarted) else None,
)
handle.start()
while not started: time.sleep(0.005)
print(started[0].pid, started[0].zid, flush=True)
sys.stdin.readline()
handle.leave()
print("left", flush=True)
"""


def path_in(folder: Path) -> Path:
    return folder / "robot1.relay"


def is_there(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except FileNotFoundError:
        return False


class First:
    """A daemon in a process of its own; its relay is left to the test."""

    def __init__(self, folder: Path, package: Path | None = None) -> None:
        """``package``: where the code is that it runs, when not this one's."""
        env = os.environ if package is None else os.environ | {"PYTHONPATH": str(package)}
        command = [sys.executable, "-c", FIRST_DAEMON, CONFIG, str(path_in(folder))]
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
        self.reports: list[HandleReport] = []
        self.handle = RelayHandle(
            hello=hello_of(fleet, "robot1", **changes),
            path=path_in(folder),
            zenoh_config=config,
            on_report=self.reports.append,
        )
        self.handle.start()
        until(lambda: any(one.is_running for one in self.changes()), "a relay")

    def changes(self) -> list[RelayChanged]:
        return [report for report in tuple(self.reports) if isinstance(report, RelayChanged)]


@pytest.fixture
def first(tmp_path: Path) -> Iterator[First]:
    made = First(tmp_path)
    try:
        yield made
    finally:
        made.close()


@pytest.mark.parametrize("end", [First.crash, First.leave], ids=["crashed", "restarted"])
def test_the_next_daemon_goes_on_with_the_relay(first: First, tmp_path: Path, end: Callable[[First], None]) -> None:
    end(first)
    second = Second(tmp_path)
    try:
        assert second.handle.pid == first.relay
        assert [one.is_running for one in second.changes()] == [True]
        until(lambda: first.zid in str(second.reports), "its session is the very same")
    finally:
        second.handle.stop(2.0)
    assert not is_there(first.relay)
    assert relay_pid(path_in(tmp_path)) is None
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ({"fleet": "other"}, "it is other/robot1, this is the relay of test/robot1"),
        ({"threads": 7}, "7 threads are needed, this relay has 6"),
        ({"addresses": ("192.0.2.1",)}, "the host's own side, or its addresses"),
        ({"config": OTHER_CONFIG}, "its data session is another one"),
        ({"certificate": "renewed"}, "its data session is another one"),
        ({"protocol": PROTOCOL + 1}, f"its protocol is {PROTOCOL + 1}, this relay's is {PROTOCOL}"),
    ],
    ids=["foreign fleet", "more threads", "addresses", "sessions", "certificate", "protocol"],
)
def test_a_relay_that_is_not_the_one_that_is_needed_is_replaced_never_doubled(
    first: First, tmp_path: Path, other: dict[str, Any], why: str
) -> None:
    """By a relay of its own version in the last case, too, which has the same protocol as this test's."""
    first.crash()
    changes = dict(other)
    if changes.pop("protocol", None):
        answer = said_to(tmp_path, wire.encode(hello_of("test", "robot1", **other)), CONFIG.encode())
        assert answer == RelayRefused(reason=why)
        until(lambda: not is_there(first.relay), "it has ended")
    second = Second(tmp_path, **changes)
    try:
        assert second.handle.pid != first.relay
        assert not is_there(first.relay)
        assert relay_pid(path_in(tmp_path)) == second.handle.pid
        if changes:
            assert why in second.changes()[0].reason
    finally:
        second.handle.stop(2.0)


def said_to(folder: Path, *frames: bytes) -> Any:
    """What the relay answers to these."""
    with socket.socket(socket.AF_UNIX) as link:
        link.connect(str(path_in(folder)))
        with contextlib.suppress(BrokenPipeError):  # it may have answered the first one
            for frame in frames:
                write_frame(link.fileno(), frame)
        answer = read_frame(link.fileno())
    return None if answer is None else wire.decode(answer, RelayHere, RelayRefused)


OTHER_CODE = ("relay/task.py", "", "# a line more\n")
OTHER_PROTOCOL = ("link/pipe/relay_socket.py", f"PROTOCOL: Final = {PROTOCOL}\n", f"PROTOCOL: Final = {PROTOCOL - 1}\n")


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
        here = ask_relay(path_in(run))
        assert here == RelayHere(version="0+older", listen="tcp/h:1"), "who asks learns of what version it is"
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
        assert [one.is_running for one in second.changes()] == ([True] if stays else [False, True])
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


def test_an_orphan_obeys_sigterm_at_once(first: First, tmp_path: Path) -> None:
    first.crash()
    os.kill(first.relay, signal.SIGTERM)
    until(lambda: not is_there(first.relay), "the orphan has ended")
    assert list(tmp_path.iterdir()) == []


def test_a_daemon_that_stops_takes_its_relay_with_it(tmp_path: Path) -> None:
    second = Second(tmp_path)
    pid = second.handle.pid
    assert pid is not None
    second.handle.stop(2.0)
    assert not is_there(pid)


def test_a_relay_with_a_daemon_lets_no_other_in(first: First, tmp_path: Path) -> None:
    greeting = (wire.encode(hello_of("test", "robot1")), CONFIG.encode())
    assert said_to(tmp_path, *greeting) == RelayRefused(reason="it has a daemon")
    assert ask_relay(path_in(tmp_path)) is not None, "who only asks is answered"
    assert is_there(first.relay)
    first.crash()
    assert isinstance(said_to(tmp_path, *greeting), RelayHere), "the same is welcome once the daemon is gone"


def test_who_only_looks_or_says_nothing_is_survived(first: First, tmp_path: Path) -> None:
    first.crash()
    for _ in range(100):
        assert relay_pid(path_in(tmp_path)) == first.relay
    with socket.socket(socket.AF_UNIX) as silent:
        silent.connect(str(path_in(tmp_path)))
        second = Second(tmp_path)
    try:
        assert second.handle.pid == first.relay
    finally:
        second.handle.stop(2.0)


def test_words_of_another_time_mean_another_relay(first: First, tmp_path: Path) -> None:
    """A greeting that it cannot read is a daemon's of another protocol."""
    first.crash()
    answer = said_to(tmp_path, b"garbage")
    assert isinstance(answer, RelayRefused)
    until(lambda: not is_there(first.relay), "it has ended")
