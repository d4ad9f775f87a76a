"""What waits in a worker takes no more memory than it may."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from support.waiting import until
from zsched.core.values.relay_protocol import EndMarker
from zsched.link.acknowledger import Acknowledger
from zsched.worker import inputs as worker_inputs
from zsched.worker.inputs import Dispatcher
from zsched.worker.jobs import JobBook
from zsched.worker.keep import Debts
from zsched.worker.samples import Input, KeepLast, Marker, Received
from zsched.worker.troubles import Troubles


class Bench:
    """A dispatcher and what its callback was given; the callback waits while `gate` is closed."""

    def __init__(self) -> None:
        self.troubles = Troubles(lambda _count, _text: None)
        self.jobs = JobBook("t", "1", lambda _jobs: None)
        self.acks = Acknowledger(lambda _session, _frame: None)
        self.ended: list[int] = []
        self.gone: set[str] = set()
        self.dispatcher = Dispatcher(
            self.ended.append, self.acks, self.troubles, Debts(self.acks), self.jobs, self.gone.__contains__
        )
        self.taken: list[str] = []
        self.gate = threading.Event()
        self.gate.set()

    def input(self, keep_last: KeepLast) -> Input:
        return Input(on_sample=self._take, keep_last=keep_last)

    def _take(self, received: Received) -> None:
        self.gate.wait(60)
        self.taken.append(f"{received.key} {received.encoding}")

    def put(self, source: Input, key: str, value: str, number: int | None = None, eid: int = 7) -> None:
        self.dispatcher.put(source, sample(key, value, number, eid))

    def close(self) -> None:
        self.gate.set()
        if self.dispatcher._thread.is_alive():
            self.dispatcher.close()
        self.troubles.close()
        self.acks.close()


def sample(key: str, value: str, number: int | None = None, eid: int = 7) -> zenoh.Sample:
    """As zenoh gives it; with a ``number`` it has a source."""
    source_id = SimpleNamespace(zid="a1", eid=eid)
    made = SimpleNamespace(
        key_expr=key,
        payload=b"",
        attachment=None,
        encoding=value,
        kind=zenoh.SampleKind.PUT,
        timestamp=None,
        congestion_control=zenoh.CongestionControl.BLOCK,
        source_info=None if number is None else SimpleNamespace(source_id=source_id, source_sn=number),
    )
    return cast("zenoh.Sample", made)


@pytest.fixture
def bench() -> Iterator[Bench]:
    made = Bench()
    yield made
    made.close()


def test_what_gave_way_does_not_pile_up_behind_a_callback_that_hangs(bench: Bench) -> None:
    bench.gate.clear()
    newest, whole = bench.input(keep_last=1), bench.input(keep_last=None)
    bench.dispatcher.start()
    bench.put(newest, "a", "first")
    until(lambda: bench.dispatcher._is_busy, "it is in hand")
    longest = 0
    for number in range(10_000):
        bench.put(newest, "a", str(number))
        if number in (10, 9000):
            bench.put(whole, "b", str(number))
        longest = max(longest, len(bench.dispatcher._queue))
    assert longest < 3000
    assert newest.shed == 9_999
    bench.gate.set()
    until(lambda: len(bench.taken) == 4, "what did not give way")
    assert bench.taken == ["a first", "b 10", "b 9000", "a 9999"]
    until(lambda: not bench.dispatcher._queue, "nothing else waits")
    assert bench.dispatcher._dead == 0


def test_what_was_given_up_does_not_pile_up_either(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_inputs, "MAX_DEAD", 10)
    whole = bench.input(keep_last=None)
    for number in range(20):
        bench.put(whole, "a", str(number), number)
        bench.put(whole, "b", str(number))
    bench.dispatcher._give_up(("a", "a1", 7), 0.0)
    assert (len(bench.dispatcher._queue), bench.dispatcher._dead) == (40, 20)
    bench.dispatcher._shed(whole, whole.waiting["b"].popleft())
    assert (len(bench.dispatcher._queue), bench.dispatcher._dead) == (19, 0)
    bench.dispatcher.start()
    until(lambda: len(bench.taken) == 19, "the others")
    assert bench.taken == [f"b {number}" for number in range(1, 20)]


def test_a_key_of_which_nothing_waits_takes_no_memory(bench: Bench) -> None:
    """A wildcard input hears any number of keys."""
    source = bench.input(keep_last=1)
    bench.dispatcher.start()
    for number in range(1000):
        bench.put(source, f"key/{number}", "x")
    until(lambda: len(bench.taken) == 1000, "all of them")
    assert source.waiting == {}


def test_a_key_of_which_everything_was_given_up_takes_no_memory(bench: Bench) -> None:
    source = bench.input(keep_last=None)
    for number in range(3):
        bench.put(source, "a", "x", number)
    bench.put(source, "b", "x")
    bench.dispatcher._give_up(("a", "a1", 7), 0.0)
    assert list(source.waiting) == ["b"]


def test_end_markers_of_strangers_are_not_kept_without_bound(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_inputs, "MAX_SOURCES", 20)
    for number in range(50):
        end = EndMarker(epoch=1, count=5)
        bench.dispatcher.put_marker(Marker(name=(f"key/{number}", "zz", 1), end=end, came_at=0.0))
    assert len(bench.dispatcher._markers) == 20
    bench.dispatcher.start()
    until(lambda: not bench.dispatcher._markers, "they are due in the end")
    bench.dispatcher.put_marker(Marker(name=("key", "zz", 1), end=EndMarker(epoch=3, count=0), came_at=0.0))
    until(lambda: bench.ended == [1, 3], "there is room again")


def test_an_epoch_is_over_when_what_nobody_ends_any_more_is_processed(bench: Bench) -> None:
    source = bench.input(keep_last=None)
    bench.put(source, "a", "x", 0)
    bench.dispatcher.start()
    until(lambda: len(bench.taken) == 1, "the first")
    bench.dispatcher.look_for_end(0)
    until(lambda: not bench.dispatcher._asked, "it was looked")
    assert bench.ended == []
    bench.gate.clear()
    bench.put(source, "a", "x", 1)
    bench.put(source, "a", "x", 2)
    until(lambda: bench.dispatcher._is_busy, "it is in hand")
    bench.gone.add("a1")
    bench.dispatcher.look_for_end(0)
    bench.gate.set()
    until(lambda: bench.ended, "nobody is there who would end it")
    assert len(bench.taken) == 3


def test_sources_that_never_end_are_not_known_for_ever(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody can put as any publisher, and an owner may work in one epoch for months."""
    monkeypatch.setattr(worker_inputs, "MAX_SOURCES", 20)
    source = bench.input(keep_last=None)
    bench.dispatcher.start()
    for number in range(50):
        bench.put(source, f"key/{number}", "x", 0)
        bench.put(source, "relay", "x", number)
    until(lambda: len(bench.taken) == 100, "all of them")
    assert len(bench.dispatcher._open) == 20
    assert ("relay", "a1", 7) in bench.dispatcher._open
    assert not bench.dispatcher.has_ended(0)


def test_sources_that_name_no_slot_hold_up_nobody_for_long(bench: Bench) -> None:
    """Each first sample of one was waited for, in the thread of all callbacks: five frames a second stopped it."""
    source = bench.input(keep_last=None)
    bench.dispatcher.begin(3)
    bench.dispatcher.start()
    began = time.monotonic()
    for number in range(30):
        bench.put(source, f"key/{number}", "x", 0)
    until(lambda: len(bench.taken) == 30, "all of them")
    assert time.monotonic() - began < 3.0, "30 times 0.2 s"


def test_of_each_publisher_of_a_key_the_newest_samples_wait(bench: Bench) -> None:
    """A relay sends what three drivers put on one key by three publishers; one value of all three waited."""
    newest = bench.input(keep_last=1)
    for eid in (7, 8, 9):
        for number in range(2):
            bench.put(newest, "tf_static", f"driver {eid}, {number}", number, eid=eid)
    bench.dispatcher.start()
    until(lambda: len(bench.taken) == 3, "the newest of each")
    assert newest.shed == 3


def test_keys_that_wait_are_bounded_and_the_oldest_sample_gives_way(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One sample of each key waited behind a slow callback, of however many keys."""
    monkeypatch.setattr(worker_inputs, "MAX_WAITING", 10)
    newest, whole = bench.input(keep_last=1), bench.input(keep_last=None)
    for number in range(3):
        bench.put(newest, "a", str(number))
    for number in range(2):
        bench.put(whole, "b", str(number), number)
    for number in range(30):
        bench.put(newest, f"key/{number}", "x", 0)
    assert len(bench.dispatcher._queue) - bench.dispatcher._dead == 10
    assert (newest.shed, whole.shed, whole.waiting) == (2 + 1 + 20, 2, {})
    assert sorted(name[0] for name in newest.waiting) == sorted(f"key/{number}" for number in range(20, 30))
    assert bench.acks._sources["b", "a1", 7].lost == 2, "what is wanted is told to be lost"
    assert bench.acks._sources["key/0", "a1", 7].lost == 1, "and what nothing newer replaces"
    bench.dispatcher.start()
    until(lambda: len(bench.taken) == 10, "the newest")
    assert bench.dispatcher._dead == 0
