"""Beats have room for what they say, or say it in turn: none is too large to be sent."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.beats import beat_of
from support.fleets import fleet_of, node_of, task_of
from support.states import state_of
from zsched.config.load import check_bytes
from zsched.core.membership.beat_room import FRAME_BYTES, BeatRoom, beat_bytes, most_bytes
from zsched.core.node.node import Node
from zsched.core.values import codec as wire
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import MAX_BEAT_BYTES, Beat, Grant
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.model import MAX_COUNTER
from zsched_lab.sim.simulator import Simulator

LONG = "r" * 60
ROBOTS = tuple(f"{LONG}{number:03}" for number in range(3))


def name(number: int, length: int = 63) -> str:
    return f"{number:03}".rjust(length, "t")


def full(tasks: int, length: int = 63) -> Beat:
    """A beat whose every number and name is as long as it may be."""
    most = MAX_COUNTER

    def grant(number: int) -> Grant:
        return Grant(task=name(number, length), owner=ROBOTS[0], incarnation=most, epoch=most, number=most)

    return beat_of(
        ROBOTS[0],
        most,
        incarnation=most,
        loop_lag_s=1.1,
        learnt=tuple((name(number, length), most, most) for number in range(tasks)),
        suspects=ROBOTS,
        echoes=tuple(map(grant, range(tasks))),
        released=tuple(map(grant, range(tasks))),
        asked_to_leave=tuple((name(number, length), ROBOTS[0], most) for number in range(tasks)),
        fleet_file="f" * 16,
        has_voted=True,
        generation=most,
        lease_terms=f"{'e' * 16}, clock in doubt",
        has_lost_state=True,
        votes=most,
        electorate=f"{'e' * 16}/{most}",
        number=most,
        fleet_revision=most,
        disk="d" * 16,
        gone=ROBOTS,
        away=ROBOTS,
    )


@pytest.mark.parametrize("tasks", [0, 1, 8, 20])
def test_a_beat_takes_no_more_bytes_than_is_reckoned(tasks: int) -> None:
    beat = full(tasks)
    taken = len(wire.encode(beat))
    assert taken <= beat_bytes(beat)
    assert beat_bytes(beat) - taken <= FRAME_BYTES, "and hardly fewer"


def test_names_of_twins_take_the_room_that_those_of_the_missing_would() -> None:
    """Whoever is heard twice is not missed, so a fleet's beats take no more for them."""
    beat = full(1)
    told = replace(beat, suspects=(), twins=beat.suspects)
    assert beat_bytes(told) == beat_bytes(beat) > beat_bytes(replace(beat, suspects=()))
    sent, _ = BeatRoom().fit(replace(full(200), suspects=(), twins=beat.suspects))
    assert len(wire.encode(sent)) <= MAX_BEAT_BYTES
    assert sent.twins == beat.suspects


@pytest.mark.parametrize("tasks", [8, 18, 27, 47, 200])
def test_every_part_of_a_beat_that_is_too_large_is_sent_in_turn_and_suspects_always(tasks: int) -> None:
    room, beat = BeatRoom(), full(tasks)
    said: set[object] = set()
    rounds = -(-beat_bytes(beat) // (MAX_BEAT_BYTES - 2 * FRAME_BYTES - 200))
    for _ in range(rounds + 1):
        sent, left_out = room.fit(beat)
        wire.encode(sent)
        assert sent.suspects == beat.suspects
        parts = (*sent.learnt, *sent.released, *sent.asked_to_leave, *(("echo", one) for one in sent.echoes))
        assert len(parts) + left_out == 4 * tasks
        said |= set(parts)
    assert len(said) == 4 * tasks


@pytest.mark.parametrize("kind", ["learnt", "released", "asked_to_leave", "echoes", "suspects", "gone", "away"])
def test_one_part_more_takes_as_many_bytes_as_are_reckoned_for_it(kind: str) -> None:
    """Numbers and names are as long as they may be; 17 and 18 of each, for the length of a list changes at 16."""
    names = tuple(map(name, range(18)))
    beat = replace(full(18), suspects=names, gone=names, away=names)
    fewer = replace(beat, **{kind: getattr(beat, kind)[:-1]})
    assert beat_bytes(beat) - beat_bytes(fewer) == encoded(beat) - encoded(fewer)


def encoded(beat: Beat) -> int:
    """Its bytes, in halves, for a whole one may be too large to be sent."""
    halves = (replace(beat, learnt=(), released=()), replace(beat, echoes=(), asked_to_leave=()))
    return sum(len(wire.encode(half)) for half in halves) - len(
        wire.encode(replace(halves[0], echoes=(), asked_to_leave=()))
    )


def beats_of(big: Fleet) -> Beat:
    """What an elector's beat may hold in the long run, in a fleet whose nodes have names of several lengths."""
    most, longest = MAX_COUNTER, max((node.name for node in big.nodes), key=len)
    names = tuple(task.name for task in big.tasks if task.exclusive)
    grants = tuple(Grant(task=one, owner=longest, incarnation=most, epoch=most, number=most) for one in names)
    learnt = tuple((task.name, most, most) for task in big.tasks)
    nodes = tuple(node.name for node in big.nodes)
    return replace(full(0), learnt=learnt, echoes=grants, released=grants, suspects=nodes, gone=nodes, away=nodes)


def test_the_most_that_a_fleet_s_beats_take_is_reckoned_from_its_names() -> None:
    big = fleet(3, 20)
    nodes = (*big.nodes, node_of("r2"))
    plain = replace(big.tasks[0], name="plain", exclusive=False)
    mixed = replace(big, nodes=nodes, tasks=(*big.tasks, plain))
    for one in (big, mixed, replace(big, tasks=())):
        assert most_bytes(one) == beat_bytes(beats_of(one))
    assert most_bytes(replace(big, tasks=(), nodes=())) == FRAME_BYTES == 704
    nobody, somebody = (replace(big, nodes=nodes) for nodes in ((), big.nodes[:1]))
    assert most_bytes(somebody) - most_bytes(nobody) == (2 * len(big.tasks) + 3) * len(ROBOTS[0]) + 3 * 2


# --- in turn ---------------------------------------------------------------------------------------------------------


def sized(room: int, *sizes: int) -> Beat:
    """A beat without suspects that has ``room`` bytes left beside parts of these sizes."""
    left = MAX_BEAT_BYTES - FRAME_BYTES - room - sum(sizes)
    parts = [OVER + MIN_NAME for _ in range(left // (OVER + MIN_NAME))]
    parts[-1] += left - sum(parts)
    return replace(
        full(0), suspects=(), gone=(), away=(), learnt=tuple(("x" * (size - OVER), 1, 1) for size in (*parts, *sizes))
    )


OVER, MIN_NAME = 1 + 2 + 2 * 9, 4


def test_a_beat_that_fills_its_room_to_the_last_byte_is_sent_whole_whosever_turn_it_is() -> None:
    room = BeatRoom()
    whole = sized(0)
    assert beat_bytes(whole) == MAX_BEAT_BYTES
    for _ in range(2):
        _, left_out = room.fit(sized(-60, 60))
        assert left_out > 0
    assert room.fit(whole) == (whole, 0)


def test_what_is_chosen_fills_the_room_to_the_last_byte() -> None:
    """Too large by the last part: all the others fill the beat exactly."""
    beat = sized(-60, 60)
    sent, left_out = BeatRoom().fit(beat)
    assert (sent.learnt, left_out) == (beat.learnt[:-1], 1)
    assert beat_bytes(sent) == MAX_BEAT_BYTES


def test_a_part_that_has_no_room_is_the_next_beat_s_first() -> None:
    """Smaller ones behind it wait, though there is room for them: else a large one's turn might never come."""
    beat = sized(60)
    beat = replace(beat, learnt=(*beat.learnt, ("y" * 60, 1, 1), ("z", 1, 1), ("w", 1, 1)))
    room = BeatRoom()
    first, left_out = room.fit(beat)
    assert (first.learnt, left_out) == (beat.learnt[:-3], 3)
    second, _ = room.fit(beat)
    assert second.learnt[:3] == beat.learnt[-3:]


def fleet(tasks: int, length: int) -> Fleet:
    worker = WorkerSpec(command=("true",))
    named = (name(number, length) for number in range(tasks))
    return fleet_of(*(task_of(one, ROBOTS, worker=worker, exclusive=True) for one in named), of=ROBOTS)


@pytest.mark.long
def test_electors_of_more_exclusive_tasks_than_a_beat_has_room_for_stay_alive_and_all_tasks_work() -> None:
    big = fleet(60, 63)
    assert most_bytes(big) > MAX_BEAT_BYTES, "check refuses it; here it runs all the same"
    sim = Simulator(fleet=big, seed=1)
    sim.start()
    assert sim.run_until(lambda: len(sim.working) == len(big.tasks), 60), len(sim.working)
    sim.run(5)
    assert all(until > sim.now for _, until in sim.working.values())
    node = sim.node(ROBOTS[0])
    assert node.counters["beat_parts_left_out"] > 0
    assert "no room in a beat" in node.problems["beat", ""]


def test_a_node_whose_beats_have_no_room_says_so_until_they_have() -> None:
    node = Node(
        fleet=fleet(200, 63),
        me=ROBOTS[0],
        durable=state_of(ROBOTS[0]),
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
    )
    batch = *node.start(100.0), *node.handle(ev.DeadlineReached(), 100.2)
    left_out = [200 - len(one.beat.learnt) for one in batch if isinstance(one, do.PublishBeat)]
    assert node.counters["beat_parts_left_out"] == sum(left_out) > 0
    assert node.problems["beat", ""].startswith(f"{left_out[-1]} parts have no room in a beat")
    node.handle(ev.FleetChanged(fleet=fleet(20, 63)), 100.3)
    node.handle(ev.DeadlineReached(), 100.5)
    assert ("beat", "") not in node.problems


TEXT = """
fleet: hall
nodes:
  robot1: {kind: robot, host: 127.0.0.1, listen: {control: tcp/127.0.0.1:7457, data: tcp/127.0.0.1:7458}}
  robot2: {kind: robot}
  robot3: {kind: robot}
tasks:
"""
TASK = (
    "  %s: {candidates: {kind: robot}, weights: {cpu: 1.0}, exclusive: true, worker: {command: [work]}, "
    "outputs: [{from: '{target}/{task}/{epoch}/out', to: '{robot}/%s'}]}\n"
)


@pytest.mark.parametrize(("tasks", "is_good"), [(20, True), (60, True), (300, False)])
def test_check_refuses_a_fleet_whose_beats_have_no_room(tasks: int, is_good: bool) -> None:
    text = TEXT + "".join(TASK % (f"task{number}", f"task{number}") for number in range(tasks))
    result = check_bytes(text.encode())
    assert (result.fleet is not None) is is_good, result.faults[:2]
    if not is_good:
        (fault,) = result.faults
        assert "at most 16384" in fault.message
        assert "300 of them exclusive" in fault.hint


def test_a_beat_that_fits_is_sent_as_it_is() -> None:
    beat = full(3)
    assert BeatRoom().fit(beat) == (beat, 0)
    assert BeatRoom().fit(replace(beat, learnt=())) == (replace(beat, learnt=()), 0)
