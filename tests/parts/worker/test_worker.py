"""The worker's library against a hand-made relay: real sessions on loopback, one per side."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.hand_relay import INPUT, KEYS, ROLE_KEY, Relay, environment
from support.signals import signal_another_thread, signal_at_once
from support.waiting import free_endpoint, until, within
from zsched.core.values import codec as wire
from zsched.core.values.errors import ConfigError
from zsched.core.values.plan import Role, WorkerRole
from zsched.core.values.relay_protocol import EndMarker, StreamAck, StreamAcks, WorkerTrouble
from zsched.host.clock import monotonic_s
from zsched.host.guard import guarded
from zsched.link.keyspace import END_CHUNK
from zsched.link.pipe.frames import encode_end
from zsched.link.sessions.config import data_config, worker_config
from zsched.worker import Output, Received, Worker
from zsched.worker import backlog as worker_backlog
from zsched.worker import inputs as worker_inputs
from zsched.worker import services as worker_services
from zsched.worker import worker as worker_module
from zsched.worker.backlog import MAX_WITHHELD
from zsched.worker.snapshot import Offer, StateBook
from zsched.worker.troubles import Troubles

PAIRS = 5
"""Of two signals close together that are tried."""


class Echo:
    """A worker in this process that answers every input under its epoch."""

    def __init__(self, worker: Worker, keep_last: int | None = None) -> None:
        self.worker = worker
        self.taken: list[Received] = []
        self.output: Output = worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)
        worker.subscribe("{prefix}/*/in", self._take, keep_last=keep_last)
        worker.ready()

    def _take(self, received: Received) -> None:
        self.taken.append(received)
        self.output.put(received.payload, attachment=received.attachment)

    def payloads(self) -> list[bytes]:
        return [received.payload.to_bytes() for received in self.taken]

    def has_inputs_ended(self, epoch: int) -> bool:
        return self.worker._dispatcher.has_ended(epoch)


@pytest.fixture
def echo(relay: Relay, tmp_path: Path) -> Iterator[Echo]:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        made = Echo(worker)
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        status: Any = relay.publisher.matching_status
        assert status.matching  # the token was declared behind the subscribers
        yield made


def test_it_is_idle_until_told_and_withholds_its_outputs(relay: Relay, echo: Echo) -> None:
    assert echo.worker.prefix == "edge1/t"
    relay.put(b"warm-up")
    until(lambda: echo.payloads() == [b"warm-up"], "the input")
    until(lambda: echo.output.withheld == 1, "the withheld output")
    assert echo.output.put(b"direct") is False
    assert relay.outputs == []


def test_an_owner_stamps_its_epoch_and_says_so(relay: Relay, echo: Echo) -> None:
    relay.tell(WorkerRole.ACTIVE, 7)
    until(lambda: f"{ROLE_KEY}/7" in relay.tokens, "the token of the epoch")
    relay.put(b"x")
    until(lambda: relay.outputs == [("edge1/t/7/robot1/out", b"x")], "the output")
    relay.tell(WorkerRole.IDLE)
    until(lambda: f"{ROLE_KEY}/7" not in relay.tokens, "the token goes")
    assert echo.output.put(b"late") is False


def test_what_was_withheld_is_processed_again_by_the_owner(relay: Relay, echo: Echo) -> None:
    relay.put(b"the last map")
    until(lambda: echo.output.withheld == 1, "the warm-up")
    relay.tell(WorkerRole.ACTIVE, 2)
    until(lambda: relay.outputs == [("edge1/t/2/robot1/out", b"the last map")], "its result")


def test_without_a_lease_an_exclusive_owner_waits_and_then_answers(relay: Relay, echo: Echo) -> None:
    def tell(lease_until_s: float) -> None:
        relay.role = Role(task="t", role=WorkerRole.ACTIVE, epoch=3, lease_until_s=lease_until_s)
        relay.session.put(ROLE_KEY, wire.encode(relay.role))
        until(lambda: echo.worker.role == relay.role, "the role")

    tell(0.0)
    until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "the worker has begun")
    relay.put(b"early")
    until(lambda: echo.output.withheld == 1, "the withheld output")
    time.sleep(0.2)
    assert (len(echo.taken), echo.output.withheld) == (1, 1), "it is not tried again and again"
    tell(monotonic_s() + 5.0)
    until(lambda: relay.outputs == [("edge1/t/3/robot1/out", b"early")], "the output under the lease")


def test_the_end_marker_comes_behind_the_last_output(relay: Relay, echo: Echo) -> None:
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    for number in range(50):
        relay.put(str(number).encode())
    relay.tell(WorkerRole.DRAINING, 4)
    relay.end(4)
    until(lambda: relay.ends, "the end marker")
    assert relay.ends == [(f"edge1/t/4/robot1/out/{END_CHUNK}", EndMarker(epoch=4, count=50))]
    until(lambda: len(relay.outputs) == 50, "every output")
    assert all(b"@zsched" not in received.key.encode() for received in echo.taken)
    assert echo.output.put(b"after the end") is False


def test_an_end_that_overtakes_its_data_waits_for_it(relay: Relay, echo: Echo) -> None:
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.put(b"0")
    until(lambda: len(relay.outputs) == 1, "the first")
    relay.tell(WorkerRole.DRAINING, 4)
    relay.end(4, count=2)
    relay.put(b"1")
    until(lambda: relay.ends, "the end marker")
    assert relay.ends[0][1].count == 2


def test_an_end_whose_data_was_dropped_comes_after_a_grace_time(relay: Relay, echo: Echo) -> None:
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.put(b"0")
    relay.tell(WorkerRole.DRAINING, 4)
    until(lambda: echo.worker.role.role is WorkerRole.DRAINING, "the role")
    relay.end(4, count=9)
    until(lambda: relay.ends, "the end marker all the same")


def test_an_end_marker_ends_nothing_while_the_role_holds(relay: Relay, echo: Echo) -> None:
    """Anybody can put one; where it has only outrun the role, the ends follow with that."""
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.put(b"0")
    until(lambda: len(relay.outputs) == 1, "the first")
    relay.end(4, count=1)
    until(lambda: echo.has_inputs_ended(4), "the inputs to have ended")
    until(lambda: echo.worker._early_end == 4, "the worker to know it")
    assert echo.output.put(b"still the owner")
    assert relay.ends == []
    relay.tell(WorkerRole.DRAINING, 4)
    until(lambda: relay.ends, "the end marker")


def test_draining_sends_what_is_in_work(relay: Relay, echo: Echo) -> None:
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.tell(WorkerRole.DRAINING, 4)
    until(lambda: echo.worker.role.role is WorkerRole.DRAINING, "the role")
    relay.put(b"in work")
    until(lambda: relay.outputs == [("edge1/t/4/robot1/out", b"in work")], "the output")
    relay.end(4)
    until(lambda: relay.ends, "the end marker")


def test_a_late_worker_learns_its_role_at_once(relay: Relay, tmp_path: Path) -> None:
    relay.role = Role(task="t", role=WorkerRole.ACTIVE, epoch=9)
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        until(lambda: worker.role.epoch == 9, "the role")


def test_a_slow_worker_keeps_the_newest(relay: Relay, tmp_path: Path) -> None:
    gate, seen = threading.Event(), list[bytes]()

    def slow(received: Received) -> None:
        seen.append(received.payload.to_bytes())
        gate.wait(60)

    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.subscribe("{prefix}/*/in", slow, keep_last=1)
        worker.ready()
        until(lambda: relay.tokens, "the ready token")
        relay.put(b"0")
        until(lambda: seen == [b"0"], "the first")
        for number in range(1, 10):
            relay.put(str(number).encode())
        time.sleep(0.1)
        gate.set()
        until(lambda: seen[-1] == b"9", "the newest")
        assert len(seen) <= 3


SHEDDING: list[tuple[dict[str, Any], bool, list[int], int]] = [
    ({}, True, list(range(10)), 0),
    ({}, False, [0, 9], 0),
    ({"keep_last": 1}, True, [0, 9], 8),
    ({"keep_last": 3}, True, [0, 7, 8, 9], 6),
    ({"keep_last": None, "depth": 4}, True, [0, 6, 7, 8, 9], 5),
    ({"depth": 4}, True, [0, 6, 7, 8, 9], 5),
    ({"keep_last": None}, False, list(range(10)), 0),
]


@pytest.mark.parametrize(("options", "is_whole", "taken", "lost"), SHEDDING)
def test_what_a_slow_worker_keeps_follows_the_class_and_what_it_sheds_of_a_reliable_input_is_lost(
    relay: Relay, tmp_path: Path, options: dict[str, Any], is_whole: bool, taken: list[int], lost: int
) -> None:
    gate, seen = threading.Event(), list[int]()

    def slow(received: Received) -> None:
        seen.append(int(received.payload.to_bytes()))
        gate.wait(10)

    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.subscribe("{prefix}/*/in", slow, **options)
        worker.ready()
        until(lambda: relay.tokens, "the ready token")
        relay.greet(is_whole=is_whole)
        relay.put(b"0")
        until(lambda: seen == [0], "the first")
        for number in range(1, 10):
            relay.put(str(number).encode())
        until(lambda: len(worker._dispatcher._queue) == 9, "the others have come")
        gate.set()
        until(lambda: relay.acks[-1].processed == 10, "the last is processed")
        until(lambda: relay.acks[-1].lost == lost, f"{lost} lost, {relay.acks[-1]}")
        assert seen == taken


@pytest.mark.parametrize("options", [{"keep_last": 0}, {"keep_last": -1}, {"keep_last": "all"}, {"depth": 0}])
def test_an_input_that_could_keep_nothing_is_refused(relay: Relay, tmp_path: Path, options: dict[str, Any]) -> None:
    with (
        Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker,
        pytest.raises(ValueError, match="is n"),
    ):
        worker.subscribe("{prefix}/*/in", print, **options)


@pytest.mark.parametrize("depth", [0, -1])
def test_a_service_that_nothing_bounds_is_refused(relay: Relay, tmp_path: Path, depth: int) -> None:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        with pytest.raises(ValueError, match=f"depth: {depth} is not 1 or more"):
            worker.serve("{prefix}/*/ask", lambda _request: b"", depth=depth)
        worker.serve("{prefix}/*/ask", lambda _request: b"", depth=1)


def test_without_a_daemon_it_says_how_to_run_by_hand() -> None:
    with pytest.raises(ConfigError, match=r"ZSCHED_NODE.*with --standalone, unset ZSCHED_FLEET$"):
        Worker.from_env({"ZSCHED_FLEET": "test"}, standalone="t")
    with pytest.raises(ConfigError, match=r"unset ZSCHED_FLEET, ZSCHED_TASK$"):
        Worker.from_env({"ZSCHED_FLEET": "test", "ZSCHED_TASK": "t"}, standalone="t")
    with pytest.raises(ConfigError, match=r"ZSCHED_FLEET.*say --standalone"):
        Worker.from_env({"ZSCHED_NODE": "robot1"})
    with pytest.raises(ConfigError, match="zsched up"):
        Worker.from_env({})


@pytest.mark.parametrize("env", [{}, {"ZSCHED_NODE": "robot1"}], ids=["any terminal", "one that asks a fleet"])
def test_by_hand_it_is_the_owner(env: dict[str, str]) -> None:
    """Also in the terminal that `zsched dev` opens, in which the variable says whom verbs ask."""
    with Worker.from_env(env, standalone="t", handles_signals=False) as worker:
        assert (worker.prefix, worker.role.role, worker.role.epoch) == ("local/t", WorkerRole.ACTIVE, 1)
        assert worker.publisher("{prefix}/{epoch}/out", latest=True).put(b"x") is True


def test_what_a_caller_writes_behind_a_put_is_not_what_is_published(relay: Relay, tmp_path: Path) -> None:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        out = worker.publisher("{prefix}/{epoch}/robot1/out", latest=True)
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: worker.role.role is WorkerRole.ACTIVE, "the role")
        assert out._queue is not None
        gate = threading.Event()
        out._queue.then(partial(_wait, gate))
        payload = bytearray(b"one")
        assert out.put(payload)
        payload[:] = b"two"
        gate.set()
        until(lambda: relay.outputs == [("edge1/t/1/robot1/out", b"one")], "what was put")


def test_behind_its_close_a_worker_takes_nothing_that_would_be_lost() -> None:
    with Worker.from_env({}, standalone="t", handles_signals=False) as worker:
        latest = worker.publisher("{prefix}/{epoch}/map", latest=True)
        plain = worker.publisher("{prefix}/{epoch}/scan")
        assert latest.put(b"x")
        assert plain.put(b"x")
    assert not latest.put(b"late")
    assert not plain.put(b"late")
    assert (latest.sent, latest.withheld) == (1, 1)


@pytest.mark.parametrize(
    ("key", "options"),
    [
        ("{prefix}/{epoch}//scan", {}),
        ("{prefix}/{epoch}/scan#", {}),
        ("{prefix}/{epoch}/scan", {"latest": True, "reliable": True}),
        ("{prefix}/{epoch}/scan", {"latest": True, "keep_last": 0}),
        ("{prefix}/{epoch}/scan", {"reliable": True, "depth": 0}),
        ("{prefix}/{epoch}/map", {"latest": True, "keep_last": 2}),
    ],
    ids=str,
)
def test_an_output_that_could_not_be_as_asked_is_refused_when_it_is_declared(key: str, options: dict[str, Any]) -> None:
    with Worker.from_env({}, standalone="t", handles_signals=False) as worker:
        worker.publisher("{prefix}/{epoch}/map", latest=True)
        with pytest.raises(ValueError, match=r"scan|is n|either|declared already"):
            worker.publisher(key, **options)


def test_an_output_that_is_declared_in_every_callback_is_one() -> None:
    with Worker.from_env({}, standalone="t", handles_signals=False) as worker:
        output = worker.publisher("{prefix}/{epoch}/map", latest=True)
        assert worker.publisher("local/t/{epoch}/map", latest=True) is output
        assert worker.publisher("{prefix}/{epoch}/scan", latest=True) is not output


def test_an_output_that_cannot_end_takes_no_end_from_the_next_one(
    relay: Relay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_epoch: int) -> None:
        raise zenoh.ZError("no more publishers")

    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        monkeypatch.setattr(worker.publisher("{prefix}/{epoch}/robot1/out"), "_declare", refuse)
        worker.publisher("{prefix}/{epoch}/robot2/out")
        worker.ready()
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the epoch has begun")
        relay.tell(WorkerRole.IDLE)
        end = (f"edge1/t/1/robot2/out/{END_CHUNK}", EndMarker(epoch=1, count=0))
        until(lambda: relay.ends == [end], "the end of the other one")


@pytest.mark.parametrize("options", [{"latest": True}, {"reliable": True}, {}], ids=["latest", "reliable", "plain"])
def test_an_epoch_that_two_newer_ones_follow_ends_with_what_it_has_put(
    relay: Relay, tmp_path: Path, options: dict[str, Any]
) -> None:
    """Its publisher was given back before, and the end came of another one, which had put nothing."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        output = worker.publisher("{prefix}/{epoch}/robot1/out", **options)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        for epoch in (1, 3, 5):
            output._epoch_now = partial(int, epoch)
            assert output.put(b"x")
        for epoch in (0, 1, 3):
            output.send_end(epoch)
        until(lambda: len(relay.ends) == 3, "the ends")
        said = [(marker.epoch, marker.count) for _, marker in relay.ends]
        assert said == [(0, 0), (1, 1), (3, 1)]
        output._epoch_now = partial(int, 7)
        assert output.put(b"x")
        assert sorted(output._epochs) == [5, 7], "what has ended is given back"


@pytest.mark.parametrize(
    "wrong",
    [
        {"payload": {}},
        {"payload": None},
        {"payload": memoryview(b"x")},
        {"attachment": 1},
        {"encoding": 1},
        {"timestamp": 0.0},
    ],
    ids=["dict", "None", "memoryview", "attachment", "encoding", "timestamp"],
)
@pytest.mark.parametrize("options", [{"latest": True}, {"reliable": True}, {}], ids=["latest", "reliable", "plain"])
def test_an_argument_that_zenoh_does_not_take_is_refused_and_takes_no_number(
    relay: Relay, tmp_path: Path, options: dict[str, bool], wrong: dict[str, Any]
) -> None:
    arguments: dict[str, Any] = {"payload": b"x", **wrong}
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        out = worker.publisher("{prefix}/{epoch}/robot1/out", **options)
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: worker.role.role is WorkerRole.ACTIVE, "the role")
        assert out.put(bytearray(b"good"), attachment="attached", encoding="text/plain")
        until(lambda: relay.outputs == [("edge1/t/1/robot1/out", b"good")], "a good one")
        with contextlib.suppress(TypeError):
            assert not out.put(**arguments)
        assert (out.sent, out._epochs[1].count) == (1, 1)
        assert out.put("the next")
        until(lambda: relay.outputs[1:] == [("edge1/t/1/robot1/out", b"the next")], "the next one")
        assert out._epochs[1].count == 2
        relay.tell(WorkerRole.IDLE)
        until(lambda: worker.role.role is WorkerRole.IDLE, "a standby")
        with pytest.raises(TypeError, match=f"{next(iter(wrong))}: "):
            out.put(**arguments)


def test_a_worker_has_one_state_and_says_so_before_it_is_ready() -> None:
    """Two offers were two states, and each move began cold: "contested"."""
    with Worker.from_env({}, standalone="t", handles_signals=False) as worker:
        worker.on_snapshot(print)
        worker.offer_snapshot(bytes)
        with pytest.raises(RuntimeError, match="offer_snapshot a second time"):
            worker.offer_snapshot(bytes)
        with pytest.raises(RuntimeError, match="on_snapshot a second time"):
            worker.on_snapshot(print)
    with Worker.from_env({}, standalone="t", handles_signals=False) as worker:
        worker.ready()
        with pytest.raises(RuntimeError, match=r"Worker\.offer_snapshot after Worker\.ready"):
            worker.offer_snapshot(bytes)
        with pytest.raises(RuntimeError, match=r"Worker\.on_snapshot after Worker\.ready"):
            worker.on_snapshot(print)


@pytest.mark.parametrize("is_relay_stopped", [False, True], ids=["relay alive", "relay stopped"])
def test_a_signalled_worker_is_gone_within_a_second(tmp_path: Path, is_relay_stopped: bool) -> None:
    script = (
        "import sys, time, zenoh\n"
        "session = zenoh.open(zenoh.Config.from_json5(sys.argv[1]))\n"
        "seen = lambda sample: print('seen', flush=True)\n"
        "kept = session.liveliness().declare_subscriber('@zsched/**', seen, history=True)\n"
        "time.sleep(60)\n"
    )
    endpoint = free_endpoint()
    text = data_config(listen=(endpoint,), connect=())
    (tmp_path / "worker.json5").write_text(worker_config(connect=(endpoint,)))
    env = os.environ | {
        "ZSCHED_FLEET": "test",
        "ZSCHED_NODE": "edge1",
        "ZSCHED_TASK": "echo",
        "ZSCHED_INCARNATION": "1",
        "ZSCHED_ZENOH_CONFIG": str(tmp_path / "worker.json5"),
    }
    peer = subprocess.Popen([sys.executable, "-c", script, text], stdout=subprocess.PIPE)
    worker = subprocess.Popen([sys.executable, "-m", "zsched.tasks.echo"], env=env)
    try:
        assert peer.stdout is not None
        assert peer.stdout.readline() == b"seen\n"
        if is_relay_stopped:
            peer.send_signal(signal.SIGSTOP)
        worker.send_signal(signal.SIGTERM)
        signalled = time.monotonic()
        assert worker.wait(60) == 0
        within(time.monotonic() - signalled, 1.5)
    finally:
        for process in (peer, worker):
            process.kill()
            process.wait(60)
        if peer.stdout is not None:
            peer.stdout.close()


STORM = """
import os, signal, time
from zsched.worker import Worker
worker = Worker.from_env({}, standalone="t")
signal.signal(signal.SIGALRM, worker._on_signal)
until_s = time.monotonic() + 1.0
signal.setitimer(signal.ITIMER_REAL, 2e-4, 2e-4)
while time.monotonic() < until_s:
    worker.wait(0)
signal.setitimer(signal.ITIMER_REAL, 0.0)
print(worker._signals > 1, worker.wait(), worker.wait(60), flush=True)
os._exit(0)
"""


def test_a_signal_that_comes_while_the_worker_waits_is_not_waited_for() -> None:
    """Its handler took the lock that the wait which it had interrupted held: only SIGKILL ended that."""
    found = subprocess.run([sys.executable, "-c", STORM], timeout=60, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "True False False\n"), found.stderr


ENDLESS = """
from zsched.worker import Worker
with Worker.from_env({}, standalone="t") as worker:
    worker.ready()
    print("waits", flush=True)
    assert not worker.wait()
"""


@pytest.mark.parametrize("is_pair", [True, False], ids=["SIGINT and SIGTERM", "another thread's"])
def test_a_worker_ends_whichever_thread_has_the_signal(is_pair: bool) -> None:
    """The kernel gives the second signal to another thread, and a wait without an end never let its handler run."""
    for _ in range(PAIRS if is_pair else 1):
        with subprocess.Popen([sys.executable, "-c", ENDLESS], stdout=subprocess.PIPE, text=True) as process:
            try:
                assert process.stdout is not None
                assert process.stdout.readline() == "waits\n"
                if is_pair:
                    signal_at_once(process, signal.SIGINT, signal.SIGTERM)
                else:
                    signal_another_thread(process, signal.SIGTERM)
                assert process.wait(20) in (0, -signal.SIGTERM)  # the second one may come when it has ended
            finally:
                process.kill()


FORK = """
import multiprocessing, os, time
from zsched.worker import Worker
seen, told = os.pipe()
def work():
    os.write(told, b"x")
    while True:
        time.sleep(0.1)  # a signal just before a long sleep would be handled behind it
with Worker.from_env({}, standalone="t"):
    child = multiprocessing.get_context("fork").Process(target=work)
    child.start()
    os.read(seen, 1)  # before, Python itself forgets a signal: a forked interpreter begins with none
    child.terminate()
    child.join(5)
    print(child.exitcode, flush=True)
    child.kill()
"""


def test_a_child_that_a_worker_forks_ends_at_a_signal() -> None:
    """It inherits the worker's handler, which only counted: `join` behind `terminate` hung."""
    found = subprocess.run([sys.executable, "-c", FORK], timeout=60, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "-15\n"), found.stderr


CLOSED = """
import signal
from zsched.worker import Worker
numbers = signal.SIGINT, signal.SIGTERM
before = [signal.getsignal(number) for number in numbers]
with Worker.from_env({}, standalone="t") as worker:
    print([signal.getsignal(number) == worker._on_signal for number in numbers])
print([signal.getsignal(number) for number in numbers] == before)
with Worker.from_env({}, standalone="t"):
    signal.signal(signal.SIGINT, signal.SIG_IGN)
print(signal.getsignal(signal.SIGINT) == signal.SIG_IGN, signal.getsignal(signal.SIGTERM) == before[1])
"""

TWO_CLOSED = """
import signal, threading
from zsched.worker import Worker
numbers = signal.SIGINT, signal.SIGTERM
before = [signal.getsignal(number) for number in numbers]
one, two, three = [Worker.from_env({}, standalone=task) for task in "abc"]
one.close()
two.close()
print([signal.getsignal(number) == three._on_signal for number in numbers])
three.close()
print([signal.getsignal(number) == one for number, one in zip(numbers, before)])
four = Worker.from_env({}, standalone="d")
closing = threading.Thread(target=four.close)
closing.start()
closing.join()
try:
    signal.raise_signal(signal.SIGINT)
except KeyboardInterrupt:
    print("Ctrl-C works")
"""


def test_a_closed_worker_gives_the_signals_back_that_are_still_its_own() -> None:
    """Ctrl-C did nothing behind the `with` block."""
    found = subprocess.run([sys.executable, "-c", CLOSED], timeout=60, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "[True, True]\nTrue\nTrue True\n"), found.stderr


def test_workers_closed_in_any_order_and_by_any_thread_give_the_signals_back() -> None:
    """The first one's handler came back with the second one's end, and Ctrl-C did nothing for ever."""
    found = subprocess.run([sys.executable, "-c", TWO_CLOSED], timeout=60, capture_output=True, text=True, check=False)
    assert (found.returncode, found.stdout) == (0, "[True, True]\n[True, True]\nCtrl-C works\n"), found.stderr


def test_who_is_told_to_stop_takes_its_token_back_and_does_what_has_come(relay: Relay, tmp_path: Path) -> None:
    """Relays keep what is to come once the token went; what is here already is nobody else's."""
    count, is_gone = 20, threading.Event()
    token = KEYS.worker("edge1", "t", 3)
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        output = worker.publisher("{prefix}/{epoch}/robot1/out")

        def take(received: Received) -> None:
            is_gone.wait(5.0)
            output.put(received.payload)

        worker.subscribe("{prefix}/*/in", take, keep_last=None)
        worker.ready()
        until(lambda: token in relay.tokens, "the ready token")
        relay.tell(WorkerRole.ACTIVE, 4)
        until(lambda: worker.role.epoch == 4, "the role")
        for number in range(count):
            relay.put(str(number).encode())
        until(lambda: relay.acks and relay.acks[-1].arrived == count, "all are with the worker")

        def let_go() -> None:
            until(lambda: token not in relay.tokens, "the token goes")
            is_gone.set()

        seen = threading.Thread(target=let_go)
        seen.start()
        worker._on_signal(signal.SIGINT, None)
    seen.join()
    until(lambda: len(relay.outputs) == count, "every answer")
    until(lambda: relay.acks[-1].processed == count, "all are said to be done")


def test_a_second_signal_waits_for_nothing(relay: Relay, tmp_path: Path) -> None:
    is_let = threading.Event()
    worker = Worker.from_env(environment(relay, tmp_path), handles_signals=False)

    def take(_: Received) -> None:
        is_let.wait(10.0)

    worker.subscribe("{prefix}/*/in", take)
    worker.ready()
    relay.tell(WorkerRole.ACTIVE, 4)
    until(lambda: worker.role.epoch == 4, "the role")
    relay.put(b"0")
    until(lambda: worker._dispatcher._is_busy, "it is in work")
    worker._on_signal(signal.SIGINT, None)
    finishing = threading.Thread(target=worker._finish)
    finishing.start()
    worker._on_signal(signal.SIGTERM, None)
    finishing.join(1.0)
    assert not finishing.is_alive(), "without the signal it takes 2 s"
    is_let.set()
    worker.close()


def test_what_an_owner_that_died_may_have_done_is_marked(relay: Relay, echo: Echo) -> None:
    """The start marker says how many samples went to it; what a standby took of them keeps the mark."""
    payload = encode_end(EndMarker(epoch=0, count=0, replayed=2))
    relay.session.put(f"{INPUT}/{END_CHUNK}", payload, source_info=zenoh.SourceInfo(relay.publisher.id, 0))
    until(lambda: relay.acks and relay.acks[-1].replays == 2, "the answer: a relay sends nothing before it")
    for name in (b"a", b"b", b"c"):
        relay.put(name)
    until(lambda: len(echo.taken) == 3, "the inputs")
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: len(echo.taken) == 6, "once more, as the owner")
    marks = [(received.payload.to_bytes(), received.replayed) for received in echo.taken]
    assert marks == [(b"a", True), (b"b", True), (b"c", False)] * 2


def test_what_one_start_marker_says_is_told_and_three_others_take_it_back(relay: Relay, echo: Echo) -> None:
    """One forged one made a queue of a `latest` input, or marked all that came later as a replay, for good."""

    def say(marker: EndMarker) -> None:
        source = zenoh.SourceInfo(relay.publisher.id, marker.count)
        relay.session.put(f"{INPUT}/{END_CHUNK}", encode_end(marker), source_info=source)

    relay.put(b"a")
    until(lambda: echo.taken, "it came: the marker that says it will not comes in another thread")
    say(EndMarker(epoch=0, count=1, is_whole=True, replayed=2**40))
    until(lambda: relay.acks and relay.acks[-1].is_whole, "it is believed, and told")
    assert relay.acks[-1].replays == 0, "no relay keeps so many"
    say(EndMarker(epoch=0, count=1, is_whole=True, replayed=5))
    until(lambda: relay.acks[-1].replays == 5, "this could be")
    for _ in range(2):
        before = len(relay.acks)
        say(EndMarker(epoch=0, count=1))
        until(lambda before=before: len(relay.acks) > before, "its answer")  # type: ignore[misc]
    assert (relay.acks[-1].is_whole, relay.acks[-1].replays) == (True, 5)
    say(EndMarker(epoch=0, count=1))
    until(lambda: relay.acks[-1].is_whole is False and relay.acks[-1].replays == 0, "three say so")
    relay.put(b"b")
    until(lambda: len(echo.taken) == 2, "the inputs")
    assert [received.replayed for received in echo.taken] == [False, False]


def _wait(gate: threading.Event) -> None:
    gate.wait(60)


def test_what_was_withheld_goes_out_before_what_comes_with_the_role(relay: Relay, echo: Echo) -> None:
    """A worker that was told late has a backlog: the role is known before the backlog is processed once more."""
    gate = threading.Event()
    for name in (b"a", b"b"):
        relay.put(name)
    until(lambda: len(echo.taken) == 2, "the backlog")
    echo.worker._errands.put(partial(_wait, gate))
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.put(b"c")
    until(lambda: len(echo.taken) == 3, "the next sample")
    gate.set()
    relay.put(b"d")
    until(lambda: len(relay.outputs) >= 4, "all outputs")
    assert [payload for _, payload in relay.outputs] == [b"a", b"b", b"c", b"d"]


class Slow(Echo):
    """One that stands still in its callback, before the output, as long as ``gate`` is shut."""

    def __init__(self, worker: Worker, keep_last: int | None = None) -> None:
        self.gate = threading.Event()
        self.gate.set()
        super().__init__(worker, keep_last)

    def _take(self, received: Received) -> None:
        self.taken.append(received)
        self.gate.wait(10)
        self.output.put(received.payload)


def test_the_sample_in_hand_when_the_role_comes_does_not_overtake_what_was_withheld(
    relay: Relay, tmp_path: Path
) -> None:
    """A worker that was frozen at the move: its inputs come before its role, and one of them is in work then."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        slow = Slow(worker)
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        for name in (b"a", b"b"):
            relay.put(name)
        until(lambda: slow.output.withheld == 2, "the backlog")
        slow.gate.clear()
        relay.put(b"c")
        until(lambda: len(slow.taken) == 3, "the next sample is in hand")
        relay.tell(WorkerRole.ACTIVE, epoch=4)
        until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
        relay.put(b"d")
        slow.gate.set()
        until(lambda: len(relay.outputs) >= 4, "all outputs")
        assert [payload for _, payload in relay.outputs] == [b"a", b"b", b"c", b"d"]


def test_the_newest_value_in_hand_when_the_role_comes_goes_out_at_once(relay: Relay, tmp_path: Path) -> None:
    """Where older values need no answer, a takeover does not wait for them: the gate drops them behind it."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        slow = Slow(worker, keep_last=1)
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.put(b"a")
        until(lambda: slow.output.withheld == 1, "the warm-up")
        slow.gate.clear()
        relay.put(b"b")
        until(lambda: len(slow.taken) == 2, "the next value is in hand")
        relay.tell(WorkerRole.ACTIVE, epoch=4)
        until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
        slow.gate.set()
        until(lambda: relay.outputs, "its result")
        assert relay.outputs[0] == ("edge1/t/4/robot1/out", b"b")


def test_what_was_withheld_for_want_of_a_lease_goes_out_before_what_comes_with_it(relay: Relay, echo: Echo) -> None:
    gate = threading.Event()

    def tell(lease_until_s: float) -> None:
        relay.role = Role(task="t", role=WorkerRole.ACTIVE, epoch=3, lease_until_s=lease_until_s)
        relay.session.put(ROLE_KEY, wire.encode(relay.role))
        until(lambda: echo.worker.role == relay.role, "the role")

    tell(0.0)
    until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "the worker has begun")
    relay.put(b"a")
    until(lambda: echo.output.withheld == 1, "the withheld output")
    echo.worker._errands.put(partial(_wait, gate))
    tell(monotonic_s() + 60.0)
    relay.put(b"b")
    until(lambda: len(echo.taken) == 2, "the next sample")
    gate.set()
    until(lambda: len(relay.outputs) >= 2, "both outputs")
    assert [payload for _, payload in relay.outputs] == [b"a", b"b"]


def test_a_role_that_comes_while_the_worker_says_that_it_takes_a_state_is_no_cold_start(
    relay: Relay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its role was noted before the callback was there, and read before it was the role: nobody asked for the state."""
    book, got = StateBook(), list[bytes]()
    book.ready()
    book.work(2)
    offer = Offer(relay.session, KEYS.snapshot("edge2", "t"), lambda: b"100", Troubles(lambda *_: None), book)
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        restorer, noted, goes_on = worker._restorer, threading.Event(), threading.Event()
        note = restorer.note

        def slowly(role: Role) -> None:
            note(role)
            if role.epoch == 3 and not noted.is_set():
                noted.set()
                goes_on.wait(60)

        monkeypatch.setattr(restorer, "note", slowly)
        relay.role = Role(task="t", role=WorkerRole.ACTIVE, epoch=3, predecessor="edge2")
        relay.session.put(ROLE_KEY, wire.encode(relay.role))
        assert noted.wait(60)
        saying = threading.Thread(target=lambda: worker.on_snapshot(got.append))
        saying.start()
        saying.join(0.3)
        goes_on.set()
        saying.join(60)
        worker.ready()
        until(lambda: worker.role == relay.role, "it works")
        until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "and shows that")
        assert got == [b"100"]
    offer.undeclare()


def test_a_lease_that_comes_while_a_state_is_caught_up_with_takes_nothing_from_it(relay: Relay, tmp_path: Path) -> None:
    """What was processed before the state came was acknowledged, and then missing in the state: nobody counted it."""
    total, taken, gate, book = [0], list[int](), threading.Event(), StateBook()
    gate.set()

    def add(received: Received) -> None:
        taken.append(int(received.payload.to_bytes()))
        gate.wait(60)
        total[0] += taken[-1]

    def tell(lease_until_s: float) -> None:
        role = Role(task="t", role=WorkerRole.ACTIVE, epoch=3, lease_until_s=lease_until_s, predecessor="edge2")
        relay.role = role
        relay.session.put(ROLE_KEY, wire.encode(role))

    book.ready()
    book.work(2)
    offer = Offer(relay.session, KEYS.snapshot("edge2", "t"), lambda: b"100", Troubles(lambda *_: None), book)
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.on_snapshot(lambda content: total.__setitem__(0, int(content)))
        worker.subscribe("{prefix}/*/in", add, keep_last=None)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        for _ in range(5):
            relay.put(b"1")
        until(lambda: total == [5], "as a standby, without an answer")
        gate.clear()
        tell(0.0)
        until(lambda: len(taken) == 6, "the state, and the first sample once more")
        tell(monotonic_s() + 60.0)
        until(lambda: worker.role == relay.role, "the lease")
        begun = threading.Event()
        worker._errands.put(begun.set)
        assert begun.wait(60)
        gate.set()
        until(lambda: worker._dispatcher.is_still(0.0), "all of it")
        assert total == [105]
    offer.undeclare()


def test_what_comes_behind_the_end_of_an_epoch_is_answered_in_the_next_one(relay: Relay, echo: Echo) -> None:
    """A worker that is frozen while it is left and chosen again: its inputs come before it hears of either."""
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
    relay.put(b"a")
    until(lambda: len(relay.outputs) == 1, "the first output")
    relay.tell(WorkerRole.DRAINING, epoch=4)
    relay.end(4)
    until(lambda: relay.ends, "the end marker")
    for name in (b"b", b"c"):
        relay.put(name)
    until(lambda: echo.output.withheld == 2, "what belongs to no epoch yet")
    relay.tell(WorkerRole.ACTIVE, epoch=6)
    until(lambda: f"{ROLE_KEY}/6" in relay.tokens, "the worker has begun with the next one")
    relay.put(b"d")
    until(lambda: len(relay.outputs) >= 4, "all outputs")
    assert [payload for _, payload in relay.outputs] == [b"a", b"b", b"c", b"d"]


def test_what_an_owner_withheld_between_two_epochs_is_answered_in_the_one_it_came_in(relay: Relay, echo: Echo) -> None:
    """One epoch follows another on the same owner: the robots let the older one's answers pass first."""
    gate = threading.Event()
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
    relay.put(b"a")
    until(lambda: len(relay.outputs) == 1, "the first output")
    echo.worker._errands.put(partial(_wait, gate))
    relay.tell(WorkerRole.ACTIVE, epoch=5)
    until(lambda: echo.worker.role.epoch == 5, "the next role")
    relay.put(b"b")
    until(lambda: echo.output.withheld == 1, "the withheld output")
    gate.set()
    until(lambda: f"{ROLE_KEY}/5" in relay.tokens, "the worker has begun with it")
    relay.put(b"c")
    until(lambda: len(relay.outputs) >= 3, "all outputs")
    assert relay.outputs == [("edge1/t/4/robot1/out", name) for name in (b"a", b"b", b"c")]


def test_a_long_backlog_of_a_worker_that_was_told_late_is_answered_whole(relay: Relay, echo: Echo) -> None:
    """More than the samples that a predecessor's state would want again."""
    count = 2 * MAX_WITHHELD
    for number in range(count):
        relay.put(str(number).encode())
    until(lambda: len(echo.taken) == count, "the backlog")
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: len(relay.outputs) == count, "an answer to all of it")
    assert [int(payload) for _, payload in relay.outputs] == list(range(count))


@pytest.mark.parametrize("is_end_first", [False, True], ids=["role first", "end first"])
def test_who_hears_of_an_epoch_only_that_it_drains_answers_its_backlog_first(
    relay: Relay, echo: Echo, *, is_end_first: bool
) -> None:
    """Two roles within the time of one question: the worker hears the second only."""
    count = 2 * MAX_WITHHELD
    for number in range(count):
        relay.put(str(number).encode())
    until(lambda: len(echo.taken) == count, "the backlog")
    if is_end_first:
        relay.end(4)
        until(lambda: echo.has_inputs_ended(4), "the inputs to have ended")
    relay.tell(WorkerRole.DRAINING, epoch=4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    if not is_end_first:
        relay.end(4)
    until(lambda: relay.ends, "the end marker")
    assert relay.ends == [(f"edge1/t/4/robot1/out/{END_CHUNK}", EndMarker(epoch=4, count=count))]
    until(lambda: len(relay.outputs) == count, "an answer to all of it")
    assert [int(payload) for _, payload in relay.outputs] == list(range(count))


def test_an_end_marker_of_an_epoch_that_never_came_ends_nothing(relay: Relay, echo: Echo) -> None:
    relay.put(b"a")
    until(lambda: len(echo.taken) == 1, "the input")
    relay.end(10**6)
    until(lambda: echo.has_inputs_ended(10**6), "the forged marker")
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the token of the epoch")
    relay.put(b"b")
    until(lambda: relay.outputs == [("edge1/t/4/robot1/out", name) for name in (b"a", b"b")], "the outputs")


def test_the_end_waits_for_a_backlog_that_is_processed_once_more(relay: Relay, echo: Echo) -> None:
    """Told that it works and at once that it does not: the end of the inputs is there before the role has begun."""
    gate = threading.Event()
    for name in (b"a", b"b", b"c"):
        relay.put(name)
    until(lambda: len(echo.taken) == 3, "the backlog")
    echo.worker._errands.put(partial(_wait, gate))
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: echo.worker.role.epoch == 4, "the role")
    relay.tell(WorkerRole.DRAINING, epoch=4)
    until(lambda: echo.worker.role.role is WorkerRole.DRAINING, "the next role")
    relay.end(4)
    until(lambda: echo.worker._dispatcher._markers, "the marker")
    gate.set()
    until(lambda: relay.ends, "the end marker")
    assert relay.ends[0][1].count == 3


def test_what_a_backlog_has_no_room_for_is_said_to_be_lost(
    relay: Relay, echo: Echo, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(worker_backlog, "MAX_BACKLOG", 10)
    told: list[StreamAck] = []
    key = KEYS.ack("edge1", "t", "3", str(relay.session.zid()))
    heard = relay.session.declare_subscriber(
        key, lambda sample: told.extend(wire.decode(sample.payload.to_bytes(), StreamAcks).acks)
    )
    while relay.count < 40:
        relay.put(b"x")
    until(lambda: len(echo.taken) == relay.count, "the backlog")
    until(lambda: told and told[-1].processed == relay.count and told[-1].lost == relay.count - 10, "what is lost")
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: len(relay.outputs) == 10, "the newest")
    heard.undeclare()


def test_who_is_chosen_again_before_it_hears_that_it_was_left_answers_in_the_new_epoch(
    relay: Relay, echo: Echo
) -> None:
    """A -> B -> A: its role is late for both moves, and the robots have closed the epoch that it believes in."""
    relay.tell(WorkerRole.ACTIVE, epoch=1)
    until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
    relay.open_slot(1)
    relay.put(b"a")
    until(lambda: len(relay.outputs) == 1, "the first output")
    relay.open_slot(3)
    for name in (b"b", b"c"):
        relay.put(name)
    until(lambda: echo.output.withheld == 2, "what belongs to an epoch of which it has not heard")
    relay.tell(WorkerRole.ACTIVE, epoch=3)
    until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "the worker has begun with it")
    relay.put(b"d")
    until(lambda: len(relay.outputs) >= 4, "all outputs")
    again = [("edge1/t/3/robot1/out", name) for name in (b"b", b"c", b"d")]
    assert relay.outputs == [("edge1/t/1/robot1/out", b"a"), *again]


@pytest.mark.usefixtures("echo")
def test_who_is_left_and_chosen_again_twice_ends_both_epochs(relay: Relay) -> None:
    """A -> B -> A -> C -> A within the time in which an epoch's inputs may still come."""
    publishers = []
    for epoch in (1, 3):
        relay.tell(WorkerRole.ACTIVE, epoch)
        until(lambda epoch=epoch: f"{ROLE_KEY}/{epoch}" in relay.tokens, "the worker has begun")  # type: ignore[misc]
        relay.open_slot(epoch)
        relay.put(b"x")
        until(lambda epoch=epoch: len(relay.outputs) == epoch // 2 + 1, "the output")  # type: ignore[misc]
        publishers.append(relay.publisher)
    relay.tell(WorkerRole.ACTIVE, epoch=5)
    until(lambda: f"{ROLE_KEY}/5" in relay.tokens, "the worker has begun with the third")
    for epoch, relay.publisher in zip((1, 3), publishers, strict=True):
        relay.end(epoch)
    until(lambda: len(relay.ends) == 2, "both ends")
    assert [(marker.epoch, marker.count) for _, marker in relay.ends] == [(1, 1), (3, 1)]


def test_a_role_does_not_wait_for_one_who_does_not_take_what_it_is_refused(
    relay: Relay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A stranger asked very often, and froze: the refusals stood still for 6 s, and the role behind them."""
    gate, refused = threading.Event(), list[zenoh.Query]()

    def stand_still(query: zenoh.Query, *_: str) -> None:
        refused.append(query)
        gate.wait(60)
        query.drop()

    monkeypatch.setattr(worker_services, "_refuse", stand_still)
    monkeypatch.setattr(worker_module, "MAX_REFUSALS", 3)
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.serve("{prefix}/job", lambda _request: b"", depth=1)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        ended: list[int] = []
        for number in range(20):
            heard: Any = zenoh.handlers.Callback(lambda _: None, partial(ended.append, number), indirect=False)
            relay.session.get("edge1/t/job", heard, timeout=60.0)
        until(lambda: len(refused) == 2, "one is refused in each of two threads, and others wait")
        relay.tell(WorkerRole.ACTIVE, epoch=1)
        until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
        until(lambda: len(ended) >= 20 - 3 - 3, "those for which there is no room hear the end")
        gate.set()
        until(lambda: len(ended) == 20, "all of them")


@pytest.mark.usefixtures("echo")
def test_who_is_chosen_again_and_can_have_no_thread_is_the_owner_all_the_same(
    relay: Relay, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*arguments: Any, name: str, **options: Any) -> threading.Thread:
        if name == "zsched carry":
            raise RuntimeError("can't start new thread")
        return guarded(*arguments, name=name, **options)

    monkeypatch.setattr(worker_module, "guarded", refuse)
    relay.tell(WorkerRole.ACTIVE, epoch=1)
    until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
    relay.tell(WorkerRole.ACTIVE, epoch=3)
    until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "the worker has begun with the next one")
    relay.put(b"x")
    until(lambda: relay.outputs == [("edge1/t/3/robot1/out", b"x")], "the output")
    until(lambda: [marker.epoch for _, marker in relay.ends] == [1], "the end of the first epoch")


@pytest.fixture
def newest(relay: Relay, tmp_path: Path) -> Iterator[Echo]:
    """The owner of epoch 1 that keeps the newest value only; the relay has a new publisher, as for another slot."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        made = Echo(worker, keep_last=1)
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.tell(WorkerRole.ACTIVE, epoch=1)
        until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
        relay.publisher = relay.session.declare_publisher(INPUT, congestion_control=zenoh.CongestionControl.BLOCK)
        yield made


def test_a_value_of_an_epoch_that_is_not_told_yet_waits_for_it_too(relay: Relay, newest: Echo) -> None:
    """Class ``latest``: its marker names the slot, and is no word about numbers."""
    relay.mark(EndMarker(epoch=0, count=0, slot=3))
    until(lambda: newest.worker._dispatcher._slots, "the marker")
    relay.count = 5
    relay.put(b"a")
    until(lambda: newest.output.withheld == 1, "the value")
    relay.tell(WorkerRole.ACTIVE, epoch=3)
    until(lambda: relay.outputs == [("edge1/t/3/robot1/out", b"a")], "its result")
    until(lambda: (told := relay.told()) is not None and told.processed == 6, "the acknowledgement")
    told = relay.told()
    assert told is not None
    assert (told.first, told.lost) == (5, 0)


@pytest.mark.parametrize("waits_s", [60.0, 0.0])
def test_a_name_that_comes_behind_the_first_value_counts_for_it_too(
    relay: Relay, newest: Echo, monkeypatch: pytest.MonkeyPatch, waits_s: float
) -> None:
    """Markers and values come in threads of their own. Taken for one of the old epoch, the newest value had no result.

    Where the value has not waited long enough, the ones behind it have their epoch.
    """
    monkeypatch.setattr(worker_inputs, "NAME_S", waits_s)
    relay.put(b"a")
    if not waits_s:
        until(lambda: relay.outputs == [("edge1/t/1/robot1/out", b"a")], "a result that nobody takes any more")
        relay.outputs.clear()
    else:
        with pytest.raises(AssertionError):
            until(lambda: relay.outputs, "it has not waited for its name", 0.3)
    relay.mark(EndMarker(epoch=0, count=0, slot=3))
    until(lambda: newest.worker._dispatcher._slots, "the marker")
    if not waits_s:
        relay.put(b"a")
    until(lambda: newest.output.withheld == 1, "the value")
    relay.tell(WorkerRole.ACTIVE, epoch=3)
    until(lambda: relay.outputs == [("edge1/t/3/robot1/out", b"a")], "its result")


def test_two_words_about_one_publisher_s_slot_count_as_none(relay: Relay, echo: Echo) -> None:
    """One is a stranger's, who has guessed its name before it said anything."""
    relay.tell(WorkerRole.ACTIVE, epoch=1)
    until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
    relay.greet(is_whole=True, slot=10**6)
    relay.mark(EndMarker(epoch=0, count=0, is_whole=True, slot=1))
    until(lambda: 0 in echo.worker._dispatcher._slots.values(), "both words")
    relay.put(b"a")
    until(lambda: relay.outputs == [("edge1/t/1/robot1/out", b"a")], "its result")


def test_a_stranger_s_word_that_a_publisher_is_given_up_is_taken_back(
    relay: Relay, echo: Echo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A relay puts again what is not acknowledged, which it would not do behind such a word of its own."""
    monkeypatch.setattr(worker_inputs, "GIVE_UP_S", 0.2)
    relay.open_slot(2)
    relay.put(b"a")
    until(lambda: echo.output.withheld == 1, "the backlog")
    relay.give_up()
    until(lambda: echo.worker._dispatcher._given_up, "the forgery")
    _expect_one_lost_of_two(relay)


@pytest.mark.parametrize("when", ["claimed", "processed", "being noted", "noted"])
def test_what_was_in_hand_when_a_stranger_gave_its_publisher_up_is_counted(
    relay: Relay, echo: Echo, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """It was dropped in silence, and what came behind it was never acknowledged where it had just been noted."""
    monkeypatch.setattr(worker_inputs, "GIVE_UP_S", 0.2)
    relay.open_slot(2)
    dispatcher, own = echo.worker._dispatcher, relay.publisher.id
    name = INPUT, str(own.zid), own.eid
    steps = {"claimed": "_claim", "processed": "_dispatch", "being noted": "_note", "noted": "_note"}
    step = getattr(dispatcher, steps[when])

    def forge(is_due: bool) -> None:
        if is_due and not dispatcher._given_up and not relay.outputs:
            dispatcher._give_up(name, monotonic_s())

    def hooked(*args: Any, **kwargs: Any) -> Any:
        forge(when == "being noted")
        found = step(*args, **kwargs)
        forge(when != "being noted" and (when != "claimed" or found is not None))
        return found

    with monkeypatch.context() as hooks:
        hooks.setattr(dispatcher, steps[when], hooked)
        relay.put(b"a")
        until(lambda: dispatcher._given_up and not dispatcher._is_busy, "the forgery")
    _expect_one_lost_of_two(relay)


def _expect_one_lost_of_two(relay: Relay) -> None:
    def is_answered() -> bool:
        source = zenoh.SourceInfo(relay.publisher.id, 1)
        relay.publisher.put(b"b", source_info=source)
        return bool(relay.outputs)

    relay.tell(WorkerRole.ACTIVE, epoch=2)
    until(is_answered, "a result")
    assert relay.outputs == [("edge1/t/2/robot1/out", b"b")]
    until(lambda: (told := relay.told()) is not None and (told.processed, told.lost) == (2, 1), "an account of both")


def test_what_a_standby_withheld_and_its_robot_gave_up_is_not_done_by_the_owner_it_becomes(
    relay: Relay, echo: Echo
) -> None:
    relay.open_slot(2)
    for name in (b"a", b"b"):
        relay.put(name)
    until(lambda: echo.output.withheld == 2, "the backlog")
    relay.give_up()
    until(lambda: echo.worker._dispatcher._given_up, "the robot's word")
    relay.put(b"c")  # as if the marker had overtaken it
    relay.open_slot(4)
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
    relay.put(b"d")
    until(lambda: relay.outputs, "an output")
    assert relay.outputs == [("edge1/t/4/robot1/out", b"d")]
    assert echo.payloads() == [b"a", b"b", b"d"]


def test_what_was_withheld_in_an_older_epoch_is_too_old_for_a_newer_one(
    relay: Relay, echo: Echo, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No word came that it is given up: the link was broken. It is never acknowledged, so its robot counts it."""
    relay.open_slot(2)
    relay.put(b"a")
    until(lambda: echo.output.withheld == 1, "the backlog")
    old = relay.publisher.id.eid
    monkeypatch.setattr(worker_backlog, "STALE_S", 0.0)
    relay.tell(WorkerRole.ACTIVE, epoch=4)
    until(lambda: f"{ROLE_KEY}/4" in relay.tokens, "the worker has begun")
    relay.open_slot(4)
    relay.put(b"b")
    until(lambda: relay.outputs, "an output")
    assert relay.outputs == [("edge1/t/4/robot1/out", b"b")]
    assert {ack.processed for ack in relay.acks if ack.eid == old} == {0}


def test_what_still_waits_when_its_robot_gives_it_up_is_not_done(relay: Relay, tmp_path: Path) -> None:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        slow = Slow(worker, keep_last=None)
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.tell(WorkerRole.ACTIVE, epoch=1)
        until(lambda: f"{ROLE_KEY}/1" in relay.tokens, "the worker has begun")
        relay.open_slot(1)
        slow.gate.clear()
        for name in (b"a", b"b", b"c"):
            relay.put(name)
        until(lambda: slow.taken and len(worker._dispatcher._queue) == 2, "one in hand, two that wait")
        relay.give_up()
        until(lambda: worker._dispatcher._given_up, "the robot's word")
        relay.open_slot(3)
        relay.tell(WorkerRole.ACTIVE, epoch=3)
        until(lambda: f"{ROLE_KEY}/3" in relay.tokens, "it has begun: what comes sooner is processed once more")
        relay.put(b"d")
        slow.gate.set()
        until(lambda: slow.payloads()[-1] == b"d", "the next sample")
        assert slow.payloads() == [b"a", b"d"]


def test_who_drains_itself_lets_out_what_comes_before_the_inputs_end(relay: Relay, tmp_path: Path) -> None:
    """Robots send here until their flip, a moment after the role: that was acknowledged, and its answer withheld."""
    taken: list[bytes] = []
    around = environment(relay, tmp_path)
    with Worker.from_env(around, drains_itself=True, handles_signals=False) as worker:
        output = worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)
        worker.subscribe("{prefix}/*/in", lambda received: taken.append(received.payload.to_bytes()))
        worker.ready()
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: worker.role.epoch == 1, "the role")
        for number, role in enumerate((WorkerRole.ACTIVE, WorkerRole.DRAINING)):
            relay.tell(role, 1)
            until(lambda: worker.role.role is role, "the role")  # noqa: B023 - called at once
            worker.drained()
            relay.put(str(number).encode())
            until(lambda: len(taken) > number, "the input")  # noqa: B023 - as above
            assert output.put(taken[-1])
            worker.drained()
        assert relay.ends == []
        relay.end(1)
        until(lambda: worker._dispatcher.has_ended(1), "the end of the input")
        worker.drained()
        until(lambda: relay.ends, "the end of the output")
    assert [payload for _, payload in relay.outputs] == [b"0", b"1"]


def test_what_it_answers_under_a_key_of_its_inputs_is_no_input(relay: Relay, tmp_path: Path) -> None:
    """It answered itself for ever."""
    taken: list[bytes] = []
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        output = worker.publisher("{prefix}/{epoch}/in")

        def take(received: Received) -> None:
            taken.append(received.payload.to_bytes())
            if len(taken) < 5:
                output.put(received.payload)

        worker.subscribe("{prefix}/*/in", take)
        worker.ready()
        relay.tell(WorkerRole.ACTIVE, 4)
        until(lambda: worker.role.epoch == 4, "the role")
        for payload in (b"first", b"last"):
            relay.put(payload)
            until(lambda: taken[-1:] == [payload], "the input")  # noqa: B023 - called at once
    assert taken == [b"first", b"last"]


def test_no_two_callbacks_take_the_same_keys(relay: Relay, tmp_path: Path) -> None:
    """Each sample reached one of them, by chance; each request both."""
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.subscribe("{prefix}/*/map", print)
        worker.serve("{prefix}/ask", lambda _request: b"")
        for key in ("{prefix}/robot1/map", "{prefix}/*/map", "{prefix}/**"):
            with pytest.raises(ValueError, match=r"has keys of 'edge1/t/\*/map', which is taken already"):
                worker.subscribe(key, print)
        with pytest.raises(ValueError, match="let one callback take both"):
            worker.serve("{prefix}/*", lambda _request: b"")
        worker.subscribe("{prefix}/*/scan", print)
        worker.serve("{prefix}/robot1/map", lambda _request: b"")


def test_after_ready_no_input_or_service_is_taken_any_more(relay: Relay, tmp_path: Path) -> None:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.subscribe("{prefix}/*/in", lambda _received: None)
        worker.ready()
        with pytest.raises(RuntimeError, match=r"Worker.subscribe after Worker.ready"):
            worker.subscribe("{prefix}/*/other", lambda _received: None)
        with pytest.raises(RuntimeError, match=r"Worker.serve after Worker.ready"):
            worker.serve("{prefix}/ask", lambda _request: b"")


@pytest.fixture
def told(relay: Relay) -> Iterator[list[WorkerTrouble]]:
    """What workers of edge1 tell of their troubles."""
    found: list[WorkerTrouble] = []
    heard = relay.session.declare_subscriber(
        KEYS.trouble("edge1", "*", "*"),
        lambda sample: found.append(wire.decode(sample.payload.to_bytes(), WorkerTrouble)),
    )
    yield found
    heard.undeclare()


def test_an_output_that_no_rule_takes_is_told_to_the_node_once_the_worker_is_the_owner(
    relay: Relay, told: list[WorkerTrouble], tmp_path: Path
) -> None:
    env = {**environment(relay, tmp_path), "ZSCHED_OUTPUT_KEYS": '["edge1/t/*/out"]'}
    with Worker.from_env(env, handles_signals=False) as worker:
        worker.publisher("{prefix}/{epoch}/out")
        worker.publisher("{prefix}/out")
        with pytest.raises(ValueError, match=r"no placeholder \{prefx\}"):
            worker.publisher("{prefx}/out")
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        assert told == []
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: told, "the mistake")
    text = "puts on edge1/t/out, which no output rule takes: the rules take edge1/t/*/out"
    assert told[0] == WorkerTrouble(task="t", incarnation="3", count=0, text=text)


def test_an_output_that_no_rule_takes_is_told_at_once_where_an_owner_declares_it(
    relay: Relay, told: list[WorkerTrouble], tmp_path: Path
) -> None:
    """A worker that declares an output in its first callback is the owner already: no role comes that would tell."""
    env = {**environment(relay, tmp_path), "ZSCHED_OUTPUT_KEYS": '["edge1/t/*/out"]'}
    with Worker.from_env(env, handles_signals=False) as worker:
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: worker.role.role is WorkerRole.ACTIVE, "the role")
        worker.publisher("{prefix}/{epoch}/out")
        worker.publisher("{prefix}/{epoch}/uot")
        until(lambda: told, "the mistake")
    text = "puts on edge1/t/{epoch}/uot, which no output rule takes: the rules take edge1/t/*/out"
    assert told[0] == WorkerTrouble(task="t", incarnation="3", count=0, text=text)


async def _later(_received: Received) -> None:
    raise AssertionError("it is never run")


def _in_parts(_received: Received) -> Iterator[None]:
    yield


@pytest.mark.parametrize("callback", [_later, _in_parts])
def test_a_callback_of_which_nothing_would_run_is_a_trouble(
    relay: Relay, told: list[WorkerTrouble], tmp_path: Path, callback: Any
) -> None:
    with Worker.from_env(environment(relay, tmp_path), handles_signals=False) as worker:
        worker.subscribe("{prefix}/*/in", callback)
        worker.ready()
        until(lambda: KEYS.worker("edge1", "t", 3) in relay.tokens, "the ready token")
        relay.put(b"x")
        until(lambda: told, "the mistake")
    assert told[0].text.startswith("TypeError: a callback must be a plain function")
