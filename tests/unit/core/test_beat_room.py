"""Beats have room for what they say, or say it in turn: none is too large to be sent."""

from __future__ import annotations

from dataclasses import replace

import pytest

from zsched import wire
from zsched.config import check_bytes
from zsched.core.beat_room import FRAME_BYTES, MAX_BEAT_BYTES, BeatRoom, beat_bytes, most_bytes
from zsched.core.fleet import Fleet, NodeSpec, TaskSpec, Timing, WorkerSpec
from zsched.core.model import MAX_COUNTER, Beat, Grant, NodeKind, Tuning, Weights
from zsched.lab.simulator import Simulator

LONG = "n" * 60
ROBOTS = tuple(f"{LONG}{number:03}" for number in range(3))


def name(number: int, length: int = 63) -> str:
    return f"{number:03}".rjust(length, "t")


def full(tasks: int, length: int = 63) -> Beat:
    """A beat whose every number and name is as long as it may be."""
    most = MAX_COUNTER

    def grant(number: int) -> Grant:
        return Grant(task=name(number, length), owner=ROBOTS[0], incarnation=most, epoch=most, number=most)

    return Beat(
        node=ROBOTS[0],
        incarnation=most,
        sequence=most,
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
    )


@pytest.mark.parametrize("tasks", [0, 1, 8, 20])
def test_a_beat_takes_no_more_bytes_than_is_reckoned(tasks: int) -> None:
    beat = full(tasks)
    taken = len(wire.encode(beat))
    assert taken <= beat_bytes(beat)
    assert beat_bytes(beat) - taken <= FRAME_BYTES, "and hardly fewer"


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


def fleet(tasks: int, length: int) -> Fleet:
    tuning = Tuning(weights=Weights(cpu=1.0, memory=0.0, network=0.0))
    return Fleet(
        name="sim",
        timing=Timing(),
        nodes=tuple(NodeSpec(name=robot, kind=NodeKind.ROBOT) for robot in ROBOTS),
        tasks=tuple(
            TaskSpec(
                name=name(number, length),
                candidates=ROBOTS,
                tuning=tuning,
                worker=WorkerSpec(command=("true",)),
                exclusive=True,
            )
            for number in range(tasks)
        ),
        electors=ROBOTS,
    )


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
    assert "no room in a beat" in node.problems["beat"]


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
        assert f"at most {MAX_BEAT_BYTES}" in fault.message
        assert "300 of them exclusive" in fault.hint


def test_a_beat_that_fits_is_sent_as_it_is() -> None:
    beat = full(3)
    assert BeatRoom().fit(beat) == (beat, 0)
    assert BeatRoom().fit(replace(beat, learnt=())) == (replace(beat, learnt=()), 0)
