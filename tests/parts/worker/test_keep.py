"""What a worker keeps of its answers, over real sessions: until when, and what a relay is sent again."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any, cast

import pytest
import zenoh

from support.sessions import hub_and_neighbour, matches
from support.waiting import until
from zsched.core.hop import shared
from zsched.core.values import codec as wire
from zsched.core.values.relay_protocol import SKIP_ENCODING, EndMarker, StreamAck, StreamAcks, mark_of
from zsched.host.clock import monotonic_s
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import AGAIN_CHUNK, END_CHUNK, Keyspace
from zsched.link.pipe.frames import decode_end
from zsched.link.sessions.stalled_links import StalledLinks
from zsched.worker import keep as worker_keep
from zsched.worker.keep import Debts, Keeper, KeptLane

KEY = "edge1/t/1/out"
KEYS = Keyspace("t")


class Robot:
    """A robot's relay as a keeper sees it: acknowledgements as the test wants them."""

    def __init__(self, session: zenoh.Session, worker: zenoh.Session, node: str, relay: str = "") -> None:
        self.session, self.node = session, node
        self.relay = relay or str(session.zid())
        self.got: list[int] = []
        self.skipped: list[int] = []
        self.had: list[int | None] = []
        self.ends: list[int] = []
        self._key = KEYS.received(node, self.relay, str(worker.zid()))
        self._again = session.declare_subscriber(f"{KEY}/{AGAIN_CHUNK}/{self.relay}", self._take)
        self._ends = session.declare_subscriber(f"{KEY}/{END_CHUNK}", self._end)

    def _take(self, sample: zenoh.Sample) -> None:
        if str(sample.encoding) == SKIP_ENCODING:
            marker = decode_end(sample.payload.to_bytes())
            assert marker is not None
            self.skipped.append(marker.count)
            self.had.append(marker.had)
            return
        source: Any = sample.source_info
        assert sample.payload.to_string() == f"answer {source.source_sn}"
        self.got.append(source.source_sn)

    def _end(self, sample: zenoh.Sample) -> None:
        marker = decode_end(sample.payload.to_bytes())
        self.ends.append(-1 if marker is None else marker.count)

    def ack(self, eid: int, arrived: int, **more: Any) -> None:
        ack = StreamAck(eid=eid, first=0, arrived=arrived, processed=arrived, **more)
        self.session.put(self._key, wire.encode(StreamAcks(acks=(ack,))))

    def leave(self) -> None:
        self._again.undeclare()


class Bench:
    def __init__(self, worker: zenoh.Session, outside: zenoh.Session) -> None:
        self.worker, self.outside = worker, outside
        self.told: list[StreamAcks] = []
        self.acks = Acknowledger(lambda _relay, frame: self.told.append(frame))
        self.debts = Debts(self.acks)
        self.keeper = Keeper(worker, KEYS.received("*", "*", str(worker.zid())), self.debts, StalledLinks(worker, 1.5))
        self.publisher = worker.declare_publisher(KEY)
        self.eid = self.publisher.id.eid

    def lane(self, limit: int = 100) -> KeptLane:
        lane = self.keeper.lane(KEY, self.publisher.id, limit)
        watch = self.outside.declare_publisher(KEYS.received("robot1", "x", str(self.worker.zid())))
        until(lambda: matches(watch), "the keeper listens")
        return lane

    def robot(self, node: str, relay: str = "") -> Robot:
        return Robot(self.outside, self.worker, node, relay)


def keep(lane: KeptLane, *numbers: int) -> None:
    for number in numbers:
        assert lane.keep((f"answer {number}".encode(), None, None), None, 10) == number


@pytest.fixture
def bench() -> Iterator[Bench]:
    with hub_and_neighbour() as (outside, worker):
        made = Bench(worker, outside)
        yield made
        made.keeper.close()
        made.acks.close()


def test_what_every_robot_has_acknowledged_is_kept_no_more(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "NEWCOMERS_S", 0.0)
    lane = bench.lane()
    first, second = bench.robot("robot1", "aa1"), bench.robot("robot2", "aa2")
    keep(lane, 0, 1, 2, 3)
    second.ack(bench.eid, 1)
    until(lambda: len(lane.state.kept) == 3, "the slower one counts")
    first.ack(bench.eid, 4)
    second.ack(bench.eid, 4)
    until(lambda: not lane.state.kept and lane.state.kept.size == 0, "nothing is kept")


def test_a_robot_that_follows_the_move_last_is_given_what_the_first_has_acknowledged_already(bench: Bench) -> None:
    """An output that several robots share: one was there first, the other's link came up ten answers later."""
    lane = bench.lane()
    first, second = bench.robot("robot1", "aa1"), bench.robot("robot2", "aa2")
    keep(lane, *range(10))
    first.ack(bench.eid, 10)
    until(lambda: lane.state.receivers and lane.state.receivers["aa1"].arrived == 10, "the first robot's word")
    keep(lane, 10)
    second.ack(bench.eid, 0, has_gap=True, until=10)
    until(lambda: second.got == list(range(10)), "the beginning")
    assert (first.got, second.skipped) == ([], [])


def test_the_first_answers_of_an_epoch_do_not_stay_for_ever(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also when nobody says anything any more."""
    monkeypatch.setattr(shared, "NEWCOMERS_S", 0.3)
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1, 2)
    robot.ack(bench.eid, 3)
    until(lambda: lane.state.receivers, "the robot's only word")
    until(lambda: not lane.state.kept and lane.state.kept.size == 0, "they are let go of")
    until(lambda: not lane.wake.is_set(), "the keeper is at rest")


def test_what_comes_while_nothing_is_kept_stays_in_nobody_s_memory(bench: Bench) -> None:
    lane = bench.lane()
    robot = bench.robot("robot1", "aa1")
    key = KEYS.received("robot1", "aa1", str(bench.worker.zid()))
    assert not lane.wake.is_set()
    bench.outside.put(key, bytes(worker_keep.MAX_FRAME_BYTES + 1))
    until(lambda: bench.keeper.dropped == 1, "what is too large is dropped")
    for _ in range(3):
        bench.outside.put(key, b"no frame")
    robot.ack(bench.eid, 0)
    until(lambda: "aa1" in lane.state.receivers, "a word is taken all the same")
    assert bench.keeper._came.empty()
    assert not lane.wake.is_set()


def test_only_so_many_acknowledgements_wait(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    bench.lane()
    go_on = threading.Event()
    monkeypatch.setattr(bench.keeper, "_take", lambda _: go_on.wait(60))
    robot = bench.robot("robot1", "aa1")
    try:
        for _ in range(worker_keep.MAX_FRAMES + 20):
            robot.ack(bench.eid, 0)
        until(lambda: bench.keeper.dropped >= 19, "the rest is dropped")
        assert bench.keeper._came.qsize() <= worker_keep.MAX_FRAMES
    finally:
        go_on.set()


def test_a_gap_is_filled_at_once_for_that_robot_alone(bench: Bench) -> None:
    lane = bench.lane()
    first, second = bench.robot("robot1", "aa1"), bench.robot("robot2", "aa2")
    keep(lane, *range(10))
    first.ack(bench.eid, 1)
    second.ack(bench.eid, 10)
    first.ack(bench.eid, 4, has_gap=True, until=7)
    until(lambda: first.got == [4, 5, 6], "the hole")
    assert second.got == []
    assert first.skipped == []


def test_who_makes_no_progress_is_sent_the_rest_again_and_the_end_too(bench: Bench) -> None:
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1, 2)
    robot.ack(bench.eid, 1)
    until(lambda: robot.got[:2] == [1, 2], "what is not acknowledged")
    lane.note_end(EndMarker(epoch=1, count=3))
    robot.ack(bench.eid, 3)
    until(lambda: robot.ends and robot.ends[0] == 3, "the end marker")
    robot.ack(bench.eid, 3, is_ended=True)
    until(lambda: not lane.wake.is_set(), "the keeper is at rest")


def test_what_is_kept_no_more_is_skipped(bench: Bench) -> None:
    lane = bench.lane(limit=3)
    robot = bench.robot("robot1")
    keep(lane, *range(6))
    robot.ack(bench.eid, 1, has_gap=True, until=5)
    until(lambda: robot.got == [3, 4], "what there is")
    assert robot.skipped == [3]


def test_much_is_sent_again_in_parts_as_it_arrives(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared, "BATCH", 2)
    monkeypatch.setattr(shared, "NEWCOMERS_S", 0.0)
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, *range(5))
    robot.ack(bench.eid, 0)
    for count in (2, 4, 5):
        until(lambda count=count: robot.got == list(range(count)), f"{count} of them")  # type: ignore[misc]
        robot.ack(bench.eid, count)
    until(lambda: not lane.state.kept, "all acknowledged")


def test_a_relay_that_restarted_takes_the_place_of_its_former_life(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "NEWCOMERS_S", 0.0)
    lane = bench.lane()
    before, after = bench.robot("robot1", "aa1"), bench.robot("robot1", "aa2")
    keep(lane, 0, 1, 2)
    before.ack(bench.eid, 0)
    until(lambda: "aa1" in lane.state.receivers, "the first life")
    after.ack(bench.eid, 3)
    until(lambda: not lane.state.kept, "nobody waits for the first life")


def test_another_life_of_a_relay_is_told_what_the_former_one_has_had_and_is_sent_only_the_rest(bench: Bench) -> None:
    lane = bench.lane()
    keep(lane, 0, 1, 2, 3)
    bench.robot("robot1", relay="f0").ack(bench.eid, 3)
    until(lambda: "f0" in lane.state.receivers, "the former life's word")
    other = bench.robot("robot2", relay="f2")
    other.ack(bench.eid, 0, has_gap=True, until=3)
    until(lambda: other.got == [0, 1, 2], "another robot has had nothing")
    robot = bench.robot("robot1", relay="f1")
    robot.ack(bench.eid, 0, has_gap=True, until=4)  # it begins at 0, as every life of a relay
    until(lambda: robot.got, "the rest")
    assert (robot.got, robot.skipped, robot.had) == ([3], [3], [3])
    assert other.skipped == []


def test_a_strangers_word_about_a_relay_that_lives_keeps_nothing_from_it(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "NEWCOMERS_S", 60.0)  # later nothing is kept for who is not known
    lane = bench.lane()
    keep(lane, 0, 1, 2)
    robot = bench.robot("robot1")
    robot.ack(bench.eid, 0)
    until(lambda: robot.relay in lane.state.receivers, "the relay is known")
    bench.robot("robot1", relay="dead").ack(bench.eid, 3)
    until(lambda: "dead" in lane.state.receivers, "the stranger has taken its place")
    robot.ack(bench.eid, 0, has_gap=True, until=3)
    until(lambda: robot.got == [0, 1, 2], "everything")
    assert robot.skipped == []


def test_who_cannot_be_reached_is_forgotten_and_what_nobody_acknowledges_too(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "FORGET_S", 0.4)
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1)
    robot.ack(bench.eid, 1)
    until(lambda: lane.state.receivers, "the robot")
    robot.leave()
    until(lambda: not lane.state.receivers and not lane.state.kept, "nothing is kept for nobody")


def test_bytes_are_bounded_too(monkeypatch: pytest.MonkeyPatch, bench: Bench) -> None:
    monkeypatch.setattr(shared, "SHARED_BYTES", 25)
    lane = bench.lane()
    keep(lane, 0, 1, 2)
    assert [one.number for one in lane.state.kept] == [1, 2]


def test_strangers_who_acknowledge_are_bounded_and_a_robot_that_was_reached_stays(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shared, "MAX_RECEIVERS", 4)
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1, 2)
    robot.ack(bench.eid, 1, has_gap=True, until=2)
    until(lambda: robot.got == [1], "the robot is sent what it lacks")
    word = wire.encode(StreamAcks(acks=(StreamAck(eid=bench.eid, first=0, arrived=0, processed=0, has_gap=True),)))
    for number in range(40):
        bench.outside.put(KEYS.received(f"ghost{number}", f"bad{number}", str(bench.worker.zid())), word)
    until(lambda: "bad39" in lane.state.receivers, "the last stranger's word")
    assert len(lane.state.receivers) == 4
    assert robot.relay in lane.state.receivers
    assert lane.state.crowded_out == 40 - 3
    until(lambda: set(lane.ways) <= set(lane.state.receivers), "the others' publishers are given back")


@pytest.mark.parametrize("is_first", [False, True], ids=["behind the robot", "before the robot"])
def test_a_member_that_speaks_for_another_s_relay_takes_nothing_from_it(bench: Bench, *, is_first: bool) -> None:
    """Rules bind the key to the member's certificate, and not the relay's id in it."""
    lane = bench.lane()
    robot, member = bench.robot("robot1", "aa1"), bench.robot("robot2", "aa1")
    keep(lane, 0, 1, 2, 3)
    words: list[tuple[Robot, int, dict[str, bool]]] = [(robot, 1, {})]
    words.insert(0 if is_first else 1, (member, 4, {"has_left": True, "is_ended": True}))
    for who, arrived, more in words:
        who.ack(bench.eid, arrived, **more)
    until(lambda: len(lane.state.receivers) == 2, "both words")
    robot.ack(bench.eid, 1, has_gap=True, until=4)
    until(lambda: set(robot.got) == {1, 2, 3}, "what the robot lacks, at the robot")
    assert lane.state.contradicted == 1
    robot.ack(bench.eid, 4)
    until(lambda: not lane.state.kept, "both have all")


def test_a_word_about_another_key_is_none_about_ours(bench: Bench) -> None:
    """Another owner has named our publisher under its own key, so a robot's relay has answered to that."""
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1)
    robot.ack(bench.eid, 2, of=mark_of("edge2/merge/1/robot1/out"))
    robot.ack(bench.eid, 1, of=mark_of(lane.key))
    until(lambda: lane.state.receivers, "the robot's word, behind that one")
    assert [one.arrived for one in lane.state.receivers.values()] == [1]


def test_an_acknowledgement_under_a_malformed_key_is_nobody_s(bench: Bench) -> None:
    lane = bench.lane()
    robot = bench.robot("robot1")
    keep(lane, 0, 1)
    for node, relay in (("*", "aa1"), ("robot9", "*"), ("robot9", "b" * 500)):
        bench.robot(node, relay).ack(bench.eid, 2)
    robot.ack(bench.eid, 1)
    until(lambda: lane.state.receivers, "the robot's word, behind those")
    assert list(lane.state.receivers) == [robot.relay]


class LateBell(worker_keep._Bell):
    """Something happens in the moment before it is put back."""

    def __init__(self, keeper: Keeper, late: Callable[[], object]) -> None:
        super().__init__(keeper._came)
        self.late = late

    def clear(self) -> None:
        self.late()
        super().clear()


@pytest.mark.parametrize("what", ["an answer of a new lane", "the end of a known lane", "an input that waits"])
def test_the_keeper_does_not_rest_over_what_came_while_it_lay_down(bench: Bench, what: str) -> None:
    keeper = bench.keeper
    keeper._subscriber = cast("Any", object())  # no thread: the test is the keeper

    def lane() -> KeptLane:
        return keeper.lane(KEY, bench.publisher.id, 100)

    def late() -> None:
        if what == "an answer of a new lane":
            keep(lane(), 0)
        elif what == "the end of a known lane":
            known[0].note_end(EndMarker(epoch=1, count=0))
        else:
            bench.debts.processed((KEY, "aa1", 1), 0, 1, {known[0]: 0}, is_unanswered=True)

    keeper._wake = LateBell(keeper, late)
    known = [] if what == "an answer of a new lane" else [lane()]
    for one in known:
        one.hear("aa1", "robot1", StreamAck(eid=bench.eid, first=0, arrived=0, processed=0), monotonic_s())
    keeper._wake.set()
    keeper._look_after()
    assert keeper._wake.is_set()


def test_a_lane_at_rest_is_looked_after_again_once_it_has_something_to_do(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten times a second the keeper looked at every key that the worker had ever answered on."""
    monkeypatch.setattr(shared, "NEWCOMERS_S", 0.0)
    keeper = bench.keeper
    keeper._subscriber = cast("Any", object())  # no thread: the test is the keeper
    other = bench.worker.declare_publisher("edge1/t/1/other")
    resting, busy = keeper.lane(KEY, bench.publisher.id, 100), keeper.lane("edge1/t/1/other", other.id, 100)
    looks: list[KeptLane] = []
    monkeypatch.setattr(KeptLane, "look_after", lambda lane, _session, _now: looks.append(lane))

    def looked_at() -> list[KeptLane]:
        looks.clear()
        keeper._look_after()
        return list(looks)

    keep(resting, 0)
    keep(busy, 0)
    assert looked_at() == [resting, busy]
    resting.hear("aa1", "robot1", StreamAck(eid=bench.eid, first=0, arrived=1, processed=1), monotonic_s())
    assert looked_at() == [resting, busy], "once more, to see that nothing is left"
    assert looked_at() == [busy]
    keep(resting, 1)
    assert looked_at() == [resting, busy]
    resting.hear("aa1", "robot1", StreamAck(eid=bench.eid, first=0, arrived=2, processed=2), monotonic_s())
    looked_at()
    resting.settled("aa2", monotonic_s())  # an input waits for a robot that has said nothing
    assert looked_at() == [resting, busy]
    resting.note_end(EndMarker(epoch=1, count=2))
    assert looked_at() == [resting, busy]
    resting.hear("aa1", "robot1", StreamAck(eid=bench.eid, first=0, arrived=2, processed=2, is_ended=True), 0.0)
    looked_at()
    resting.close()
    assert looked_at() == [resting, busy]
    resting.close()
    assert looked_at() == [busy], "it is forgotten"
