"""What late subscribers get from caches, and that a frozen publisher never holds up a live one."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest
import zenoh
from zenoh import ext

from support.sessions import matches
from support.signals import stand_still
from support.waiting import free_endpoint, until
from zsched.core.values.fleet import Timing
from zsched.core.values.plan import StreamClass, StreamSettings
from zsched.link.sessions.config import data_config, worker_config
from zsched.relay.streams import history
from zsched.relay.streams.questions import Question, Questions
from zsched.relay.streams.receive import Receiver

KEY = "robot1/map"
QUERY_S = 90.0
"""How long the cache of a dead publisher is asked in one test; a stream that waited for it would not come in time."""
PATIENT = Timing(zenoh_lease_s=60.0)
"""A frozen publisher stays linked: what it owes is not told again by the end of its lease."""
SETTINGS = StreamSettings(stream_class=StreamClass.LATEST, keep_last=2, depth=100)
PUBLISHER = """
import sys, zenoh
from pathlib import Path
from zenoh import ext
session = zenoh.open(zenoh.Config.from_json5(Path(sys.argv[1]).read_text()))
options = dict(
    cache=ext.CacheConfig(2),
    sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.1),
    publisher_detection=True,
)
publisher = ext.declare_advanced_publisher(session, "robot1/map", **options)
for number in range(3):
    publisher.put(f"frozen {number}")
print("up", flush=True)
sys.stdin.read()
"""


def lost(_sample: zenoh.Sample) -> None:
    pytest.fail("nothing of class `latest` gives way")


class Net:
    """The relay's session and an application's."""

    def __init__(self) -> None:
        self.endpoint = free_endpoint()
        self.relay = zenoh.open(
            zenoh.Config.from_json5(data_config(listen=(self.endpoint,), connect=(), timing=PATIENT))
        )
        self.app = zenoh.open(zenoh.Config.from_json5(worker_config(connect=(self.endpoint,), timing=PATIENT)))
        self.got: list[str] = []
        self.receivers: list[Receiver] = []

    def receive(self, key: str = KEY) -> None:
        take = lambda sample: self.got.append(sample.payload.to_string())  # noqa: E731 - named for its use below
        self.receivers.append(Receiver(self.relay, key, SETTINGS, take, with_history=True, give_way=lost))

    def advanced(self, key: str = KEY) -> ext.AdvancedPublisher:
        return ext.declare_advanced_publisher(
            self.app,
            key,
            cache=ext.CacheConfig(2),
            sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
            publisher_detection=True,
        )

    def close(self) -> None:
        for receiver in self.receivers:
            receiver.close()
        self.app.close()
        self.relay.close()


@pytest.fixture
def net() -> Iterator[Net]:
    made = Net()
    try:
        yield made
    finally:
        made.close()


def test_a_late_subscriber_gets_what_the_cache_holds_then_the_live_ones_once(net: Net) -> None:
    publisher = net.advanced()
    for number in range(4):
        publisher.put(str(number))
    net.receive()
    until(lambda: net.got == ["2", "3"], "the two that are kept")
    publisher.put("4")
    until(lambda: net.got == ["2", "3", "4"], "the live one")


def test_a_publisher_that_comes_late_is_asked_too(net: Net, tmp_path: Path) -> None:
    net.receive()
    with publisher(net, tmp_path):
        until(lambda: "frozen 2" in net.got, "the cache of a publisher that put before it was connected")
    assert net.got == sorted(set(net.got))


def test_a_publisher_that_stood_still_while_it_was_asked_is_asked_again(
    net: Net, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else the value that it holds would never come: it does not put it again."""
    monkeypatch.setattr(history, "TIMEOUT_S", 0.1)
    unanswered: list[str] = []
    under_way: list[Question] = []
    ended, begin = Questions.ended, Questions.next

    def note_begin(questions: Questions, now: float) -> Question | None:
        question = begin(questions, now)
        under_way.extend([] if question is None else [question])
        return question

    def note(questions: Questions, question: Question, now: float, *, is_whole: bool) -> None:
        if not is_whole:
            unanswered.append(question.selector)
        under_way.remove(question)
        ended(questions, question, now, is_whole=is_whole)

    monkeypatch.setattr(Questions, "next", note_begin)
    monkeypatch.setattr(Questions, "ended", note)
    with publisher(net, tmp_path) as process:
        until(lambda: any(net.relay.liveliness().get(f"{KEY}/@adv/**")), "the publisher's token")
        ask = partial(net.relay.get, f"{KEY}/@adv/**", accept_replies=zenoh.ReplyKeyExpr.ANY)
        until(lambda: any(ask()), "its cache: a question for what is not known yet is sent to nobody")
        stand_still(process)
        net.receive()
        until(lambda: unanswered and not under_way, "every question so far has ended without an answer")
        assert not net.got
        monkeypatch.undo()
        process.send_signal(signal.SIGCONT)
        until(lambda: net.got == ["frozen 1", "frozen 2"], "what it holds")


def test_wild_keys_have_caches_each(net: Net) -> None:
    publishers = {name: net.advanced(f"robot1/{name}/map") for name in "ab"}
    for name, one in publishers.items():
        one.put(name)
    net.receive("robot1/*/map")
    until(lambda: sorted(net.got) == ["a", "b"], "both caches")


def test_all_of_many_publishers_that_appear_at_once_are_asked(net: Net) -> None:
    """A relay that comes back finds an application with 600 of them: each one's value is there."""
    endpoint, names = free_endpoint(), [f"robot1/{number}/map" for number in range(600)]
    with zenoh.open(zenoh.Config.from_json5(worker_config(connect=(endpoint,)))) as app:
        kept = [
            ext.declare_advanced_publisher(
                app,
                name,
                cache=ext.CacheConfig(1),
                sample_miss_detection=ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=None),
                publisher_detection=True,
            )
            for name in names
        ]
        for name, one in zip(names, kept, strict=True):
            one.put(name)
        with zenoh.open(zenoh.Config.from_json5(data_config(listen=(endpoint,), connect=()))) as relay:
            settings = StreamSettings(stream_class=StreamClass.LATEST, keep_last=1, depth=2000)
            take = lambda sample: net.got.append(sample.payload.to_string())  # noqa: E731 - named for its use below
            receiver = Receiver(relay, "robot1/*/map", settings, take, with_history=True, give_way=lost)
            until(lambda: len(set(net.got)) == len(names), "every value", 60.0)
            assert sorted(net.got) == sorted(names), "and each once"
            receiver.close()
        for one in kept:
            one.undeclare()


def test_a_publisher_without_numbers_is_not_taken_for_double(net: Net) -> None:
    net.receive()
    plain = net.app.declare_publisher(KEY)
    until(lambda: matches(plain), "the relay subscribes")
    for _ in range(3):
        plain.put("same")
    until(lambda: net.got == ["same"] * 3, "all three")


def test_keys_that_come_and_go_for_weeks_take_no_more_memory(net: Net, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(history, "MAX_SOURCES", 8)
    net.receive("robot1/*/map")
    first = net.app.declare_publisher("robot1/0/map")
    until(lambda: matches(first), "the relay subscribes")
    for number in range(32):
        net.app.put(f"robot1/{number}/map", str(number), congestion_control=zenoh.CongestionControl.BLOCK)
    until(lambda: net.got == [str(number) for number in range(32)], "all of them")
    held = net.receivers[0]._history
    assert held is not None
    assert list(held._live) == [f"robot1/{number}/map" for number in range(24, 32)]


class publisher:  # noqa: N801 - reads as a verb in a with statement
    """A process that holds values of the key."""

    def __init__(self, net: Net, folder: Path) -> None:
        path = folder / "config.json5"
        path.write_text(worker_config(connect=(net.endpoint,), timing=PATIENT))
        command = [sys.executable, "-c", PUBLISHER, str(path)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)

    def __enter__(self) -> subprocess.Popen[bytes]:
        assert self.process.stdout is not None
        assert self.process.stdout.readline() == b"up\n"
        return self.process

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate(timeout=30)


@pytest.mark.parametrize("fault", [signal.SIGSTOP, signal.SIGKILL])
def test_a_publisher_that_dies_with_a_query_open_holds_no_stream(
    net: Net, tmp_path: Path, fault: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stream of another publisher goes on although a cache that is being asked never answers."""
    monkeypatch.setattr(history, "TIMEOUT_S", QUERY_S)
    live = net.app.declare_publisher(KEY)
    arrivals: list[str] = []
    halt = threading.Event()

    def stream() -> None:
        while not halt.wait(0.01):
            live.put("live")

    thread = threading.Thread(target=stream)
    with publisher(net, tmp_path) as process:
        until(lambda: str(process.pid) and net.relay.info.links(), "links")
        thread.start()
        process.send_signal(fault)
        take = lambda sample: arrivals.append(sample.payload.to_string())  # noqa: E731 - used once
        net.receivers.append(Receiver(net.relay, KEY, SETTINGS, take, with_history=True, give_way=lost))
        try:
            until(lambda: len(arrivals) > 100, "the live stream", deadline_s=60.0)
        finally:
            halt.set()
            thread.join(30)
