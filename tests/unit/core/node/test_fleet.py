"""A node that takes another fleet file over is from then on a node that was started with it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import hear
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import SAMPLE, load_of, profile_of
from support.states import state_of
from support.storm import ELECTORATE, FLEET, ROBOTS, Storm, some_fleet
from zsched.core.node.fleet import go_by as take_over
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.document import Rollout, Text
from zsched.core.values.fleet import Fleet, StreamRule, WorkerSpec
from zsched.core.values.messages import Learnt, Prepare
from zsched.core.values.model import NodeKind
from zsched.core.values.plan import Direction, StreamCount
from zsched.core.values.profile import Renewal, WorkerState
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP

START = 100.0


class Even(Random):
    """Chance that is always even: how often a node has drawn before makes no difference."""

    def random(self) -> float:
        return 0.5


def node_of(fleet: Fleet, me: str = "robot1") -> Node:
    return Node(
        fleet=fleet,
        me=me,
        durable=state_of(me, electorate=ELECTORATE),
        incarnation=7,
        electorate=ELECTORATE,
        rng=Even(),
        now=START,
    )


def adopt(node: Node, fleet: Fleet, now: float = START) -> tuple[do.Instruction, ...]:
    return node.handle(ev.FleetChanged(fleet=fleet), now)


def kinds(batch: Iterable[do.Instruction]) -> set[type]:
    return {type(one) for one in batch}


@pytest.mark.parametrize(
    ("other", "why"),
    [
        (replace(FLEET, name="other"), "the file is of fleet 'other', this daemon of "),
        (replace(FLEET, nodes=FLEET.nodes[1:]), "the file has no node "),
        (replace(FLEET, nodes=(replace(FLEET.nodes[0], kind=NodeKind.ROBOT), *FLEET.nodes[1:])), "the file makes "),
    ],
    ids=["another fleet", "without this node", "another kind"],
)
@pytest.mark.parametrize("is_agreed", [False, True])
def test_a_file_that_cannot_be_taken_over_changes_nothing_and_is_a_problem_until_one_can(
    other: Fleet, why: str, is_agreed: bool
) -> None:
    """Also one that electors have agreed, and that this machine cannot follow."""

    def take(fleet: Fleet) -> None:
        if is_agreed:
            take_over(node, fleet, ToDo(), START)
        else:
            adopt(node, fleet)

    me = FLEET.nodes[0].name
    assert FLEET.nodes[0].kind is NodeKind.EDGE
    node = node_of(FLEET, me)
    before = (node.fleet, node.fleet_file, node.membership.states(), tuple(node.executors))
    take(other)
    assert (node.fleet, node.fleet_file, node.membership.states(), tuple(node.executors)) == before
    said = f"fleet: a changed fleet file is not in force here: {why}"
    assert [one for one in build_snapshot(node, START).problems if one.startswith(said)]
    take(FLEET)
    assert not [one for one in build_snapshot(node, START).problems if one.startswith(said)]


@pytest.mark.parametrize("seed", range(16))
@pytest.mark.parametrize("me", ["robot1", "edge1"])
def test_a_node_that_takes_a_file_over_acts_as_one_that_was_started_with_it(me: str, seed: int) -> None:
    """What must differ: how many beats and gathers there were before. All else is the same, batch by batch.

    Until a task comes back that only the first file had: the one that was there still has its register.
    """
    rng = Random(f"{me}/{seed}")
    first, second = some_fleet(rng), some_fleet(rng)
    adopter, starter = node_of(first, me), node_of(second, me)
    adopter.start(START)
    adopt(adopter, second)
    starter.start(START)
    adopter.handle(ev.DeadlineReached(), START)
    starter.handle(ev.DeadlineReached(), START)
    starter.beat_sequence = adopter.beat_sequence
    starter.rounds._number = adopter.rounds._number
    weather, now = Storm(me, seed), START
    left = {task.name for task in first.tasks} - {task.name for task in second.tasks}
    for _ in range(250):
        now += weather.rng.choice((0.0, 0.01, 0.05, weather.rng.uniform(0, 0.5)))
        event = weather.event()
        if isinstance(event, ev.FleetChanged) and left & {task.name for task in event.fleet.tasks}:
            break
        batch = starter.handle(event, now)
        assert adopter.handle(event, now) == batch, event
        weather.hear(batch)
        assert adopter.next_deadline() == starter.next_deadline()
    assert build_snapshot(adopter, now) == build_snapshot(starter, now)


@pytest.mark.parametrize("seed", range(4))
def test_the_same_file_again_changes_nothing(seed: int) -> None:
    fleet = some_fleet(Random(seed))
    node, other = node_of(fleet), node_of(fleet)
    weather, now = Storm("robot1", seed), START
    assert node.start(now) == other.start(now)
    for _ in range(150):
        now += 0.03
        assert adopt(node, node.told_fleet, now) == other.handle(ev.DeadlineReached(), now)
        event = weather.event()
        if not isinstance(event, ev.FleetChanged):
            assert node.handle(event, now) == other.handle(event, now)


def test_electors_and_leases_stay_until_they_are_agreed() -> None:
    node = node_of(FLEET)
    node.start(START)
    timing = replace(FLEET.timing, lease_s=9.0)
    adopt(node, replace(FLEET, electors=("edge1",), timing=timing, nodes=FLEET.nodes[:-1]))
    assert node.fleet.electors == ROBOTS
    assert node.fleet.timing.lease_s == FLEET.timing.lease_s
    assert "robot3" in node.fleet.voters, "an elector stays a node as long as it is counted with"
    assert node.told_fleet.electors == ("edge1",), "the runtime tells what is not in force"


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        (replace(FLEET, name="other"), "of fleet 'other'"),
        (fleet_of(*FLEET.tasks, of=("edge1", "edge2", "robot2", "robot3")), "no node 'robot1'"),
        (
            replace(
                FLEET,
                nodes=tuple(
                    replace(node, kind=NodeKind.EDGE) if node.name == "robot1" else node for node in FLEET.nodes
                ),
            ),
            "makes 'robot1' a node of kind edge",
        ),
    ],
)
def test_a_file_of_somebody_else_is_refused_and_told(changed: Fleet, why: str) -> None:
    node = node_of(FLEET)
    node.start(START)
    assert do.AdoptFleet not in kinds(adopt(node, changed))
    assert why in node.problems["fleet", ""]
    assert node.fleet == FLEET
    adopt(node, FLEET)
    assert ("fleet", "") not in node.problems


def test_a_task_that_goes_ends_and_comes_back_with_what_it_had_promised() -> None:
    node = node_of(fleet_of(task_of("merge"), task_of("other"), of=("edge1", "edge2", *ROBOTS)), "robot1")
    node.start(START)
    beats = [ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True) for name in ("robot2", "robot3")]
    for heard in beats:
        node.handle(heard, START)
    asked = Prepare(task="merge", ballot=ballot_of(5, "robot2"), electorate=ELECTORATE)
    node.handle(ev.PrepareAsked(request=1, asker="robot2", prepare=asked), START + 1)
    promised = node.registers["merge"].state.promised
    assert promised.counter == 5
    gone = adopt(node, fleet_of(task_of("other"), of=("edge1", "edge2", *ROBOTS)), START + 50)
    assert do.EndTask(task="merge") in gone
    assert "merge" not in node.registers
    asked = Prepare(task="other", ballot=ballot_of(5, "robot2"), electorate=ELECTORATE)
    batch = node.handle(ev.PrepareAsked(request=2, asker="robot2", prepare=asked), START + 51)
    states = [one.state for one in batch if isinstance(one, do.PersistState)]
    assert [one.task for one in states[0].registers] == ["other", "merge"], "what was promised stays on disk"
    adopt(node, fleet_of(task_of("merge"), task_of("other"), of=("edge1", "edge2", *ROBOTS)), START + 52)
    assert node.registers["merge"].state.promised == promised


def test_what_a_refused_write_cuts_off_of_a_change_is_given_again() -> None:
    """The runtime went by the file before: what left the fleet ran on, and what came was never started."""
    stays = task_of("other")
    goes, comes = (task_of(name, ("robot1",), worker=WorkerSpec(command=(name,))) for name in ("merge", "count"))
    fleet, changed = (fleet_of(one, stays, of=("edge1", "edge2", *ROBOTS)) for one in (goes, comes))
    node = node_of(fleet)
    node.start(START)
    for name in ("robot2", "robot3"):
        node.handle(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True), START)
    asked = Prepare(task="other", ballot=ballot_of(5, "robot2"), electorate=ELECTORATE)
    node.absorb(ev.PrepareAsked(request=1, asker="robot2", prepare=asked), START + 1)
    batch = adopt(node, changed, START + 1)
    assert isinstance(batch[0], do.PersistState)
    again = node.handle(ev.PersistFailed(reason="no space left on device"), START + 1)
    orders: tuple[do.Instruction, ...] = (
        do.AdoptFleet(fleet=changed),
        do.StopWorker(task="merge"),
        do.EndTask(task="merge"),
        do.StartWorker(task="count"),
    )
    for given in (batch, again):
        assert tuple(one for one in given if one in orders) == orders
    assert not kinds(node.handle(ev.PersistFailed(reason="again"), START + 1)) & {do.AdoptFleet, do.EndTask}


def test_the_worker_of_a_task_that_comes_back_is_not_taken_for_the_old_one() -> None:
    task = task_of("merge", worker=WorkerSpec(command=("merge",)))
    fleet, without = fleet_of(task), fleet_of(task_of("other"))
    node = node_of(fleet, "edge1")
    node.start(START)
    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.STARTING), START)
    node.handle(ev.RecipeCompared(task="merge", is_old=True), START)
    told = []
    for second, there in enumerate((fleet, without, fleet), start=1):
        now = START + 2 * second
        batch = *adopt(node, there, now), *node.handle(ev.ProfileSampled(device=SAMPLE), now + 1)
        *_, profile = (one.profile for one in batch if isinstance(one, do.PublishProfile))
        told.append([load.renewal for load in profile.workers])
    assert told == [[Renewal.DUE], [Renewal.NONE], [Renewal.NONE]]


def test_a_foreign_worker_of_a_node_that_is_no_candidate_any_more_is_in_its_profile_until_it_is_idle() -> None:
    task = task_of(worker=WorkerSpec())
    node = node_of(fleet_of(task), "edge1")
    node.start(START)
    hear(node, *node.fleet.electors, now=START)
    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), START)
    for revision, owner in ((1, "edge1"), (2, "edge2")):
        told = Learnt(node="robot1", values=(allocation_of(revision, owner),))
        node.handle(ev.LearntReceived(learnt=told, is_answer=True), START)
    adopt(node, fleet_of(replace(task, candidates=("edge2",))), START + 0.1)
    assert node.busy() == {"merge"}, "it drains"
    assert node.worker_states == {"merge": WorkerState.READY}
    now = START
    while node.busy():
        now = max(now, node.next_deadline())
        node.handle(ev.DeadlineReached(), now)
    assert node.worker_states == {}
    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.STOPPED), now)
    batch = *node.handle(ev.ProfileSampled(device=SAMPLE), now), *node.handle(ev.DeadlineReached(), now + 2.0)
    assert [one.profile.workers for one in batch if isinstance(one, do.PublishProfile)][-1] == ()


def test_what_a_task_dropped_before_it_left_the_fleet_is_forgotten_when_it_comes_back() -> None:
    rule = StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/{task}/{robot}/map")
    stays, goes = (task_of(name, rules=(rule,)) for name in ("other", "merge"))
    node = node_of(fleet_of(goes, stays))
    node.start(START)
    counts = tuple(StreamCount(stream=f"{name}/in/0", drops=(("overflow", 3),)) for name in ("merge", "other"))
    node.handle(ev.StreamsCounted(counts=counts), START + 1)
    for second, there in enumerate((fleet_of(stays), fleet_of(goes, stays)), start=2):
        adopt(node, there, START + second)
    node.handle(ev.StreamsCounted(counts=counts), START + 10)
    ages = {task.name: task.streams[0].dropped_s for task in build_snapshot(node, START + 15).tasks}
    assert ages == {"merge": 5.0, "other": None}


@pytest.mark.parametrize("is_heard", [True, False])
def test_what_a_task_needed_is_not_what_one_of_its_name_needs_that_comes_later(*, is_heard: bool) -> None:
    """The removal is heard, or only that the task is another one. 20 GB are more than any candidate here has."""
    merge, other = (task_of(name, candidates=("edge1",)) for name in ("merge", "other"))
    fleet, without = fleet_of(merge, other), fleet_of(other)
    node = node_of(fleet)
    node.start(START)
    placed = Learnt(node="robot2", values=(allocation_of(1, "edge1"),))
    node.handle(ev.LearntReceived(learnt=placed, is_answer=True), START)
    large = load_of(memory_mb=20_000.0, cpu_cores=2.0, wanted_cores=3.0)
    learnt = profile_of("edge1", memory_mb=64_000.0, cpu_used_cores=4.0, runnable=4.0, workers=(large,))
    small = profile_of("edge1", sequence=2, memory_mb=8_000.0, runnable=9.0)
    for task in ("merge", "other"):
        shown = replace(learnt, workers=(replace(large, task=task),))
        assert node.gateway.demands.learn(task, shown, START)
        assert node.gateway.shares.learn(task, shown, START)
    assert [node.gateway.demand(spec, small).memory_mb for spec in (merge, other)] == [20_000.0, 20_000.0]
    assert node.gateway.shares.at("merge", small, 1.0, 0.0) == pytest.approx(2 / 3)
    if is_heard:
        adopt(node, without)
    else:
        later = allocation_of(CREATION_STEP + 1, "edge1", tuning=merge.tuning)
        node.registers["merge"].state = replace(node.registers["merge"].state, learnt=later)
    adopt(node, fleet)
    assert node.gateway.demand(merge, small) == merge.demand
    assert node.gateway.shares.at("merge", small, 1.0, 0.0) == pytest.approx(0.4)
    assert node.gateway.demand(other, small).memory_mb == 20_000.0, "it has stayed"


def test_what_a_machine_gave_is_not_held_against_one_of_its_name_that_comes_later() -> None:
    merge = task_of("merge", candidates=("edge1", "edge2"))
    there = fleet_of(merge, of=("edge1", "edge2", *ROBOTS))
    gone = fleet_of(replace(merge, candidates=("edge2",)), of=("edge2", *ROBOTS))
    node = node_of(there)
    crowded = load_of(memory_mb=100.0, cpu_cores=1.0, wanted_cores=3.0)
    full = profile_of("edge1", cpu_used_cores=4.0, runnable=4.0, workers=(crowded,))
    assert node.gateway.shares.learn("merge", full, START)
    before = node.gateway.shares.at("merge", full, 3.0)
    for fleet in (gone, there):
        adopt(node, fleet)
    assert node.gateway.shares.at("merge", full, 3.0) > before


def test_what_was_remembered_of_a_task_is_not_remembered_of_one_of_its_name_that_comes_unheard() -> None:
    """Its first placement waited for nobody, and its machine paid for what the former task had suffered there."""
    merge, other = (task_of(name, candidates=("edge1",)) for name in ("merge", "other"))
    fleet = fleet_of(merge, other)
    node = node_of(fleet)
    node.start(START)
    placed = Learnt(node="robot2", values=(allocation_of(1, "edge1"),))
    node.handle(ev.LearntReceived(learnt=placed, is_answer=True), START)
    rounds = {name: node.rounds.tasks[name] for name in ("merge", "other")}
    assert node.history["merge"]
    later = allocation_of(CREATION_STEP + 1, None, tuning=merge.tuning)
    node.registers["merge"].state = replace(node.registers["merge"].state, learnt=later)
    adopt(node, fleet)
    assert node.rounds.tasks["merge"] is not rounds["merge"]
    assert node.rounds.tasks["other"] is rounds["other"]
    assert not [one for one in node.history["merge"] if one.value.epoch == 1]


@pytest.mark.parametrize("worker", [WorkerSpec(command=("small",)), WorkerSpec(command=("large",), env=(("S", "1"),))])
@pytest.mark.parametrize("owner", ["edge1", None])
def test_a_changed_worker_needs_what_its_owner_s_one_does_and_nothing_where_there_is_none(
    owner: str | None, worker: WorkerSpec
) -> None:
    task = task_of(worker=WorkerSpec(command=("large",)))
    node = node_of(fleet_of(task))
    node.start(START)
    if owner:
        placed = Learnt(node="robot2", values=(allocation_of(1, owner),))
        node.handle(ev.LearntReceived(learnt=placed, is_answer=True), START)
    large = profile_of("edge1", memory_mb=64_000.0, workers=(load_of(memory_mb=20_000.0),))
    node.handle(ev.ProfileReceived(profile=large), START)
    node.gateway.demands.learn("merge", large, START)

    def need_mb() -> float:
        return node.gateway.demand(task, profile_of("edge2")).memory_mb

    adopt(node, fleet_of(replace(task, max_moves_per_minute=3)))
    assert need_mb() == 20_000.0, "it is the same program"
    adopt(node, fleet_of(replace(task, worker=worker)))
    assert need_mb() == (20_000.0 if owner else 0.0)
    due = replace(large, workers=(load_of(memory_mb=20_000.0, renewal=Renewal.DUE),))
    node.gateway.demands.learn("merge", due, START + 1)
    assert node.gateway.demands.is_replaced("merge", large), "the next one that is ready is the changed one"


def test_what_the_program_before_needed_is_void_once_the_others_run_the_one_that_was_tried() -> None:
    old = task_of(candidates=("edge1", "edge2"), worker=WorkerSpec(command=("old",)))
    promoted = replace(old, worker=WorkerSpec(command=("new",)))
    tried = replace(promoted, rollout=Rollout(task="merge", first=("edge2",), command=(Text("old"),)))
    node = node_of(fleet_of(old))
    shown = profile_of("edge1", cpu_used_cores=0.3, speed=1.0, workers=(load_of(cpu_cores=0.3),))

    def need() -> float:
        return node.gateway.demand(old, shown).cpu_cores

    adopt(node, fleet_of(tried), START)
    for second in range(20):
        node.gateway.demands.learn("merge", shown, START + second)
    adopt(node, fleet_of(tried), START + 20)
    assert need() == pytest.approx(0.3), "nothing has changed"
    adopt(node, fleet_of(promoted), START + 20)
    assert need() == old.demand.cpu_cores


def test_a_task_that_comes_back_has_the_first_owner_that_it_had() -> None:
    fleet, without = fleet_of(task_of("merge"), task_of("other")), fleet_of(task_of("other"))
    node = node_of(fleet)
    node.start(START)
    value = allocation_of(1, "edge1")
    node.handle(ev.LearntReceived(learnt=Learnt(node="robot2", values=(value,)), is_answer=True), START)
    adopt(node, without, START + 1)
    adopt(node, fleet, START + 2)
    owners = {task.name: task.owner for task in build_snapshot(node, START + 2).tasks}
    assert owners == {"merge": "edge1", "other": None}
    assert node.executors["merge"].owner == "edge1", "its streams go there"


def test_a_changed_tuning_becomes_a_change_of_the_agreed_one() -> None:
    fleet = fleet_of(task_of("merge", tuning=tuning_of(0.5, 0.5)), of=("edge1", "edge2", *ROBOTS))
    node = node_of(fleet)
    node.start(START)
    node.registers["merge"].state = replace(
        node.registers["merge"].state,
        learnt=replace(node.registers["merge"].value, revision=3, epoch=2, owner="edge1"),
    )
    adopt(node, fleet_of(task_of("merge", tuning=tuning_of(0.9, 0.1)), of=("edge1", "edge2", *ROBOTS)), START + 1)
    proposed = []
    for step in range(40):
        node.handle(ev.DeadlineReached(), START + 1 + step / 10)
        proposed.append(node.registers["merge"].is_busy)
    assert any(proposed), "it is proposed to the register"
    assert node.values()["merge"].tuning.weights.cpu == 0.5, "and counts when it is agreed"
