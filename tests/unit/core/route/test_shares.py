"""What an application beside its relay is told, and what counts of its words."""

from __future__ import annotations

from typing import Any

from zsched.core.events import SlotDrained
from zsched.core.hop.books import unaccounted
from zsched.core.relay_protocol import SlotLost, WorkerWatch
from zsched.core.route.shares import TIMES_S, Shares
from zsched.core.values.plan import (
    Direction,
    ReadyWhen,
    Route,
    RoutePhase,
    RoutePlan,
    Slot,
    StreamClass,
    StreamCount,
    StreamSettings,
)

NOW = 100.0
RELIABLE = StreamSettings(stream_class=StreamClass.RELIABLE)


def route(stream: str, direction: Direction, near: str, far: str) -> Route:
    ends = (near, far) if direction is Direction.INPUT else (far, near)
    return Route(stream=stream, direction=direction, from_expr=ends[0], to_expr=ends[1], settings=RELIABLE)


JOBS = route("t/in/0", Direction.INPUT, "robot1/jobs", "edge1/t/robot1/jobs")
SCANS = route("t/in/1", Direction.INPUT, "robot1/scan/*", "edge1/t/robot1/scan/*")
PLAN = route("t/out/0", Direction.OUTPUT, "robot1/plan", "edge1/t/1/robot1/plan")
MERGE = route("t/srv/0", Direction.SERVICE, "robot1/merge", "edge1/t/robot1/merge")


def slot(epoch: int, *routes: Route) -> Slot:
    return Slot(epoch=epoch, owner="edge1", routes=routes, ready_when=ReadyWhen.TOKEN)


def plan(*routes: Route, epoch: int = 1, old: int | None = None) -> RoutePlan:
    olds = () if old is None else (slot(old, *routes),)
    return RoutePlan(task="t", phase=RoutePhase.PREPARE, current=slot(epoch, *routes), predecessors=olds)


ALL = (JOBS, SCANS, PLAN, MERGE)


def shares(*keys: str) -> Shares:
    made = Shares()
    made.note_plan(plan(*ALL))
    made.name(keys)
    return made


def test_an_application_is_told_its_own_routes_only() -> None:
    made = Shares()
    assert made.note_plan(plan(*ALL)) == (), "there is none"
    assert made.note_unowned("t", (JOBS, SCANS)) == ()
    assert made.name(("robot1/jobs", "robot1/plan")) == (WorkerWatch(task="t", unowned=(JOBS,)), plan(JOBS, PLAN))
    assert made.taken() == ("robot1/jobs", "robot1/plan")
    assert made.note_plan(plan(*ALL, epoch=2, old=1)) == (plan(JOBS, PLAN, epoch=2, old=1),)


def test_a_key_below_a_rule_with_wildcards_is_its_streams_and_a_services_is_none() -> None:
    made = shares("robot1/scan/front", "robot1/merge", "robot1/other", "robot1/**")
    assert made.taken() == ("robot1/scan/front",)
    assert made.note_plan(plan(*ALL)) == (plan(SCANS),)


def test_other_tasks_are_not_told_of_and_a_known_one_is_when_its_routes_go() -> None:
    made = shares("robot1/other")
    assert made.note_plan(plan(*ALL)) == ()
    made.name(("robot1/jobs",))
    assert made.note_plan(plan(SCANS)) == (plan(),), "its last route is closed by that"


def test_an_application_hears_that_its_last_input_is_none_any_more_though_nobody_owns_the_task() -> None:
    """Else it took what it was told before, and kept it for the first owner."""
    made = Shares(keys=("robot1/jobs",))
    assert made.note_unowned("t", (JOBS, SCANS)) == (WorkerWatch(task="t", unowned=(JOBS,)),)
    for left in ((SCANS,), ()):
        assert made.note_unowned("t", left) == (WorkerWatch(task="t"),)
        assert made.taken() == ()
    assert made.note_unowned("another", (SCANS,)) == ()
    assert made.end("t")
    assert not made.end("t")


def test_a_slot_has_drained_when_both_say_so() -> None:
    word = SlotDrained(task="t", epoch=1)
    made = shares("robot1/jobs")
    assert made.relay_drained(word) is None
    assert made.heard(word) == (word,)
    assert made.heard(word) == (), "once"
    made = shares("robot1/jobs")
    assert made.heard(word) == ()
    assert made.relay_drained(word) == word


def test_a_slot_without_a_part_of_the_application_has_drained_when_the_relay_says_so() -> None:
    word = SlotDrained(task="t", epoch=1)
    assert shares("robot1/other").relay_drained(word) == word
    assert shares().relay_drained(word) == word
    made = shares("robot1/jobs")
    assert made.relay_drained(SlotDrained(task="t", epoch=7)) == SlotDrained(task="t", epoch=7)
    assert made.heard(SlotDrained(task="t", epoch=7)) == (), "an epoch that it was never told of"


def test_a_word_that_waits_is_said_when_the_application_goes_and_not_behind_the_slots_end() -> None:
    word = SlotDrained(task="t", epoch=1)
    made = shares("robot1/jobs")
    made.relay_drained(word)
    assert made.go(NOW) == (word,)
    made = shares("robot1/jobs")
    made.relay_drained(word)
    made.note_plan(plan(*ALL, epoch=2))
    assert made.heard(word) == ()
    assert made.go(NOW) == ()


def test_an_application_that_has_gone_has_no_streams_and_nobody_waits_for_its_word() -> None:
    made, word = shares("robot1/jobs"), SlotDrained(task="t", epoch=1)
    made.go(NOW)
    assert made.taken() == ()
    assert made.note_plan(plan(*ALL)) == ()
    assert made.relay_drained(word) == word


def test_what_it_left_open_is_heard_behind_the_slots_end_and_of_its_own_slots_only() -> None:
    made = shares("robot1/jobs")
    made.note_plan(plan(*ALL, epoch=2))
    lost = SlotLost(task="t", epoch=1, owner="edge1", samples=3)
    assert made.heard(lost) == (lost,)
    assert made.heard(SlotLost(task="t", epoch=9, owner="edge1", samples=3)) == ()
    assert made.heard(SlotLost(task="u", epoch=1, owner="edge1", samples=3)) == ()


def count(messages: int, acknowledged: int, in_flight: int, stream: str = "t/in/0", **more: Any) -> StreamCount:
    return StreamCount(stream=stream, messages=messages, acknowledged=acknowledged, in_flight=in_flight, **more)


def test_counters_add_up_and_the_books_balance_also_when_an_application_dies() -> None:
    made, relays = shares("robot1/jobs"), (count(10, 8, 2), StreamCount(stream="t/out/0", messages=5))
    assert made.added(relays, NOW) == relays
    made.note_counts((count(100, 90, 7, lost=1, drops=(("overflow", 2),)),), NOW)
    total = made.added(relays, NOW)[0]
    assert (total.messages, total.acknowledged, total.in_flight, total.lost) == (110, 98, 9, 1)
    assert total.drops == (("overflow", 2),)
    assert unaccounted(total) == 0
    assert made.go(NOW) == (SlotLost(task="t", epoch=1, owner="edge1", samples=7),)
    total = made.added(relays, NOW)[0]
    assert (total.messages, total.in_flight, total.at_most_lost) == (110, 2, 7)
    assert unaccounted(total) == 0
    made.name(("robot1/jobs",))
    made.note_counts((count(3, 3, 0),), NOW)
    made.go(NOW)
    made.name(("robot1/jobs",))
    made.note_counts((count(1, 0, 1),), NOW)
    total = made.added(relays, NOW)[0]
    assert (total.messages, total.acknowledged, total.in_flight, total.at_most_lost) == (114, 101, 3, 7)
    assert unaccounted(total) == 0


def test_an_application_that_goes_with_answers_only_has_lost_none_that_are_known() -> None:
    made = shares("robot1/plan")
    made.note_counts((StreamCount(stream="t/out/0", messages=5),), NOW)
    assert made.go(NOW) == ()


def test_counters_of_streams_that_are_not_its_own_are_not_taken() -> None:
    made = shares("robot1/jobs")
    made.note_counts((count(5, 5, 0, stream="t/in/1"), count(5, 5, 0, stream="u/in/0")), NOW)
    relays = (count(1, 1, 0, stream="t/in/1"),)
    assert made.added(relays, NOW) == relays


def test_the_last_sample_of_an_application_is_remembered_when_it_has_gone() -> None:
    made, relays = shares("robot1/jobs"), (count(0, 0, 0),)
    made.note_counts((count(10, 10, 0, last_seen_s=0.5),), NOW)
    made.go(NOW)
    assert made.added(relays, NOW + 60.0)[0].last_seen_s == 60.5
    later = (count(1, 1, 0, last_seen_s=2.0),)
    assert made.added(later, NOW + 60.0)[0].last_seen_s == 2.0, "the newest"
    made.end("t")
    assert made.added(relays, NOW + 60.0) == relays


def test_times_that_an_application_told_long_ago_are_nobody_s() -> None:
    """One that stands still tells no others, and the next owner is not as late as the one before."""
    made, relays = shares("robot1/plan"), (StreamCount(stream="t/out/0", messages=5),)
    made.note_counts((StreamCount(stream="t/out/0", answer_s=0.4, paired_hz=2.0),), NOW)
    told = made.added(relays, NOW + TIMES_S)[0]
    assert (told.answer_s, told.paired_hz) == (0.4, 2.0)
    told = made.added(relays, NOW + TIMES_S + 0.1)[0]
    assert (told.answer_s, told.paired_hz, told.messages) == (None, None, 5)


def answers(messages: int, **more: Any) -> StreamCount:
    return StreamCount(stream="t/out/0", messages=messages, **more)


def test_an_answer_that_the_application_has_itself_is_counted_once() -> None:
    """The relay has it, too, or misses it: it was not there, and the worker does not keep it for ever."""
    made = Shares()
    made.note_plan(plan(*ALL))

    def told(relay: StreamCount) -> tuple[int, int]:
        (total,) = made.added(made.apart((relay,)), NOW)
        return total.messages, total.lost

    assert told(answers(5, lost=1)) == (5, 1), "before the application came"
    made.name(("robot1/plan",))
    made.note_counts((answers(20),), NOW)
    assert told(answers(25, lost=30)) == (25, 1), "both had the 20, and the relay alone lost 29"
    made.go(NOW)
    assert told(answers(25, lost=30)) == (25, 1)
    assert told(answers(28, lost=31)) == (28, 2), "the relay's own again"
    made.name(("robot1/plan",))
    made.note_counts((answers(2),), NOW)
    assert told(answers(30, lost=31)) == (30, 2)


def test_an_output_that_the_application_does_not_have_is_the_relays() -> None:
    made = shares("robot1/jobs")
    made.note_counts((count(3, 3, 0),), NOW)
    relays = (answers(5, lost=2),)
    assert made.added(made.apart(relays), NOW) == relays
