"""A judgement and its figures: what is written down is judged again, bit for bit.

The simulator checks every judgement that it tells, in all of its schedules.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from random import Random

import pytest

from support.decisions import figures_of
from support.fleets import fleet_of, task_of, tuning_of
from support.plays import FLEET
from support.profiles import load_of, profile_of
from zsched.core.scheduler.decision import decide_again, verdict_of
from zsched.core.values.codec import as_plain, from_plain
from zsched.core.values.decision import Decision
from zsched.core.values.errors import InvariantError
from zsched.core.values.fleet import Demand, Fleet, WorkerSpec
from zsched.core.values.model import NodeId, ScoreForm, TaskId, Utility, UtilityVector
from zsched.core.values.profile import WorkerState
from zsched_lab.sim.checks import check_replayed
from zsched_lab.sim.simulator import Simulator

ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2", "edge3")


def fleet(tasks: int = 1) -> Fleet:
    specs = [
        task_of(
            f"task{number}",
            EDGES,
            tuning=tuning_of(cpu=0.6, memory=0.4),
            price_s=3.0,
            worker=WorkerSpec(command=("worker",)),
        )
        for number in range(tasks)
    ]
    return fleet_of(*specs, of=sorted((*ROBOTS, *EDGES)), electors=ROBOTS)


def restless(seed: int) -> Simulator:
    """A fleet whose edges are busy in turns, so that judgements of every kind are made."""
    rng = Random(seed)
    phases = {name: rng.uniform(3.0, 9.0) for name in EDGES}

    def load(node: NodeId, now: float) -> tuple[float, float]:
        period = phases.get(node)
        return (3.9 if period and now % (2 * period) < period else 1.0), 1000.0

    return Simulator(fleet=fleet(tasks=1 + seed % 2), seed=seed, load=load)


def judged(sim: Simulator, seconds: float) -> Iterator[Decision]:
    """Every judgement of every robot and task, once."""
    seen: set[tuple[NodeId, TaskId, float]] = set()
    for _ in range(int(seconds * 4)):
        sim.run(0.25)
        for robot in ROBOTS:
            for task in sim.fleet.tasks:
                decision = sim.node(robot).rounds.decision(task.name, sim.now)
                if decision is not None and (robot, task.name, decision.figures.now) not in seen:
                    seen.add((robot, task.name, decision.figures.now))
                    yield decision


@pytest.mark.parametrize("seed", range(3))
def test_every_judgement_is_made_again_from_what_is_written_of_it(seed: int) -> None:
    sim = restless(seed)
    sim.start(*ROBOTS, *EDGES)
    outcomes = set()
    for decision in judged(sim, 20.0):
        check_replayed("here", decision)
        outcomes.add(decision.verdict.outcome)
    sim.crash(sim.agreed("task0", *ROBOTS) or "edge1")
    for decision in judged(sim, 6.0):
        check_replayed("here", decision)
        outcomes.add(decision.verdict.outcome)
    assert {"stay", "wait"} <= outcomes


def test_other_figures_are_another_judgement() -> None:
    sim = restless(1)
    sim.start(*ROBOTS, *EDGES)
    decision = list(judged(sim, 10.0))[-1]
    figures = decision.figures
    fewer = replace(figures, vectors=figures.vectors[:1])
    assert verdict_of(decide_again(fewer).judgement) != decision.verdict
    with pytest.raises(InvariantError, match="by the same figures again"):
        check_replayed("here", replace(decision, figures=fewer))


def test_what_is_written_is_read_as_it_was() -> None:
    sim = restless(3)
    sim.start(*ROBOTS, *EDGES)
    for decision in judged(sim, 8.0):
        assert from_plain(json.loads(json.dumps(as_plain(decision))), Decision) == decision


def test_only_a_judgement_that_changed_is_written_down() -> None:
    """A fleet at rest writes nothing: its robots judge twice a second all the same."""
    sim = Simulator(fleet=fleet(), seed=5)
    sim.start(*ROBOTS, *EDGES)
    sim.run(20.0)
    sim.stories.clear()
    before = sim.node("robot1").rounds.tasks["task0"].judged_at
    sim.run(60.0)
    assert sim.node("robot1").rounds.tasks["task0"].judged_at > before
    assert sim.stories == []


def test_what_is_owed_and_since_when_an_owner_is_not_ready_is_remembered() -> None:
    sim = Simulator(fleet=fleet(), seed=5)
    sim.start(*ROBOTS, *EDGES)
    sim.run(10.0)
    decision = sim.node("robot1").rounds.decision("task0", sim.now)
    assert decision is not None
    figures = decision.figures
    owner, profile = figures.allocation.owner, figures.owner_profile
    assert owner is not None
    assert profile is not None
    memory = replace(figures.judge, owed=((owner, 0.05),), charged_at=figures.now, not_ready_since=figures.now - 4.0)
    unscored = tuple(
        replace(
            vector,
            utilities=tuple(one for one in vector.utilities if one.candidate != owner),
            refused=((owner, "no fresh profile"),),
        )
        for vector in figures.vectors
    )
    waits = decide_again(replace(figures, judge=memory, vectors=unscored)).judgement
    assert f"{owner} cannot be scored, and owes 0.05 s more" in waits.reason
    starting = replace(profile, workers=tuple(replace(one, state=WorkerState.STARTING) for one in profile.workers))
    waits = decide_again(replace(figures, judge=memory, owner_profile=starting)).judgement
    assert f"{owner} will be left in 16 s" in waits.reason


def test_too_few_robots_are_no_reason_to_say_that_nobody_else_can_have_a_task_whose_worker_starts() -> None:
    spec = task_of(candidates=EDGES, worker=WorkerSpec(command=("worker",)))
    column = tuple(Utility(candidate=name, value=0.5) for name in EDGES)
    heard = UtilityVector(voter="robot1", task="merge", revision=4, utilities=column)
    starting = profile_of("edge1", workers=(load_of(state=WorkerState.STARTING),))
    figures = figures_of(spec, *ROBOTS, vectors=(heard,), owner_profile=starting)
    judgement = decide_again(figures).judgement
    assert judgement.reason == (
        "utilities of 1 robots, 2 needed; edge1 will be left in 20 s, for its worker is starting"
    )
    alone = replace(figures, vectors=(replace(heard, utilities=column[:1]),))
    assert decide_again(alone).judgement.reason.endswith("edge1 is starting; nobody else can have the task")


def test_of_two_tasks_that_are_short_of_memory_on_one_machine_one_leaves() -> None:
    """Both fled in one round to the same machine, and both fled back: 68 moves in a minute."""
    tuning = tuning_of(cpu=0.5, memory=0.5, score=ScoreForm.PAPER)
    demand = Demand(cpu_cores=0.1, memory_mb=1500.0)
    first = replace(FLEET.tasks[0], exclusive=False, demand=demand, tuning=tuning)
    tasks = tuple(replace(first, name=name) for name in ("merge", "plan"))

    def load(node: str, _now: float) -> tuple[float, float]:
        own = sum(sim.agreed(one.name) == node for one in tasks)
        return 1.0 + 0.1 * own, 900.0 + 1500.0 * own

    sim = Simulator(fleet=replace(FLEET, tasks=tasks), seed=2, load=load)
    sim.start(*ROBOTS, "edge1")
    assert sim.run_until(lambda: all(sim.agreed(one.name) == "edge1" for one in tasks), 30.0)
    sim.run(3.0)
    before = len(sim.owners)
    sim.start("edge2")
    sim.run(30.0)
    assert sorted(str(sim.agreed(one.name)) for one in tasks) == ["edge1", "edge2"]
    assert len(sim.owners) == before + 1


def test_a_task_does_not_go_round_between_machines_that_are_all_short_of_memory() -> None:
    """Each flight took half a second, and nothing held the next one."""
    tuning = tuning_of(score=ScoreForm.PAPER)
    spec = task_of(candidates=EDGES[:2], tuning=tuning, worker=WorkerSpec(command=("worker",)))
    used_mb = [1000.0]
    sim = Simulator(fleet=fleet_of(spec), seed=1, load=lambda _node, _now: (1.0, used_mb[0]))
    sim.start()
    sim.run(10.0)
    used_mb[0] = 3880.0
    before = len(sim.owners)
    sim.run(20.0)
    assert len(sim.owners) == before
