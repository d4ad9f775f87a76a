"""What a worker had to withhold: given back in the order in which it came, whatever happens meanwhile."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import pytest
import zenoh

from zsched.worker import backlog as worker_backlog
from zsched.worker.backlog import QUIET_S, STALE_S, Done, StandbyInputs
from zsched.worker.samples import Input, KeepLast


@dataclass(frozen=True)
class Sample:
    """What the backlog reads of a sample (zenoh lets nobody make one)."""

    key_expr: str = "edge1/t/robot1/in"
    payload: bytes = b"x"
    attachment: bytes | None = None


SOURCE = Input(on_sample=lambda _: None, keep_last=None)


def done(
    turn: int, key: str = "edge1/t/robot1/in", quiet_at: float | None = None, source: Input = SOURCE
) -> Done[Input]:
    return Done(source, cast("zenoh.Sample", Sample(key)), turn, epoch=0, quiet_at=quiet_at, name=(key, "zid", 1))


def turns(backlog: StandbyInputs[Input]) -> list[int]:
    taken = []
    while (one := backlog.take()) is not None:
        taken.append(one.turn)
    return taken


def test_nothing_is_processed_again_before_the_worker_is_the_owner() -> None:
    backlog = StandbyInputs[Input]()
    assert backlog.keep(done(1)) == []
    assert (backlog.take(), backlog.is_due, backlog.is_before(2)) == (None, False, False)
    backlog.begin()
    assert (backlog.is_due, backlog.is_before(2), backlog.is_before(1)) == (True, True, False)
    assert turns(backlog) == [1]


def test_keys_are_given_back_in_the_order_in_which_they_came() -> None:
    backlog = StandbyInputs[Input]()
    for turn, key in ((1, "a"), (2, "b"), (3, "a"), (4, "b")):
        backlog.keep(done(turn, key))
    backlog.begin()
    assert turns(backlog) == [1, 2, 3, 4]


def test_a_role_that_goes_and_comes_back_in_the_middle_changes_no_order() -> None:
    backlog = StandbyInputs[Input]()
    for turn in (1, 2, 3):
        backlog.keep(done(turn))
    backlog.begin()
    first, second = backlog.take(), backlog.take()
    assert first is not None
    assert second is not None
    backlog.keep(first)  # the role went while it was processed again
    backlog.begin()
    backlog.put_back(second)  # the role came back while the next one was in hand
    backlog.put_back(done(4))
    assert turns(backlog) == [1, 2, 3, 4]


def test_what_was_answered_is_processed_again_only_for_a_state_that_took_the_place_of_ours() -> None:
    for is_restored, expected in ((True, [2, 3]), (False, [3])):
        backlog = StandbyInputs[Input]()
        backlog.keep(done(1, quiet_at=100.0 - QUIET_S))
        backlog.keep(done(2, quiet_at=99.0))
        backlog.keep(done(3))
        backlog.begin()
        backlog.settle(is_restored=is_restored, now=100.0)
        assert turns(backlog) == expected


def test_a_begin_behind_a_state_that_has_come_takes_nothing_from_what_is_processed_again_for_it() -> None:
    """A lease comes while the worker catches up: its role begins once more."""
    backlog = StandbyInputs[Input]()
    for turn in (1, 2, 3):
        backlog.keep(done(turn, quiet_at=99.0))
    backlog.begin()
    backlog.settle(is_restored=True, now=100.0)
    assert backlog.take() is not None
    backlog.keep(done(4, quiet_at=100.0))  # it went into the state that has come
    backlog.keep(done(5))
    backlog.begin(is_settled=True)
    assert turns(backlog) == [2, 3, 5]


def test_of_an_input_that_keeps_the_newest_only_those_wait_and_nothing_is_lost() -> None:
    backlog, newest = StandbyInputs[Input](), Input(on_sample=lambda _: None, keep_last=2)
    assert [backlog.keep(done(turn, source=newest)) for turn in range(4)] == [[], [], [], []]
    backlog.begin()
    assert turns(backlog) == [2, 3]


@pytest.mark.parametrize(
    ("keep_last", "is_whole", "kept", "lost"),
    [("by_class", True, [1, 2], 0), ("by_class", False, [2], 0), (1, True, [2], 1), (1, False, [2], 0)],
)
def test_how_much_is_kept_goes_by_the_class_and_what_gives_way_of_a_reliable_source_is_lost(
    keep_last: KeepLast, is_whole: bool, kept: list[int], lost: int
) -> None:
    backlog, source = StandbyInputs[Input](), Input(on_sample=lambda _: None, keep_last=keep_last)
    gone = [one.name for turn in (1, 2) for one in backlog.keep(done(turn, source=source)._replace(is_whole=is_whole))]
    backlog.begin()
    assert (turns(backlog), len(gone)) == (kept, lost)


def from_slot(turn: int, slot: int, at: float, key: str = "a") -> Done[Input]:
    return done(turn, key)._replace(slot=slot, at=at)


def test_what_an_older_epoch_left_long_ago_is_stale_and_its_publisher_with_it() -> None:
    backlog = StandbyInputs[Input]()
    backlog.keep(from_slot(1, slot=2, at=0.0, key="old"))
    backlog.keep(from_slot(2, slot=2, at=10.0, key="young"))
    backlog.keep(from_slot(3, slot=4, at=0.0, key="now"))
    backlog.keep(from_slot(4, slot=0, at=0.0, key="silent"))
    backlog.keep(from_slot(6, slot=2, at=0.0, key="acknowledged")._replace(quiet_at=0.0))
    assert backlog.stale(4, 10.0 + STALE_S) == {("old", "zid", 1)}
    backlog.begin()
    backlog.keep(from_slot(5, slot=3, at=0.0, key="kept"))
    assert backlog.stale(2, 100.0) == set()
    assert {name for name, _, _ in backlog.stale(4, 10.1 + STALE_S)} == {"old", "young", "kept"}


def test_what_a_publisher_gives_up_is_forgotten_wherever_it_waits() -> None:
    backlog = StandbyInputs[Input]()
    for turn, key in ((1, "a"), (2, "b")):
        backlog.keep(done(turn, key))
    backlog.begin()
    for turn, key in ((3, "a"), (4, "b")):
        backlog.keep(done(turn, key))
    backlog.keep(done(5, "a", quiet_at=0.0))  # has been acknowledged
    assert backlog.forget(("a", "zid", 1)) == 2
    assert backlog.forget(("a", "zid", 1)) == 0
    backlog.begin()
    assert turns(backlog) == [2, 4, 5]


def test_what_is_forgotten_makes_room(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(worker_backlog, "MAX_BACKLOG_BYTES", 2)
    backlog = StandbyInputs[Input]()
    for turn in (1, 2):
        backlog.keep(done(turn, "a"))
    backlog.forget(("a", "zid", 1))
    assert [backlog.keep(done(turn, "b")) for turn in (3, 4)] == [[], []]


def test_keys_that_come_and_go_are_not_kept_for_ever(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of each key the newest was, until the worker became the owner: a standby's memory grew with every key."""
    monkeypatch.setattr(worker_backlog, "MAX_KEYS", 4)
    backlog, newest = StandbyInputs[Input](), Input(on_sample=lambda _: None)
    backlog.keep(done(0, "map", source=newest))
    for turn in range(1, 100):
        assert backlog.keep(done(turn, f"key/{turn}", quiet_at=0.0, source=newest)) == []
    assert len(backlog._kept) == 4
    lost = [backlog.keep(done(turn, str(turn))._replace(is_whole=True)) for turn in range(100, 103)]
    assert lost == [[], [], []], "what has its result gives way first"
    assert backlog.keep(done(103, "103")._replace(is_whole=True)) == [], "of the map nobody is told"
    (gone,) = backlog.keep(done(104, "104"))
    assert (gone.turn, backlog._bytes) == (100, 4), "it has no answer, and is lost"
