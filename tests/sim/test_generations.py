"""Fleets of a later generation: who has lost its state goes by what the electors say, and nothing freezes."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.fleet import Fleet, WorkerSpec
from zsched.core.values.model import NodeId
from zsched.core.vote.belief import GENERATION_STEP, MAX_GENERATION
from zsched_lab.sim.simulator import Simulator

TASK = "merge"
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")
BY_EDGES = fleet_of(
    task_of(TASK, EDGES, tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("true",))),
    of=(*EDGES, *ROBOTS),
    electors=EDGES,
)
BY_ROBOTS = replace(BY_EDGES, electors=ROBOTS)


def started(fleet: Fleet, generation: int, seed: int = 1) -> Simulator:
    sim = Simulator(fleet=fleet, seed=seed)
    for machine in sim.machines.values():
        machine.disk.wipe()
        sim.initialise(machine, generation=generation)
    sim.start()
    until_owned(sim)
    return sim


def until_owned(sim: Simulator, but: NodeId | None = None) -> NodeId:
    assert sim.run_until(lambda: sim.agreed(TASK) not in (None, but), 20), "\n".join(sim.stories[-20:])
    return sim.agreed(TASK) or ""


def lose_state(sim: Simulator, *names: NodeId) -> None:
    for name in names:
        sim.crash(name)
        sim.machines[name].disk.wipe()
        sim.machines[name].is_durable = False
    sim.start(*names)


def problems(sim: Simulator, name: NodeId) -> str:
    batch = sim.node(name).handle(ev.StatusAsked(request=1), sim.now)
    (answer,) = [one for one in batch if isinstance(one, do.AnswerStatus)]
    return " ".join(answer.snapshot.problems)


@pytest.mark.parametrize("generation", [0, 1, MAX_GENERATION])
@pytest.mark.parametrize("seed", range(3))
def test_robots_that_have_all_lost_their_state_replace_a_dead_owner(seed: int, generation: int) -> None:
    sim = started(BY_EDGES, generation, seed)
    lose_state(sim, *ROBOTS)
    sim.run(3)
    owner = until_owned(sim)
    sim.crash(owner)
    until_owned(sim, but=owner)
    assert min(sim.node("robot1").registers[TASK].value.revision, 2**60) // GENERATION_STEP == generation
    assert "generation" not in problems(sim, "edge1" if owner != "edge1" else "edge2")


def test_a_robot_without_a_state_follows_the_fleet_into_the_next_generation() -> None:
    sim = started(BY_EDGES, 1)
    lose_state(sim, "robot1")
    sim.run(2)
    others = [name for name in (*EDGES, *ROBOTS) if name != "robot1"]
    for name in others:
        sim.crash(name)
        sim.initialise(sim.machines[name], incarnation=sim.wall_count, generation=2)
    sim.start(*others)
    owner = until_owned(sim)
    assert sim.node("robot1").registers[TASK].value.revision > 2 * GENERATION_STEP
    sim.crash(owner)
    until_owned(sim, but=owner)


def test_a_robot_without_a_state_forgets_who_has_voted_in_the_generation_before() -> None:
    """`zsched init` asks it who has: an elector of the new generation must not be refused for votes of the old one."""
    sim = started(BY_EDGES, 1)
    lose_state(sim, "robot1")
    sim.run(5)
    assert sim.node("robot1").agreement.voted == set(EDGES)
    for name in (*EDGES, "robot2", "robot3"):
        sim.crash(name)
    sim.initialise(sim.machines["edge1"], incarnation=sim.wall_count, generation=2)
    sim.start("edge1")
    assert sim.run_until(lambda: sim.node("robot1").agreement.generation == 2, 10)
    assert sim.node("robot1").agreement.voted <= {"edge1"}


def test_electors_that_have_all_lost_their_state_say_what_the_operator_does() -> None:
    sim = started(BY_ROBOTS, 1)
    sim.run(1)
    lose_state(sim, *ROBOTS)
    sim.run(2)
    assert "--force" not in problems(sim, "edge1"), "they may come back"
    sim.run(65)
    for name in ("edge1", "robot1"):
        assert "`zsched fleet recover --generation 2 --force` on every node" in problems(sim, name), problems(sim, name)


def test_a_node_without_a_state_proposes_nothing_before_an_elector_has_said_which_generation_it_is() -> None:
    sim = Simulator(fleet=BY_EDGES, seed=1)
    for machine in sim.machines.values():
        machine.disk.wipe()
    sim.start()
    sim.run(8)
    assert sim.node("robot1").agreement.generation is None
    assert sim.invariants.ballots == {}, "nobody has asked for a promise"
