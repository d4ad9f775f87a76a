"""A rehearsal at the owner's door: what it does to itself, and each guard rail."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import Any

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from support.profiles import SAMPLE, load_of, profile_of
from support.states import state_of
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.document import Flag, FlagKind, Text
from zsched.core.values.fleet import Fleet, Security, WorkerSpec, electorate_hash
from zsched.core.values.messages import CommandOutcome, CommandResult
from zsched.core.values.model import Acceptance, Asked, Pause, PeerState, Pin, RegisterState
from zsched.core.values.profile import WorkerState
from zsched.core.values.rehearsal import KeepRehearsal, ReadRehearsals, Step, Strike

ADA = Asked(by="ada@robot1", reason="rehearsal 1")
PEERS = ("edge1", "edge2", "robot2")
TASK = task_of(
    candidates=("edge1", "edge2", "robot1"),
    worker=WorkerSpec(command=("merge",), failure_window_s=60.0),
)
FLEET = fleet_of(TASK, of=(*PEERS, "robot1"), electors=("edge1", "robot1", "robot2"))


class Owner:
    """robot1, which owns the task; peers are alive and their workers ready, unless ``ready`` or ``alive`` say less."""

    def __init__(
        self,
        fleet: Fleet = FLEET,
        *,
        ready: tuple[str, ...] = PEERS,
        alive: tuple[str, ...] = PEERS,
        **value: Any,
    ) -> None:
        self.now = 100.0
        learnt = allocation_of(5, epoch=3, **{"owner": "robot1", **value})
        held = Acceptance(ballot=ballot_of(1), value=learnt)
        register = RegisterState(task="merge", promised=held.ballot, accepted=held, learnt=learnt)
        electorate = electorate_hash(fleet)
        self.node = Node(
            fleet=fleet,
            me="robot1",
            durable=state_of("robot1", register, electorate=electorate),
            incarnation=7,
            electorate=electorate,
            rng=Random(1),
            now=self.now,
        )
        self.node.start(self.now)
        for name in alive:
            self.tell(ev.BeatReceived(beat=beat_of(name, incarnation=3, sequence=1)))
            state = WorkerState.READY if name in ready else WorkerState.STARTING
            loads = (load_of(state=state),) if name in TASK.candidates else ()
            profile = profile_of(name, incarnation=3, sequence=1, workers=loads)
            self.tell(ev.ProfileReceived(profile=profile))
        self.tell(ev.ProfileSampled(device=SAMPLE))
        self.tell(ev.WorkerChanged(task="merge", state=WorkerState.READY))

    def tell(self, event: ev.Event) -> tuple[do.Instruction, ...]:
        return self.node.handle(event, self.now)

    def strike(self, step: Step, *, is_near: bool = True, is_plan: bool = False) -> list[do.Instruction]:
        command = Strike(task="merge", step=step, asked=ADA, cut_s=5.0, is_plan=is_plan)
        batch = self.tell(ev.StrikeCommanded(request=42, command=command, is_near=is_near))
        kinds = (do.AnswerCommand, do.StrikeDaemon, do.RestartWorker)
        told = [one for one in batch if isinstance(one, do.RecordStory) and "rehearses" in one.text]
        return [*[one for one in batch if isinstance(one, kinds)], *told]

    def refusal(self, step: Step, *, is_near: bool = True) -> str:
        (answer,) = self.strike(step, is_near=is_near, is_plan=step is Step.DRAIN)
        assert isinstance(answer, do.AnswerCommand)
        assert answer.result.outcome is CommandOutcome.INVALID
        return answer.result.detail


def test_the_owner_kills_its_worker_and_tells_who_wanted_it() -> None:
    kill, answer, story = _sorted(Owner().strike(Step.WORKER))
    assert isinstance(kill, do.RestartWorker)
    assert (kill.task, kill.reason) == ("merge", "killed by ada@robot1, who rehearses")
    assert isinstance(answer, do.AnswerCommand)
    assert answer.result == CommandResult(outcome=CommandOutcome.OK, detail="it is killed")
    assert isinstance(story, do.RecordStory)
    assert story.text == "ada@robot1 (rehearsal 1) rehearses: the worker of merge here is killed"


def _sorted(found: list[do.Instruction]) -> tuple[do.Instruction, do.Instruction, do.Instruction]:
    order = (do.RestartWorker, do.AnswerCommand, do.RecordStory)
    first, second, third = sorted(found, key=lambda one: order.index(type(one)))
    return first, second, third


@pytest.mark.parametrize("step", [Step.DAEMON, Step.LINK])
def test_the_end_of_the_daemon_and_of_the_links_is_the_machines_matter(step: Step) -> None:
    strike, story = Owner().strike(step)
    assert isinstance(strike, do.StrikeDaemon)
    assert (strike.request, strike.strike.step, strike.fleet) == (42, step, FLEET)
    assert isinstance(story, do.RecordStory)


@pytest.mark.parametrize("step", [Step.DAEMON, Step.LINK])
def test_a_wish_that_came_over_the_network_ends_a_node_of_a_secured_fleet_only(step: Step) -> None:
    said = Owner().refusal(step, is_near=False)
    assert said.startswith("this fleet is not secured, so only an operator at robot1 itself may end")
    secured = replace(FLEET, security=Security(folder="/etc/zsched/pki"))
    strike, _ = Owner(secured).strike(step, is_near=False)
    assert isinstance(strike, do.StrikeDaemon)


@pytest.mark.parametrize("step", list(Step)[1:])
def test_nothing_is_done_where_nobody_else_could_take_over(step: Step) -> None:
    said = Owner(ready=()).refusal(step)
    assert said.startswith("no other candidate is fit for merge: edge1: ")
    assert "edge2: " in said


@pytest.mark.parametrize("step", list(Step)[1:])
def test_nothing_is_done_to_a_task_that_is_held(step: Step) -> None:
    paused = Owner(paused=True, pause=Pause(asked=ADA, revision=5))
    assert paused.refusal(step) == "merge is paused: a dead owner is not replaced; `zsched resume merge` first"
    pin = Pin(node="robot1", asked=ADA, revision=5, is_hard=True)
    assert Owner(pinned=True, pin=pin).refusal(step) == "merge is pinned to robot1 (hard): nobody else may have it"


def test_an_elector_that_is_needed_stays() -> None:
    alone = Owner(alive=("edge1", "edge2"))
    said = "robot1 is an elector, and the 1 others that are alive are no majority of 3"
    assert alone.refusal(Step.DAEMON) == said
    assert len(alone.strike(Step.WORKER)) == 3, "a worker is no elector"


def test_one_fault_at_a_time() -> None:
    owner = Owner()
    while owner.node.membership.state("edge1") is PeerState.ALIVE:
        assert owner.now < 110.0
        owner.now += 0.2
        owner.tell(ev.DeadlineReached())
    assert owner.refusal(Step.DAEMON) == "edge1, edge2, robot2 is suspect: one fault at a time"


def test_a_drain_is_only_checked_here_and_agreed_by_the_document() -> None:
    (answer,) = Owner().strike(Step.DRAIN, is_plan=True)
    assert isinstance(answer, do.AnswerCommand)
    assert answer.result == CommandResult(outcome=CommandOutcome.OK, detail="it can be drained")
    assert Owner().strike(Step.DRAIN, is_near=False, is_plan=True), "it ends no node, so it may come over the network"
    with pytest.raises(ValueError, match="drain is not done by a node to itself"):
        Strike(task="merge", step=Step.DRAIN, asked=ADA)


def test_a_node_that_has_an_order_is_not_drained_once_more() -> None:
    for kind, said in (
        (FlagKind.DRAIN, "robot1 is drained by eve@robot2"),
        (FlagKind.INELIGIBLE, "robot1 takes nothing new, by eve@robot2"),
    ):
        owner = Owner()
        owner.node.flags.take((Flag(kind=kind, subject="robot1", by="eve@robot2"),), owner.now)
        assert owner.refusal(Step.DRAIN) == said


def test_a_node_that_is_not_the_owner_or_goes_already_refuses() -> None:
    assert Owner(owner="edge1").refusal(Step.DAEMON) == "robot1 does not own merge"
    owner = Owner()
    owner.tell(ev.StopRequested())
    assert owner.refusal(Step.DAEMON) == "robot1 drains"
    command = Strike(task="nothing", step=Step.WORKER, asked=ADA)
    batch = owner.tell(ev.StrikeCommanded(request=1, command=command))
    assert [one.result.detail for one in batch if isinstance(one, do.AnswerCommand)] == ["no task 'nothing'"]


def test_a_worker_is_not_killed_so_often_that_its_node_would_fail() -> None:
    owner = Owner()
    owner.strike(Step.WORKER)
    owner.now += 12.0
    for name in PEERS:
        owner.tell(ev.BeatReceived(beat=beat_of(name, incarnation=3, sequence=2)))
        loads = (load_of(state=WorkerState.READY),) if name in TASK.candidates else ()
        owner.tell(ev.ProfileReceived(profile=profile_of(name, incarnation=3, sequence=2, workers=loads)))
    assert owner.refusal(Step.WORKER).startswith("its worker was killed 12 s ago: 3 failures within 60 s")


def test_a_worker_of_somebody_else_is_left_alone() -> None:
    foreign = fleet_of(replace(TASK, worker=WorkerSpec()), of=(*PEERS, "robot1"), electors=FLEET.electors)
    assert Owner(foreign).refusal(Step.WORKER).startswith("somebody else starts the worker")
    owner = Owner()
    owner.tell(ev.WorkerChanged(task="merge", state=WorkerState.STARTING))
    assert owner.refusal(Step.WORKER) == "its worker is not ready"


def test_what_was_found_is_kept_and_told_with_its_author() -> None:
    command = KeepRehearsal(task="merge", name="1", body=Text("{}"), told="4 steps", asked=ADA)
    batch = Owner().tell(ev.RehearsalKept(request=42, command=command))
    (store,) = [one for one in batch if isinstance(one, do.StoreRehearsal)]
    assert (store.request, store.rehearsal) == (42, command)
    (story,) = [one for one in batch if isinstance(one, do.RecordStory)]
    assert (story.rehearsal, story.text) == ("1", "rehearsed by ada@robot1 (rehearsal 1): 4 steps")
    batch = Owner().tell(ev.RehearsalKept(request=42, command=replace(command, task="nothing")))
    assert not [one for one in batch if isinstance(one, do.StoreRehearsal)]


def test_promises_are_told_for_a_task_that_there_is() -> None:
    owner = Owner()
    (told,) = owner.tell(ev.RehearsalsAsked(request=42, command=ReadRehearsals(task="merge")))
    assert isinstance(told, do.AnswerRehearsals)
    assert [one.step for one in told.told.promised] == list(Step)
    (told,) = owner.tell(ev.RehearsalsAsked(request=42, command=ReadRehearsals(name="1")))
    assert isinstance(told, do.AnswerRehearsals)
    assert (told.told.promised, told.name) == ((), "1")
    (refused,) = owner.tell(ev.RehearsalsAsked(request=42, command=ReadRehearsals(task="nothing")))
    assert isinstance(refused, do.AnswerCommand)
