"""What this node's relay sees of workers that show no token: real sessions, each side of a link."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest
import zenoh

from support.sessions import hub_and_neighbour
from support.waiting import until
from zsched.core.values.relay_protocol import WorkerMatched, WorkerWatch
from zsched.relay.matching import SETTLE_S, Matching

WATCH = WorkerWatch(task="merge", inputs=("edge1/merge/*/map", "edge1/merge/*/scan"), strangers=("Nobody/merge/*/map",))
MAP, SCAN = "edge1/merge/robot1/map", "edge1/merge/robot2/scan"


class Seen:
    """A watch on one side of a link, whoever is watched on the other."""

    def __init__(self, hub: zenoh.Session, neighbour: zenoh.Session) -> None:
        self.hub, self.neighbour = hub, neighbour
        self.reports: list[WorkerMatched] = []
        self.matching = Matching(hub, self.reports.append)

    def subscribe(self, key: str) -> zenoh.Subscriber[None]:
        return self.neighbour.declare_subscriber(key, lambda _sample: None)

    def last(self) -> WorkerMatched | None:
        return self.reports[-1] if self.reports else None


@pytest.fixture
def seen() -> Iterator[Seen]:
    with hub_and_neighbour() as (hub, neighbour):
        yield Seen(hub, neighbour)


def told(seen: Seen, *, is_matched: bool, is_certain: bool = True, missing: str = "") -> None:
    wanted = WorkerMatched(task="merge", is_matched=is_matched, is_certain=is_certain, missing=missing)
    with contextlib.suppress(AssertionError):
        until(lambda: seen.last() == wanted, "the report")
    assert seen.last() == wanted


def test_every_rule_must_be_taken_by_somebody_for_some_robot(seen: Seen) -> None:
    first = seen.subscribe(MAP)
    seen.matching.watch(WATCH)
    told(seen, is_matched=False, missing="nobody subscribes to edge1/merge/*/scan")
    second = seen.subscribe(SCAN)
    told(seen, is_matched=True)
    first.undeclare()
    told(seen, is_matched=False, missing="nobody subscribes to edge1/merge/*/map")
    second.undeclare()
    seen.subscribe("edge1/merge/**")
    told(seen, is_matched=True)


def test_what_this_session_takes_itself_is_no_worker(seen: Seen) -> None:
    """A robot that is a candidate takes samples of its own tasks under such keys."""
    own = [seen.hub.declare_subscriber(key, lambda _sample: None) for key in (MAP, SCAN)]
    seen.matching.watch(WATCH)
    told(seen, is_matched=False, missing="nobody subscribes to edge1/merge/*/map")
    assert own


def test_a_recorder_of_everything_makes_it_uncertain(seen: Seen) -> None:
    seen.matching.watch(WATCH)
    recorder = seen.subscribe("**")
    told(seen, is_matched=True, is_certain=False)
    seen.subscribe(MAP)
    seen.subscribe(SCAN)
    recorder.undeclare()
    told(seen, is_matched=True)


def test_a_service_is_answered_for_one_robot_at_least(seen: Seen) -> None:
    keys = tuple(f"edge1/merge/{robot}/now" for robot in ("robot1", "robot2"))
    seen.matching.watch(WorkerWatch(task="merge", services=(keys,)))
    told(seen, is_matched=False, missing="nobody answers edge1/merge/robot1/now")
    answers = seen.neighbour.declare_queryable(keys[1], lambda query: query.drop())
    told(seen, is_matched=True)
    answers.undeclare()
    told(seen, is_matched=False, missing="nobody answers edge1/merge/robot1/now")


def test_who_asks_again_is_told_again_and_nobody_is_missed_before_links_can_be_there(seen: Seen) -> None:
    seen.matching.watch(WATCH)
    told(seen, is_matched=False, missing="nobody subscribes to edge1/merge/*/map")
    assert len(seen.reports) == 1
    seen.matching.watch(WATCH)
    until(lambda: len(seen.reports) == 2, "the next daemon is told", 2 * SETTLE_S)
    assert seen.reports[0] == seen.reports[1]


def test_without_anything_to_match_nothing_is_certain(seen: Seen) -> None:
    seen.matching.watch(WorkerWatch(task="merge"))
    told(seen, is_matched=True, is_certain=False)
