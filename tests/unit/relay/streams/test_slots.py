"""What an output's slot knows of its keys and their publishers, whoever else puts under them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, cast

from zsched.core.hop.serial import serial_of
from zsched.core.values.relay_protocol import EndMarker
from zsched.link.acknowledger import Acknowledger
from zsched.relay.streams import answers as answers_module
from zsched.relay.streams import slots
from zsched.relay.streams.answers import Answers
from zsched.relay.streams.counter import StreamCounter
from zsched.relay.streams.slots import END_GRACE_S, KeyState, OutputSlot

if TYPE_CHECKING:
    import pytest
    from zenoh import Sample

WORKER, ANOTHER = ("a" * 32, 1), ("b" * 32, 1)


def taken(key: KeyState, publisher: tuple[str, int], *numbers: int) -> None:
    for number in numbers:
        key.received += 1
        key.take(publisher, serial_of(number), None, StreamCounter("t/out/0"))


def test_an_end_is_reached_by_its_own_publisher_only() -> None:
    """What another one had put counted, too: a worker that was restarted in place ended before its last answers."""
    key = KeyState(name="out")
    taken(key, ANOTHER, *range(50))
    taken(key, WORKER, 0, 1)
    assert key.take_end(EndMarker(epoch=1, count=4), WORKER, 0.0)
    assert not key.is_ended(0.0, None)
    taken(key, WORKER, 2, 3)
    taken(key, ANOTHER, 50)
    assert key.is_ended(0.0, None)


def test_a_strange_number_takes_no_end_for_another_one() -> None:
    """The end was read near the newest number of anybody: 4294967196 samples were called lost."""
    key = KeyState(name="out")
    taken(key, WORKER, *range(100))
    taken(key, ANOTHER, 3_000_000_000)
    assert key.take_end(EndMarker(epoch=1, count=102), WORKER, 0.0)
    assert not key.is_ended(0.0, None)
    assert key.is_ended(END_GRACE_S + 0.1, None)
    assert key.missing(None) == 2


class Bench:
    """A slot with a wildcard, whose worker's answers are acknowledged; as `OutputStream` passes them on."""

    def __init__(self) -> None:
        self.now = 100.0
        self.acks = Acknowledger(lambda *_: None, clock=lambda: self.now)
        self.counter = StreamCounter("t/out/0")
        self.answers = Answers(self.acks, self.counter, is_from_start=True, in_turn=True, heard={})
        self.slot = OutputSlot(epoch=1, expr="edge1/t/1/*", answers=self.answers)

    def put(self, name: str, zid: str, number: int, size: int = 1) -> int:
        """A sample comes; how many pass."""
        key = self.slot.key(f"edge1/t/1/{name}")
        assert key is not None
        sample = cast("Sample", SimpleNamespace(payload=bytes(size), attachment=None))
        ready = self.answers.take((key.name, zid, 1), number, sample)
        for at, _ in enumerate(ready):
            key.heard_at = self.now
            if (zid, 1) not in key.sources:
                self.slot.note_publisher()
            assert key.take((zid, 1), number + at, self.answers, self.counter)
        return len(ready)

    def end(self, name: str, zid: str, count: int) -> None:
        key = self.slot.key(f"edge1/t/1/{name}")
        assert key is not None
        if key.take_end(EndMarker(epoch=1, count=count), (zid, 1), self.now):
            key.ender = (key.name, zid, 1)
            self.answers.ended(key.ender)

    def known(self) -> int:
        return sum(len(key.sources) for key in self.slot.keys.values())


def test_publishers_are_forgotten_and_nothing_of_a_live_one_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    """Anybody can put as any publisher: each took 2 KB for as long as the task did not move."""
    monkeypatch.setattr(slots, "MAX_PUBLISHERS", 32)
    monkeypatch.setattr(answers_module, "MAX_SOURCES", 64)
    bench = Bench()
    for number in range(40):
        bench.now += 1.0
        assert bench.put("out", "worker", number) == 1
        assert all(bench.put("out", f"stranger{number}of{one}", 0) for one in range(10))
        assert bench.known() == bench.slot.publishers <= 32
    bench.put("out", "rare", 0)
    bench.now += 1.0
    bench.put("out", "worker", 40)
    assert all(bench.put("out", f"another{one}", 0) for one in range(40))
    assert ("rare", 1) not in bench.slot.keys["edge1/t/1/out"].sources
    assert bench.put("out", "rare", 1) == 1
    assert len(bench.answers._known) <= 64
    assert (bench.counter.lost, bench.counter.doubled, bench.slot.missing() + bench.slot.take_lost()) == (0, 0, 0)
    bench.put("out", "worker", 41)
    bench.end("out", "worker", 42)
    assert bench.slot.keys["edge1/t/1/out"].is_ended(bench.now, bench.answers)


def test_what_is_missing_of_a_publisher_that_is_forgotten_is_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slots, "MAX_PUBLISHERS", 2)
    bench = Bench()
    bench.put("out", "worker", 0)
    bench.acks.skip(("edge1/t/1/out", "worker", 1), 3)  # given up, and nothing has passed behind it
    bench.now += 1.0
    bench.put("out", "b", 0)
    bench.put("out", "c", 0)
    assert bench.slot.take_lost() == 2


def test_ends_under_ever_new_keys_are_not_known_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """A key with an end was never forgotten: one frame of a stranger's took 2 KB."""
    monkeypatch.setattr(slots, "MAX_KEYS", 16)
    monkeypatch.setattr(slots, "MAX_ENDED", 16)
    monkeypatch.setattr(answers_module, "MAX_SOURCES", 64)
    bench = Bench()
    bench.put("out", "worker", 0)
    bench.end("out", "worker", 2)
    for one in range(200):
        bench.end(f"key{one}", "stranger", 5)
        bench.end("quiet", f"stranger{one}", 5)
        bench.now += 0.001
    assert len(bench.slot.keys) <= 33
    assert len(bench.answers._known) <= 64
    assert bench.put("out", "worker", 1) == 1
    assert bench.slot.keys["edge1/t/1/out"].is_ended(bench.now, bench.answers)


def test_what_is_early_is_bounded_over_all_publishers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each had 32 MB of its own, and nobody's was given up where they were more than an acknowledger knows."""
    monkeypatch.setattr(answers_module, "MAX_EARLY", 4)
    monkeypatch.setattr(answers_module, "MAX_EARLY_BYTES", 100)
    bench = Bench()
    bench.put("out", "worker", 0)
    for one in range(20):
        assert bench.put("out", f"stranger{one}", 7, size=30) == 0
        assert bench.put("out", f"far{one}", 900_000) == 0
    early = bench.answers._early
    assert [name[1] for name in early] == ["stranger0", "stranger1", "stranger2"]
    assert sum(one.size for one in early.values()) == 90
    assert bench.put("out", "worker", 2, size=5) == 0  # there is room for this one
    assert bench.put("out", "worker", 1) == 2
    given_up: list[str] = []
    for _ in range(8):  # as `OutputStream.look_after` does
        bench.now += 0.2
        given_up += [name[1] for name, _ in bench.answers.overdue()]
    assert given_up == ["stranger0", "stranger1", "stranger2"]
    assert (bench.answers._early, bench.answers._total.size) == ({}, 0)
