"""Machines that come into a whole simulated fleet, and what one change of its electors costs."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from support.plays import FLEET, TASK, Play
from zsched.core.electorate.founding import founded_id
from zsched.core.values.messages import Ballots
from zsched_lab.sim import fleets
from zsched_lab.sim.change_cost import ONE_WAY_S, measure
from zsched_lab.sim.parts import Machine
from zsched_lab.sim.recoveries import Recoveries
from zsched_lab.sim.simulator import Simulator

ELECT = Simulator._elect
HALVES_SEED = 3
"""With it two of the four electors are on each side."""


def members_of(play: Play, generation: int = 0, seed: int = 1) -> Recoveries:
    return Recoveries(
        sim=play.sim,
        rng=Random(seed),
        tell=lambda command, node: play.tell(node or "robot1", command),
        done=Counter(),
        generation_id=founded_id(FLEET.name, generation),
    )


@pytest.mark.parametrize("generation", [0, 2])
def test_a_machine_that_is_invited_joins_and_may_be_an_elector(generation: int) -> None:
    play = Play(generation=generation)
    play.adopt()
    members = members_of(play, generation)
    members.invite("robot5")
    for _ in range(5):
        members.go_on()
        play.sim.run(1.0)
    assert members.is_done()
    play.settle()
    node = play.sim.node("robot5")
    assert (node.agreement.problems, node.agreement.generation) == ({}, generation)
    assert "robot5" in node.in_force.voters
    assert play.sim.agreed(TASK) is not None


def test_an_invited_machine_starts_blank_with_the_generation_s_id_and_a_disk_of_its_own() -> None:
    play = Play()
    play.adopt()
    members = members_of(play)
    members.invite("robot5")
    while "robot5" not in play.sim.machines:
        members.go_on()
        play.sim.run(0.2)
    state = play.sim.disk("robot5")
    assert state is not None
    assert state.fleet_register is not None
    assert state.fleet_register.learnt is not None
    assert state.fleet_register.learnt.generation_id == founded_id(FLEET.name, 0)
    assert (state.registers, state.votes) == ((), 0)
    assert state.disk not in {play.disk(name) for name in play.sim.machines if name != "robot5"}


@pytest.mark.parametrize("is_elector", [True, False])
def test_a_machine_that_was_started_before_its_lost_disk_is_initialised_runs_with_the_new_state(
    *, is_elector: bool
) -> None:
    """No command writes a state under a daemon: its lock is held, so its operator stops it first."""
    play = Play()
    play.adopt()
    members = members_of(play)
    machine = play.sim.machines["robot3" if is_elector else "edge1"]
    play.sim.crash(machine.key)
    machine.disk.wipe()
    machine.is_durable = False
    play.sim.start(machine.key)
    members.calm()
    members.start_all()
    node, state = play.sim.node(machine.key), play.sim.disk(machine.key)
    assert state is not None
    held = node.agreement.to_persist(play.sim.now)
    assert held is not None
    assert (held.disk, held.incarnation) == (state.disk, state.incarnation)


def test_a_majority_that_is_lost_for_good_is_recovered_and_the_dead_are_taken_out() -> None:
    play = Play()
    play.adopt()
    members = members_of(play)
    for name in ("robot2", "robot3"):
        play.sim.crash(name)
    members.dead |= {"robot2", "robot3"}
    before = members.generation_id
    assert not members.can_agree()
    assert members.recover()
    assert members.can_agree()
    assert members.generation_id != before
    assert (members.done["recovered"], members.done["rejoined"]) == (1, 2)
    for _ in range(40):
        members.go_on()
        play.sim.run(0.5)
    assert members.is_done()
    assert sorted(play.sim.machines) == ["edge1", "edge2", "robot1"]
    assert {len(play.electors(name)) for name in play.sim.running()} == {1}


def test_two_halves_that_were_recovered_apart_show_each_other_until_one_changes_sides() -> None:
    """Four electors, two on each side of a cut: neither side can agree, and both are recovered."""
    play = Play(fleet=replace(FLEET, electors=("edge1", "robot1", "robot2", "robot3")))
    play.adopt()
    members = members_of(play, seed=HALVES_SEED)
    before = members.generation_id
    members.halves()
    assert (members.done["halves"], members.done["recovered"]) == (1, 2)
    assert members.generation_id != before
    assert members.can_agree()
    play.settle(20)
    assert {play.sim.node(name).agreement.fleet_value.generation_id for name in play.sim.running()} == {  # type: ignore[union-attr]
        members.generation_id
    }


def test_the_electors_of_a_change_take_turns_and_the_first_asks_for_each_task_once() -> None:
    """Two other electors and a new one: ten tasks cost a prepare, an accept and the answers, as one task does."""
    cost, of_one = measure(10, exclusive=False), measure(1, exclusive=False)
    kinds = ("prepares of tasks", "accepts of tasks", "answers of tasks")
    assert [of_one.frames[kind] for kind in kinds] == [0, 3, 3]
    assert [cost.frames[kind] for kind in kinds] == [0, 0, 0]
    assert [cost.frames[f"{kind} of several tasks"] for kind in ("questions", "answers")] == [6, 6]
    assert cost.writes == of_one.writes


def test_a_change_is_settled_after_five_round_trips() -> None:
    """Two until it is agreed, one in which the electors learn it and promise, one for the tasks, one for the fleet."""
    cost = measure(10, exclusive=False)
    trips = [round(seconds / (2 * ONE_WAY_S), 1) for seconds in (cost.agreed_s, cost.chosen_s, cost.settled_s)]
    assert trips == [2.0, 5.0, 6.5]
    assert cost.frames.total() <= 60
    assert cost.after <= 12, "how often each elector has voted is asked once, by everybody"


def test_electors_of_an_older_version_settle_too(monkeypatch: pytest.MonkeyPatch) -> None:
    """They read no frame of several questions: those are dropped, and come again one by one."""
    monkeypatch.setattr(Simulator, "_elect", _reads_single_questions)
    cost = measure(3, exclusive=False)
    assert cost.frames["questions of several tasks"] > 0
    assert cost.frames["prepares of tasks"] >= 9


def _reads_single_questions(sim: Simulator, me: Machine, question: object, *more: Any) -> None:
    if not isinstance(question, Ballots):
        ELECT(sim, me, question, *more)


def test_schedules_play_machines_that_come_and_go() -> None:
    done: Counter[str] = Counter()
    for seed in (100, 105, 110):
        violation, did = fleets.play(seed)
        assert violation == ""
        done += did
    assert done["invited"]
    assert done["joined"]


def test_a_fleet_is_not_at_rest_while_nobody_knows_what_was_chosen_last() -> None:
    """In this schedule an elector is added in the moment in which the operator looks: the value before is outdated."""
    violation, _ = fleets.play(80_000_100)
    assert violation == ""
