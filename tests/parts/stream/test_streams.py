"""An application with its own streams, the relay's side of its socket, and a real worker that dials it."""

from __future__ import annotations

import contextlib
import signal
import socket
import subprocess
import sys
import threading
import time
from asyncio import CancelledError
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest
import zenoh

from support.hand_relay import Relay, environment_on
from support.waiting import free_endpoint, until
from zsched.core.events import ProblemReported, SlotDrained, SlotReady
from zsched.core.hop.books import unaccounted
from zsched.core.relay_protocol import RelayReport, SlotLost
from zsched.core.values.plan import (
    Direction,
    HandoverRule,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
    WorkerRole,
)
from zsched.core.values.struct import replace
from zsched.errors import AdapterError
from zsched.guard import all_end_within, running
from zsched.ipc.pipe import write_frame
from zsched.ipc.protocol import MAX_KEYS, StreamKeys
from zsched.relay import application
from zsched.relay.application import Application
from zsched.relay.streams.given import Given
from zsched.relay.streams.inputs import InputStream
from zsched.relay.streams.lanes import Lane
from zsched.sessions.config import data_config, worker_config
from zsched.stream import Received, Streams, streams
from zsched.stream.link import Link
from zsched.stream.task import OwnTask
from zsched.wire import codec as wire
from zsched.worker import Received as Input
from zsched.worker import Worker

SETTINGS = StreamSettings(stream_class=StreamClass.RELIABLE, depth=1000, handover=HandoverRule.ALL)
IN = Route(
    stream="t/in/0",
    direction=Direction.INPUT,
    from_expr="robot1/*/in",
    to_expr="edge1/t/robot1/*/in",
    settings=SETTINGS,
)
OUT = Route(
    stream="t/out/0",
    direction=Direction.OUTPUT,
    from_expr="edge1/t/1/robot1/out",
    to_expr="robot1/out",
    settings=SETTINGS,
)
SLOT = Slot(epoch=1, owner="edge1", routes=(IN, OUT), ready_when=ReadyWhen.TOKEN)
PLAN = RoutePlan(task="t", phase=RoutePhase.CLOSE, current=SLOT)
NONE = (StreamCount(stream="t/in/0", acknowledged=0, in_flight=0), StreamCount(stream="t/out/0"))


@dataclass
class Bench:
    """A worker on edge1 that answers everything, and the place of an application of robot1."""

    folder: Path
    own: str = field(default_factory=free_endpoint)
    reports: list[RelayReport] = field(default_factory=list)
    taken: list[bytes] = field(default_factory=list)
    keys: list[str] = field(default_factory=list)
    """The worker's keys of these."""

    def __post_init__(self) -> None:
        self.relay = Relay()
        dialled = (self.relay.endpoint, self.own)
        config = worker_config(connect=dialled, listen=(), shared_memory=False, dials_by_gossip=False)
        self.worker = Worker.from_env(environment_on("edge1", self.folder, config))
        self._answers = self.worker.publisher("{prefix}/{epoch}/robot1/out", reliable=True)
        self.worker.subscribe("{prefix}/robot1/*/in", self._echo)
        self.worker.ready()
        self.relay.tell(WorkerRole.ACTIVE, 1)
        until(lambda: self.worker.role.role is WorkerRole.ACTIVE, "the worker is the owner")
        self.application = self.open()

    def open(self) -> Application:
        """The relay's side, as it is after the relay's start."""
        made = Application("test", "robot1", self.folder / "robot1.streams", self.own, self.reports.append)
        made.unowned("t", (IN,))
        made.open(data_config(listen=(free_endpoint(),), connect=(), shared_memory=False))
        made.plan(PLAN)
        return made

    def _echo(self, sample: Input) -> None:
        self.keys.append(sample.key)
        self.taken.append(sample.payload.to_bytes())
        self._answers.put(sample.payload.to_bytes())

    def join(self) -> Streams:
        return Streams.join(runtime_dir=self.folder)

    def count(self) -> StreamCount:
        return self.application.added(NONE)[0]

    def close(self) -> None:
        self.worker.close()
        self.relay.session.close()


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path)
    yield made
    made.close()


def test_what_is_put_is_processed_answered_and_counted_and_the_streams_outlive_the_relay(bench: Bench) -> None:
    back: list[tuple[str, int]] = []

    def take(answer: Received) -> None:
        back.append((answer.key, int(answer.payload.to_bytes())))

    with bench.join() as own:
        assert own.node == "robot1"
        own.subscribe("robot1/out", take)
        publisher = own.publisher("robot1/front/in")
        for number in range(200):
            assert publisher.put(str(number))
        until(lambda: len(back) == 200, "all answers")
        assert back == [("robot1/out", number) for number in range(200)]
        until(lambda: bench.count().acknowledged == 200, "the relay's counters have them")
        bench.application.lose_daemon()
        old, bench.application = bench.application, bench.open()
        assert old._link is not None
        old._link.hang_up()
        publisher.put("200")
        until(lambda: len(back) == 201, "answers without a relay")
        until(lambda: bench.count().acknowledged == 201, "the next relay's counters have all")
    assert not publisher.put("201"), "closed"
    assert unaccounted(bench.count()) == 0
    assert bench.count().at_most_lost == 0
    assert bench.taken == [str(number).encode() for number in range(201)]


def test_the_applications_own_servers_may_speak_first(bench: Bench) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, bench.join():
        assert not server.getsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT)
        with socket.create_connection(server.getsockname()) as client:
            server.settimeout(5.0)
            with server.accept()[0] as taken:
                taken.sendall(b"$GPGGA")
                assert client.recv(6) == b"$GPGGA"


@pytest.mark.parametrize(
    "wrong",
    [{"payload": None}, {"payload": {}}, {"attachment": 1}, {"encoding": 1}, {"timestamp": 1.0}],
    ids=["None", "dict", "attachment", "encoding", "timestamp"],
)
def test_an_argument_that_zenoh_does_not_take_is_refused_and_takes_no_number(
    bench: Bench, wrong: dict[str, Any]
) -> None:
    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        arguments: dict[str, Any] = {"payload": b"x", **wrong}
        with pytest.raises(TypeError, match=f"{next(iter(wrong))}: "):
            publisher.put(**arguments)
        assert publisher.put(b"good", encoding="text/plain")
        until(lambda: bench.count().acknowledged == 1, "the good one")
    assert bench.taken == [b"good"]
    assert (bench.count().messages, unaccounted(bench.count())) == (1, 0)


def test_closing_ends_every_thread_for_an_interpreter_that_ends_beside_one_may_abort(bench: Bench) -> None:
    def ask() -> None:
        with bench.join() as own:
            own.subscribe("robot1/out", lambda _answer: None)
            own.publisher("robot1/front/in").put(b"1")

    ask()  # threads that the relay and the worker of this process begin now stay
    before = running()
    ask()
    left = sorted(thread.name for thread in running() - before)
    assert [name for name in left if not name.startswith("application")] == []  # that one is the relay's


def test_closing_waits_for_the_threads_in_which_zenoh_calls_back_too() -> None:
    may_return, has_come, before = threading.Event(), threading.Event(), running()

    def take(_sample: zenoh.Sample) -> None:
        has_come.set()
        may_return.wait(10.0)

    config = data_config(listen=(free_endpoint(),), connect=(), shared_memory=False)
    session = zenoh.open(zenoh.Config.from_json5(config))
    try:
        session.declare_subscriber("a/key", take)
        session.put("a/key", b"")
        assert has_come.wait(10.0)
        assert not all_end_within(0.01, besides=before)
        may_return.set()
        session.close()
        assert all_end_within(10.0, besides=before)
    finally:
        may_return.set()
        session.close()


ENDS = """
import os, signal, sys, threading, time
from pathlib import Path
from zsched.stream import Streams

with Streams.join(runtime_dir=Path(sys.argv[1])) as streams:
    answered, is_over = threading.Event(), []

    def take(answer):
        answered.set()
        {in_callback}

    streams.subscribe("robot1/out", take)
    publisher = streams.publisher("robot1/front/in")
    for number in range(20):
        publisher.put(str(number))
    answered.wait(20)
    {at_last}
"""
INTERRUPTS = "threading.Timer({}, lambda: os.kill(os.getpid(), signal.SIGINT)).start()"
INTERRUPTED = (1, -signal.SIGINT)
"""How Python ends behind `KeyboardInterrupt`."""


@pytest.mark.parametrize(
    ("in_callback", "at_last", "codes"),
    [
        ("streams.close()", "", (0,)),
        ("time.sleep(0.1)", INTERRUPTS.format(0.0) + "; time.sleep(1.0)", INTERRUPTED),
        ("time.sleep(0.1)", INTERRUPTS.format(0.4), INTERRUPTED),
        ("", "if os.fork() == 0: sys.exit(0)\n    assert os.wait()[1] == 0", (0,)),
    ],
    ids=["closed in a callback while the program ends", "Ctrl-C", "Ctrl-C while it closes", "a fork that ends"],
)
def test_a_program_ends_in_order_whatever_ends_it(
    bench: Bench, in_callback: str, at_last: str, codes: tuple[int, ...]
) -> None:
    text = ENDS.format(in_callback=in_callback, at_last=at_last)
    done = subprocess.run([sys.executable, "-c", text, str(bench.folder)], capture_output=True, timeout=30, check=False)
    assert done.returncode in codes, done.stderr
    assert b"FATAL" not in done.stderr
    until(lambda: bench.application._link is None, "it has gone")
    assert (bench.count().messages, unaccounted(bench.count())) == (20, 0)
    assert bench.count().acknowledged == 20


STOPPED = """
import os, signal, sys, threading
from pathlib import Path
from zsched.errors import AdapterError
from zsched.relay.streams.counter import StreamCounter
from zsched.stream import Streams, link

streams = Streams.join(runtime_dir=Path(sys.argv[1]))
signal.signal(signal.SIGTERM, lambda *_: streams.close())
publisher = streams.publisher("robot1/front/in")
publisher.put("0")
inner = {inner}

def interrupted(*words):
    if threading.current_thread() is threading.main_thread():
        {inner} = inner
        os.kill(os.getpid(), signal.SIGTERM)
    return inner(*words)

{inner} = interrupted
try:
    {call}
except AdapterError:
    pass
assert streams._closing.is_set()
assert not publisher.put("2")
streams.close()
assert streams._closed.is_set()
"""


@pytest.mark.parametrize(
    ("inner", "call"),
    [
        ("StreamCounter.seen", 'publisher.put("1")'),
        ("link.write_frame", 'streams.subscribe("robot1/out", print)'),
        ("link.write_frame", 'streams.publisher("robot1/back/in")'),
    ],
    ids=["put", "subscribe", "publisher"],
)
def test_a_signal_that_closes_in_the_middle_of_a_call_does_not_wait_for_that_call(
    bench: Bench, inner: str, call: str
) -> None:
    """Its handler runs in the thread that has the locks which closing needs."""
    command = [sys.executable, "-c", STOPPED.format(inner=inner, call=call), str(bench.folder)]
    done = subprocess.run(command, capture_output=True, timeout=30, check=False)
    assert done.returncode == 0, done.stderr
    until(lambda: bench.application._link is None, "it has gone")
    assert bench.count().acknowledged == len(bench.taken)
    assert unaccounted(bench.count()) == 0


CLOSED_TWICE = """
import signal, sys, threading
from pathlib import Path
from zsched.stream import Streams

own = Streams.join(runtime_dir=Path(sys.argv[1]))
signal.signal(signal.SIGTERM, lambda *_: own.close())
left = {after}

def interrupted(frame, event, _):
    global left
    if event == "line" and Path(frame.f_code.co_filename).name in ("threading.py", "latch.py"):
        left -= 1
        if left == 0:
            signal.raise_signal(signal.SIGTERM)
    return interrupted

sys.settrace(interrupted)
own.close()
sys.settrace(None)
assert own._closed.is_set()
"""


@pytest.mark.parametrize("after", range(1, 8))
def test_a_signal_that_closes_in_the_middle_of_a_close_waits_as_that_one_does(bench: Bench, after: int) -> None:
    """Its handler waited for the lock of the event that the call which it had interrupted was setting."""
    command = [sys.executable, "-c", CLOSED_TWICE.format(after=after), str(bench.folder)]
    assert subprocess.run(command, timeout=30, check=False).returncode == 0


def test_answers_are_the_applications_from_the_moment_it_names_them_until_it_goes(bench: Bench) -> None:
    """The relay counts them, too: no answer counts twice or nowhere, and the times of a reading between are told."""
    counted = StreamCount(stream="t/out/0")

    def of_relay() -> StreamCount:
        return bench.application.apart((NONE[0], replace(counted, gap_s=0.1)))[1]

    bench.application.counts = lambda: (NONE[0], counted)
    with bench.join() as own:
        counted = replace(counted, messages=7, gap_s=0.4)
        own.subscribe("robot1/out", lambda _answer: None)
        assert [of_relay().gap_s, of_relay().gap_s] == [0.4, 0.1]
        assert of_relay().messages == 7
        counted = replace(counted, messages=10)
    until(lambda: bench.application._link is None, "it has gone")
    assert of_relay().messages == 7
    counted = replace(counted, messages=12)
    assert of_relay().messages == 9


def test_one_key_too_many_is_refused_and_takes_nothing_from_the_others(bench: Bench) -> None:
    """It was remembered: no other one was told to the relay, and the next relay was never told of any."""
    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        for number in range(MAX_KEYS - 1):
            own._name(f"robot1/{number}/in")
        with pytest.raises(ValueError, match=f"{MAX_KEYS + 1} keys, at most {MAX_KEYS}"):
            own.publisher("robot1/more/in")
        with pytest.raises(ValueError, match=f"{MAX_KEYS + 1} keys, at most {MAX_KEYS}"):
            own.subscribe("robot1/out", lambda _answer: None)
        assert own._callbacks == ()
        old, bench.application = bench.application, bench.open()
        assert old._link is not None
        old._link.hang_up()
        until(lambda: bench.application._link is not None, "the next relay hears of it")
        assert publisher.put(b"x")
        until(lambda: bench.taken == [b"x"], "it is processed")


def test_a_second_one_who_closes_waits_until_they_are_closed(bench: Bench) -> None:
    own = bench.join()
    own.subscribe("robot1/out", lambda _answer: time.sleep(0.3))
    own.publisher("robot1/front/in").put("0")
    first = threading.Thread(target=own.close)
    first.start()
    until(own._closing.is_set, "the first one closes")
    own.close()
    assert not own._thread.is_alive()
    first.join(10)
    assert not first.is_alive()


def test_closing_waits_for_what_was_put_and_for_its_answers(bench: Bench) -> None:
    back: list[bytes] = []

    def take(answer: Received) -> None:
        time.sleep(0.005)
        back.append(answer.payload.to_bytes())

    with bench.join() as own:
        own.subscribe("robot1/out", take)
        publisher = own.publisher("robot1/front/in")
        for number in range(50):
            publisher.put(str(number))
    assert back == [str(number).encode() for number in range(50)]
    assert bench.count().acknowledged == 50


@pytest.mark.parametrize("stream_class", [StreamClass.BEST_EFFORT, StreamClass.LATEST])
def test_the_other_classes_arrive_and_a_kept_value_goes_to_the_next_owner(
    bench: Bench, stream_class: StreamClass
) -> None:
    keep_last = 1 if stream_class is StreamClass.LATEST else 0
    route = replace(IN, settings=StreamSettings(stream_class=stream_class, depth=1000, keep_last=keep_last))
    bench.application.unowned("t", (route,))
    bench.application.plan(replace(PLAN, current=replace(SLOT, routes=(route,))))
    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        source = own._tasks["t"].input("t/in/0")
        assert source is not None
        until(lambda: source.is_matching(1), "the worker subscribes")
        for number in range(50):
            publisher.put(str(number))
        until(lambda: bench.taken and bench.taken[-1] == b"49", "the newest")
        until(lambda: bench.count().messages == 50 and not bench.count().in_flight, "it is counted")
        assert unaccounted(bench.count()) == 0
        del bench.taken[:]
        bench.application.plan(replace(PLAN, current=replace(SLOT, epoch=2, routes=(route,))))
        if stream_class is StreamClass.LATEST:
            until(lambda: bench.taken[:1] == [b"49"], "the kept value, at least once more")
        publisher.put("50")
        until(lambda: bench.taken and bench.taken[-1] == b"50", "by the next slot")


def test_a_key_that_comes_while_the_next_relay_is_greeted_is_told_to_that_one(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    key, had = "robot1/back/in", list[bool]()
    with bench.join() as own:
        own.publisher("robot1/front/in")
        old, say, was_said = own._link, own._link.say, threading.Event()

        def say_to_old(word: RelayReport | StreamKeys) -> None:
            say(word)
            if isinstance(word, StreamKeys) and key in word.keys:
                was_said.set()

        def ask() -> None:
            try:
                had.append(own.publisher(key).put(b"1"))
            except ValueError:
                had.append(False)

        def greet(path: Path, keys: tuple[str, ...]) -> Link:
            made = Link(path, keys)
            threading.Thread(target=ask, daemon=True).start()
            assert was_said.wait(10), "the old one is told"
            return made

        monkeypatch.setattr(old, "say", say_to_old)
        monkeypatch.setattr(streams, "Link", greet)
        assert bench.application._link is not None
        bench.application._link.hang_up()
        until(lambda: had, "it is known, or refused")
        assert had == [True]
    assert bench.taken == [b"1"]


@pytest.mark.parametrize("error", [RuntimeError("can't start new thread"), OSError("no more of it")])
def test_an_application_that_could_not_be_let_in_leaves_the_place_to_the_next(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(application._Link, "start", Mock(side_effect=error))
        with pytest.raises(AdapterError):
            Link(bench.folder / "robot1.streams", ())
    until(lambda: bench.application._link is None, "the place is free")
    with bench.join() as own:
        own.publisher("robot1/front/in").put("0")
    assert bench.taken == [b"0"]


def rules(*names: str) -> RoutePlan:
    """A plan with one input for each of these keys, in this order."""
    routes = tuple(
        replace(IN, stream=f"t/in/{place}", from_expr=f"robot1/{name}/in", to_expr=f"edge1/t/robot1/{name}/in")
        for place, name in enumerate(names)
    )
    return replace(PLAN, current=replace(SLOT, routes=routes))


def test_a_publisher_follows_its_rule_to_another_place_and_its_task_to_another_life(bench: Bench) -> None:
    """A stream's name is its rule's place in the fleet file: another rule may have it from one moment to the next."""
    bench.application.unowned("t", ())
    bench.application.plan(rules("jobs", "map"))
    with bench.join() as own:
        publishers = {name: own.publisher(f"robot1/{name}/in") for name in ("jobs", "map")}

        sent: list[bytes] = []

        def adopt(*names: str) -> None:
            bench.application.plan(rules(*names))
            ours = [name for name in names if name in publishers]

            def is_adopted() -> bool:
                inputs = own._tasks["t"]._own.inputs if "t" in own._tasks else {}
                found = [inputs[place] for place in sorted(inputs)]
                is_fed = all(source.has_way for source in found)
                return is_fed and [source.route.from_expr for source in found] == [f"robot1/{name}/in" for name in ours]

            until(is_adopted, f"{names}")
            for name, publisher in publishers.items():
                assert publisher.put(name) is (name in ours), (name, names)
            sent.extend(sorted(name.encode() for name in ours))
            until(lambda: len(bench.taken) >= len(sent), f"{names}: {bench.taken}")

        adopt("jobs", "map")
        adopt("map", "jobs")
        adopt("other", "jobs", "map")
        adopt("map")
        adopt("map", "jobs")
        adopt()
        bench.application.end("t")
        until(lambda: "t" not in own._tasks, "the task has ended")
        adopt("jobs", "map")
        assert bench.keys == [f"edge1/t/robot1/{taken.decode()}/in" for taken in bench.taken]
        assert sorted(bench.taken) == sorted(sent)


def _is_matching(own: Streams, task: str) -> bool:
    source = own._tasks[task].input(f"{task}/in/0")
    return source is not None and source.is_matching(1)


def test_a_key_that_two_tasks_take_goes_to_the_owner_of_each_also_of_one_that_comes_later(bench: Bench) -> None:
    heard: dict[str, list[bytes]] = {"u": [], "v": []}
    dials = data_config(listen=(free_endpoint(),), connect=(bench.own,), shared_memory=False)

    def hear(sample: zenoh.Sample) -> None:
        heard[str(sample.key_expr).split("/")[1]].append(sample.payload.to_bytes())

    def plan(task: str) -> RoutePlan:
        to_expr = f"edge2/{task}/robot1/*/in"
        route = replace(IN, stream=f"{task}/in/0", to_expr=to_expr, settings=StreamSettings())
        current = Slot(epoch=1, owner="edge2", routes=(route,), ready_when=ReadyWhen.MATCHING)
        return replace(PLAN, task=task, current=current)

    bench.application.plan(plan("u"))
    with bench.join() as own, zenoh.open(zenoh.Config.from_json5(dials)) as foreign:
        kept = foreign.declare_subscriber("edge2/*/robot1/*/in", hear)
        publisher = own.publisher("robot1/front/in")
        until(lambda: _is_matching(own, "u"), "the other owner is seen")
        assert publisher.put(b"1")
        until(lambda: (bench.taken, heard["u"]) == ([b"1"], [b"1"]), "both owners have it", 20)
        bench.application.plan(plan("v"))
        until(lambda: "v" in own._tasks, "the task that comes while the application runs")
        until(lambda: _is_matching(own, "v"), "its owner is seen")
        assert publisher.put(b"2")
        both = [b"1", b"2"]
        until(lambda: (bench.taken, heard["u"], heard["v"]) == (both, both, [b"2"]), "and all three", 20)
        kept.undeclare()


def test_closing_sends_the_newest_value_that_a_rate_holds_back(bench: Bench) -> None:
    latest = StreamSettings(stream_class=StreamClass.LATEST, max_hz=0.1)
    route = replace(IN, settings=latest)
    bench.application.unowned("t", (route,))
    bench.application.plan(replace(PLAN, current=replace(SLOT, routes=(route, OUT))))
    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        until(lambda: own._tasks["t"].missed is None, "its worker has been warmed up")
        assert publisher.put("0")
        until(lambda: bench.taken == [b"0"], "the first")
        for number in range(1, 4):
            assert publisher.put(str(number))
    assert bench.taken == [b"0", b"3"]
    assert unaccounted(bench.count()) == 0
    assert dict(bench.count().drops) == {"thinned": 3}


class Others:
    """Files that are opened when a connection is closed: one of them has its descriptor."""

    def __init__(self, folder: Path) -> None:
        self._paths = [folder / f"other{number}" for number in range(16)]
        self._files = contextlib.ExitStack()

    def open(self) -> None:
        for path in self._paths:
            self._files.enter_context(path.open("wb"))

    def read(self) -> bytes:
        self._files.close()
        return b"".join(path.read_bytes() for path in self._paths)


def test_no_word_to_the_relay_goes_into_a_file_that_has_the_descriptor_now(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, encode, others = Link(bench.folder / "robot1.streams", ()), wire.encode, Others(tmp_path)
    closer = threading.Thread(target=made.close)

    def close_first(word: object) -> bytes:
        if threading.current_thread() is threading.main_thread():
            closer.start()
            closer.join(0.5)
            others.open()
        return encode(word)

    monkeypatch.setattr(wire, "encode", close_first)
    made.say(StreamKeys(keys=("robot1/front/in",), pid=1))
    closer.join(10)
    assert others.read() == b""
    assert made._socket.fileno() == -1


def test_no_word_to_an_application_goes_into_a_file_that_has_the_descriptor_now(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, others, was_written = Link(bench.folder / "robot1.streams", ()), Others(tmp_path), threading.Event()
    link = bench.application._link
    assert link is not None

    def close_first(descriptor: int, frame: bytes) -> None:
        made.close()
        halt = time.monotonic() + 0.5
        while link.connection.fileno() != -1 and time.monotonic() < halt:
            time.sleep(0.01)
        others.open()
        try:
            write_frame(descriptor, frame)
        finally:
            was_written.set()

    monkeypatch.setattr(application, "END_S", 30.0)
    monkeypatch.setattr(application, "write_frame", close_first)
    bench.application.lose_daemon()
    assert was_written.wait(10)
    until(lambda: link.connection.fileno() == -1, "its descriptor is given back")
    assert others.read() == b""


@pytest.mark.parametrize(("names", "is_taken"), [(("map", "jobs"), True), (("map",), False)], ids=["moves", "goes"])
def test_what_is_put_while_its_rule_moves_or_goes_arrives_or_is_refused(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, names: tuple[str, ...], *, is_taken: bool
) -> None:
    give = InputStream.give
    bench.application.unowned("t", ())
    bench.application.plan(rules("jobs", "map"))
    with bench.join() as own:
        publisher = own.publisher("robot1/jobs/in")
        source = own._tasks["t"].input("t/in/0")

        def has_way() -> bool:
            found = [one for one in own._inputs() if one.route.from_expr == publisher.key]
            return bool(found) and all(one.has_way for one in found)

        def change_first(stream: InputStream, sample: zenoh.Sample) -> bool:
            if stream is source:
                bench.application.plan(rules(*names))
                until(lambda: own._tasks["t"].input("t/in/0") is not source, "it is closed")
                until(lambda: has_way() is is_taken, "it has another place, or none")
            return give(stream, sample)

        monkeypatch.setattr(InputStream, "give", change_first)
        assert publisher.put("1") is is_taken
    assert bench.taken == [b"1"][:is_taken]


def test_what_is_wrong_is_told_until_it_is_mended_whatever_becomes_of_another_task(bench: Bench) -> None:
    def told() -> str:
        words = [word.problem for word in tuple(bench.reports) if isinstance(word, ProblemReported)]
        return words[-1] or "" if words else ""

    text = "{}: the application does not see the owner's worker"
    anew = "its session is that of an earlier configuration"
    with bench.join() as own:
        for task in ("a", "b"):
            own._report(SlotReady(task=task, epoch=1, is_ready=False, has_token=False))
        until(lambda: told() == f"{text.format('a')}; {text.format('b')}", f"both: {told()}")
        own._report(SlotReady(task="b", epoch=1))
        until(lambda: told() == text.format("a"), f"the other one stays: {told()}")
        own._config = "of an earlier relay"
        assert bench.application._link is not None
        bench.application._link.hang_up()
        until(lambda: told() == f"{anew}: start the application again; {text.format('a')}", f"once more: {told()}")
        own._report(SlotReady(task="a", epoch=1))
        until(lambda: told() == f"{anew}: start the application again", f"that stays: {told()}")


def test_what_is_put_first_has_a_way_already(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    take = OwnTask._take

    def slow(task: OwnTask, plan: RoutePlan) -> None:
        time.sleep(0.3)
        take(task, plan)

    monkeypatch.setattr(OwnTask, "_take", slow)
    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        for number in range(5):
            publisher.put(str(number))
    assert (bench.count().acknowledged, bench.count().drops) == (5, ())


def test_an_application_that_has_ended_is_not_waited_for_when_the_task_moves(bench: Bench) -> None:
    with bench.join() as own:
        own.publisher("robot1/front/in").put("0")
    bench.relay.tell(WorkerRole.DRAINING, 1)
    until(lambda: bench.relay.ends, "the worker has ended the epoch: all its inputs have")


def test_an_application_is_told_why_it_cannot_have_a_stream(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "KNOWN_S", 0.3)
    with bench.join() as own:
        with pytest.raises(AdapterError, match="has streams of robot1 itself; one may at a time"):
            bench.join()
        with pytest.raises(ValueError, match="no input rule takes 'robot1/other' on robot1"):
            own.publisher("robot1/other")
        with pytest.raises(ValueError, match="it has wildcards"):
            own.publisher("robot1/*/in")
        with pytest.raises(ValueError, match="no output rule has 'robot1/none' on robot1"):
            own.subscribe("robot1/none", lambda _answer: None)
    for ask in (own.publisher, lambda key: own.subscribe(key, lambda _answer: None)):
        with pytest.raises(AdapterError, match="the streams of robot1 are closed"):
            ask("robot1/front/in")
    with pytest.raises(
        AdapterError, match=r"no relay answers at .*/robot7\.streams: the robot needs `listen: {streams"
    ):
        Streams.join(node="robot7", runtime_dir=bench.folder, wait_s=0.0)
    with pytest.raises(AdapterError, match="no relay lets applications have their streams themselves in"):
        Streams.join(runtime_dir=bench.folder / "elsewhere", wait_s=0.0)


def test_a_stranger_at_the_socket_raises_nothing(bench: Bench) -> None:
    """What it says of slots and streams that are not its own counts for nothing, and garbage ends its link."""
    with bench.join() as own:
        own.publisher("robot1/front/in")
        own._link.say(SlotLost(task="t", epoch=77, owner="edge1", samples=9))
        own._link.say(SlotDrained(task="u", epoch=1))
        own._link._socket.sendall(b"\xff" * 64)
        until(lambda: bench.application._link is None, "it is heard no more")
        assert not [word for word in bench.reports if isinstance(word, SlotLost | SlotDrained)]
        until(lambda: bench.application._link is not None, "it comes again")


def test_a_flip_does_not_wait_for_a_put_that_waits_for_its_link(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    gate, began, put = threading.Event(), threading.Event(), Lane.put

    def slow(lane: Lane, sample: zenoh.Sample, stamp: zenoh.Timestamp | None) -> None:
        began.set()
        gate.wait(10)
        put(lane, sample, stamp)

    monkeypatch.setattr(Lane, "put", slow)
    session = bench.relay.session
    stream = InputStream(session, IN, frozenset(), is_ours=True)
    heard: list[bytes] = []
    kept = [
        session.declare_subscriber(f"e{epoch}/*", lambda sample: heard.append(sample.payload.to_bytes()))
        for epoch in (1, 2)
    ]
    for epoch in (1, 2):
        to = Route(
            stream=IN.stream, direction=IN.direction, from_expr=IN.from_expr, to_expr=f"e{epoch}/*", settings=SETTINGS
        )
        stream.open(epoch, to)
    stream.flip(1)
    given = [cast("zenoh.Sample", Given("robot1/a/in", zenoh.ZBytes(str(number)))) for number in range(2)]
    first = threading.Thread(target=stream.give, args=(given[0],), daemon=True)
    first.start()
    assert began.wait(5)
    flip = threading.Thread(target=stream.flip, args=(2,), daemon=True)
    flip.start()
    flip.join(2)
    assert not flip.is_alive(), "the flip waits"
    gate.set()
    first.join(5)
    stream.give(given[1])
    until(lambda: sorted(heard) == [b"0", b"1"], "both, each to its owner")
    stream.close()
    for one in kept:
        one.undeclare()


@pytest.mark.parametrize("error", [ValueError("no plan"), SystemExit(3), CancelledError("end")])
def test_what_a_callback_raises_takes_no_answer_from_another_one(
    bench: Bench, error: BaseException, caplog: pytest.LogCaptureFixture
) -> None:
    back: list[bytes] = []

    def fail(_answer: Received) -> None:
        raise error

    with bench.join() as own:
        own.subscribe("robot1/out", fail)
        own.subscribe("robot1/out", lambda answer: back.append(answer.payload.to_bytes()))
        publisher = own.publisher("robot1/front/in")
        for number in range(5):
            publisher.put(str(number))
    assert back == [str(number).encode() for number in range(5)]
    assert caplog.text.count(f"the callback of robot1/out raised {type(error).__name__}: {error}") == 5
    assert caplog.text.count("Traceback") == 1, "the same error again says nothing new"


def test_a_callback_of_which_nothing_would_run_is_told(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    async def later(_answer: Received) -> None:
        raise AssertionError("it is never run")

    with bench.join() as own:
        own.subscribe("robot1/out", later)  # type: ignore[arg-type] # an author's mistake
        own.publisher("robot1/front/in").put("0")
    assert "the callback of robot1/out raised TypeError: a callback must be a plain function" in caplog.text


def test_answers_that_closing_does_not_wait_for_are_counted_and_told(
    bench: Bench, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(streams, "FINISH_S", 0.3)
    had: list[bytes] = []
    gate = threading.Event()

    def slow(answer: Received) -> None:
        had.append(answer.payload.to_bytes())
        gate.wait(10)

    own = bench.join()
    own.subscribe("robot1/out", slow)
    publisher = own.publisher("robot1/front/in")
    for number in range(6):
        publisher.put(str(number))
    until(lambda: own._tasks["t"].counts()[1].messages == 6, "all have come")
    threading.Timer(1.0, gate.set).start()
    own.close()
    until(lambda: bench.application._link is None, "the relay has heard the last counters")
    out = bench.application.added(NONE)[1]
    assert had == [b"0"]
    assert (out.messages, out.drops) == (6, (("slow_reader", 5),))
    assert "t/out/0: 5 answers had not been handed over when the streams closed" in caplog.text


def test_answers_that_wait_when_their_rule_goes_are_counted_and_not_waited_for(bench: Bench) -> None:
    gate, had = threading.Event(), list[bytes]()

    def slow(answer: Received) -> None:
        had.append(answer.payload.to_bytes())
        gate.wait(10)

    with bench.join() as own:
        own.subscribe("robot1/out", slow)
        publisher = own.publisher("robot1/front/in")
        task = own._tasks["t"]
        for number in range(6):
            publisher.put(str(number))
        until(lambda: task.counts()[1].messages == 6 and had, "all have come")
        bench.application.plan(replace(PLAN, current=replace(SLOT, routes=(IN,))))
        until(lambda: len(task.counts()) == 1, "the output is gone")
        gate.set()
        until(task.has_handed, "nothing is left to be handed over")
        bench.application.plan(PLAN)
        until(lambda: len(task.counts()) == 2, "the output is there again")
        assert (task.counts()[1].messages, task.counts()[1].drops) == (6, (("closed", 5),))
    assert had == [b"0"]


def test_what_comes_too_late_to_be_put_is_told_to_the_one_who_puts_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It waited behind a put that held its link up, while another thread closed."""
    gate, began, put = threading.Event(), threading.Event(), Lane.put
    monkeypatch.setattr(streams, "FINISH_S", 0.3)

    def slow(lane: Lane, sample: zenoh.Sample, stamp: zenoh.Timestamp | None) -> None:
        began.set()
        gate.wait(10)
        put(lane, sample, stamp)

    own = bench.join()
    publisher = own.publisher("robot1/front/in")
    publisher.put("0")
    until(lambda: bench.taken == [b"0"], "the worker is greeted, and nothing waits")
    until(lambda: not own._tasks["t"].under_way(), "it is acknowledged")
    monkeypatch.setattr(Lane, "put", slow)
    took: list[bool] = []
    givers = [threading.Thread(target=lambda: took.append(publisher.put("1"))) for _ in range(3)]
    givers[0].start()
    assert began.wait(5)
    for one in givers[1:]:
        one.start()
    closer = threading.Thread(target=own.close)
    closer.start()
    until(lambda: bench.application._link is None, "the relay has heard the last counters")
    gate.set()
    for one in (*givers, closer):
        one.join(10)
        assert not one.is_alive()
    assert (bench.count().messages, sorted(took)) == (2, [False, False, True])


def test_ctrl_c_in_a_put_costs_no_other_sample(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Behind a put that has waited, as on a busy machine, the queue's thread takes what comes: Ctrl-C is not there."""
    put, caller, sent = Lane.put, threading.current_thread(), [b"0"]

    def interrupted(lane: Lane, sample: zenoh.Sample, stamp: zenoh.Timestamp | None) -> None:
        put(lane, sample, stamp)
        if threading.current_thread() is caller:
            raise KeyboardInterrupt

    with bench.join() as own:
        publisher = own.publisher("robot1/front/in")
        publisher.put(sent[0])

        def is_interrupted() -> bool:
            until(lambda: bench.taken == sent and not own._tasks["t"].under_way(), "nothing waits")
            sent.append(str(len(sent)).encode())
            try:
                publisher.put(sent[-1])
            except KeyboardInterrupt:
                return True
            return False

        with monkeypatch.context() as patched:
            patched.setattr(Lane, "put", interrupted)
            until(is_interrupted, "a put in this thread")
        sent.append(b"behind it")
        assert publisher.put(sent[-1])
    assert bench.taken == sent
    count, whole = bench.count(), len(sent)
    assert (count.messages, count.acknowledged, count.at_most_lost, count.doubled) == (whole, whole, 0, 0)
