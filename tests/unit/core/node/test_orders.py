"""Operators' orders at the door of one node that is its fleet's only elector: what is agreed, and what is refused."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from random import Random
from typing import Any

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import SAMPLE, load_of, profile_of
from support.states import state_of
from zsched.core.node.node import Node
from zsched.core.node.orders import unfit
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import MoveOwner
from zsched.core.values.document import Flag, FlagKind
from zsched.core.values.fleet import Fleet, Timing, WorkerSpec, electorate_hash
from zsched.core.values.messages import (
    CommandOutcome,
    CommandResult,
    Hold,
    HoldTask,
    Learnt,
    MoveTask,
    TuneTask,
)
from zsched.core.values.model import Acceptance, Allocation, Asked, RegisterState, ScoreForm
from zsched.core.values.profile import Link, LinkSample, LinkSource, WorkerState
from zsched.core.values.snapshot import FlagStatus
from zsched.core.vote.expiry import AGAIN_S
from zsched_lab.sim.simulator import Simulator

ADA = Asked(by="ada@robot1", reason="new battery")
EDGES = ("edge1", "edge2", "edge3")
FLEET = fleet_of(task_of("merge", EDGES, worker=WorkerSpec(command=("merge",))), of=(*EDGES, "robot1"))


class Lone:
    """A node whose questions to the electors come back to itself at once."""

    def __init__(self, owner: str | None = "edge1", fleet: Fleet = FLEET, **holds: Any) -> None:
        self.now = 100.0
        learnt = allocation_of(5, owner, 3, **holds)
        electorate = electorate_hash(fleet)
        held = Acceptance(ballot=ballot_of(1), value=learnt)
        register = RegisterState(task="merge", promised=held.ballot, accepted=held, learnt=learnt)
        self.node = Node(
            fleet=fleet,
            me="robot1",
            durable=state_of("robot1", register, electorate=electorate),
            incarnation=7,
            electorate=electorate,
            rng=Random(1),
            now=self.now,
        )
        self.done: list[do.Instruction] = []
        self._carry(self.node.start(self.now))
        for name in EDGES:
            self.hear(name)
            # who starts asks all others what they remember of it
            self.tell(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True))
        self.tell(ev.ProfileSampled(device=SAMPLE))
        self.wait(1.0)

    def hear(
        self, name: str, *, state: WorkerState = WorkerState.READY, draining: bool = False, number: int = 1
    ) -> None:
        self.tell(ev.BeatReceived(beat=beat_of(name, incarnation=3, sequence=number)))
        profile = profile_of(name, incarnation=3, sequence=number, workers=(load_of(state=state),), draining=draining)
        self.tell(ev.ProfileReceived(profile=profile))

    def tell(self, event: ev.Event) -> None:
        self._carry(self.node.handle(event, self.now))

    def wait(self, seconds: float) -> None:
        until = self.now + seconds
        while (due := self.node.next_deadline()) <= until:
            self.now = max(due, self.now)
            self.tell(ev.DeadlineReached())
        self.now = until

    def _carry(self, batch: tuple[do.Instruction, ...]) -> None:
        waiting = deque(batch)
        while waiting:
            one = waiting.popleft()
            self.done.append(one)
            event: ev.Event
            if isinstance(one, do.SendPrepare):
                event = ev.PrepareAsked(request=1, asker="robot1", prepare=one.prepare)
            elif isinstance(one, do.SendAccept):
                event = ev.AcceptAsked(request=1, asker="robot1", accept=one.accept)
            elif isinstance(one, do.AnswerElection):
                event = ev.ElectorAnswered(answer=one.answer)
            else:
                continue
            waiting.extend(self.node.handle(event, self.now))

    def ask(self, event: ev.Event) -> CommandResult:
        self.tell(event)
        answers = [one.result for one in self.done if isinstance(one, do.AnswerCommand) and one.request == 42]
        self.done.clear()
        assert len(answers) == 1
        return answers[0]

    def move(
        self, node: str, *, origin: str | None = None, base: int | None = None, plan: bool = False
    ) -> CommandResult:
        command = MoveTask(task="merge", node=node, asked=ADA, origin=origin, base_revision=base, is_plan=plan)
        return self.ask(ev.MoveCommanded(request=42, command=command))

    def hold(self, hold: Hold, node: str = "", *, hard: bool = False, for_s: float | None = None) -> CommandResult:
        command = HoldTask(task="merge", hold=hold, asked=ADA, node=node, is_hard=hard, for_s=for_s)
        return self.ask(ev.HoldCommanded(request=42, command=command))

    def value(self) -> Allocation:
        return self.node.registers["merge"].value


def test_a_move_is_agreed_without_a_vote_and_says_who_ordered_it() -> None:
    lone = Lone()
    result = lone.move("edge2", origin="edge1", base=lone.value().revision)
    assert (result.outcome, result.revision) == (CommandOutcome.OK, 6)
    assert (lone.value().owner, lone.value().epoch, lone.value().asked, lone.value().pinned) == ("edge2", 4, ADA, False)
    past = build_snapshot(lone.node, lone.now).tasks[0].history[-1]
    assert (past.owner, past.reason, past.by) == ("edge2", "moved by ada@robot1 (new battery)", "ada@robot1")
    assert lone.node.rounds.tasks["merge"].fuse.memory().moves == (), "the fuse does not count it"


def test_a_plan_moves_nothing() -> None:
    lone = Lone()
    assert lone.move("edge2", plan=True).outcome is CommandOutcome.OK
    assert lone.move("edge1", plan=True).outcome is CommandOutcome.UNCHANGED
    assert lone.value().revision == 5


@pytest.mark.parametrize(
    ("target", "outcome", "says"),
    [
        ("edge1", CommandOutcome.UNCHANGED, "so already"),
        ("robot1", CommandOutcome.INVALID, "no candidate; there are edge1, edge2, edge3"),
        ("edge9", CommandOutcome.INVALID, "no candidate"),
    ],
)
def test_a_move_to_no_candidate_or_to_the_owner_is_not_made(target: str, outcome: CommandOutcome, says: str) -> None:
    lone = Lone()
    result = lone.move(target)
    assert (result.outcome, lone.value().revision) == (outcome, 5)
    assert says in result.detail


@pytest.mark.parametrize(
    ("state", "is_draining", "says"),
    [
        (WorkerState.FAILED, False, "edge2 cannot have it: worker failed"),
        (WorkerState.STARTING, False, "edge2 cannot have it: worker starting"),
        (WorkerState.READY, True, "edge2 cannot have it: draining"),
    ],
)
def test_a_move_to_a_node_that_cannot_have_the_task_is_refused_with_the_reason(
    state: WorkerState, says: str, *, is_draining: bool
) -> None:
    lone = Lone()
    lone.hear("edge2", state=state, draining=is_draining, number=2)
    result = lone.move("edge2")
    assert (result.outcome, result.detail, lone.value().revision) == (CommandOutcome.INVALID, says, 5)


def test_an_operator_may_send_a_task_where_it_would_not_go_by_itself() -> None:
    """A margin above a limit keeps a task from moving there and back; it was told as "robot1 does not reach it"."""
    tuning = tuning_of(cpu=0.5, memory=0.2, network=0.3, score=ScoreForm.SERVICE)
    task = replace(FLEET.tasks[0], tuning=tuning, gauge_limits=(("battery", 0.2),))
    lone = Lone(fleet=fleet_of(task, of=(*EDGES, "robot1")), tuning=tuning)
    heard = {"edge1": -60.0, "edge2": -78.0, "edge3": -90.0}
    links = tuple(LinkSample(source=LinkSource.NL80211, peer=name, rssi_dbm=dbm) for name, dbm in heard.items())
    for number in range(2, 12):
        lone.wait(0.2)
        lone.tell(ev.ProfileSampled(device=SAMPLE, links=links))
        for name in EDGES:
            lone.hear(name, number=number)
    assert lone.move("edge3").detail == "edge3 cannot have it: robot1 does not reach it"
    assert lone.move("edge2").outcome is CommandOutcome.OK


def test_a_node_that_does_not_vote_refuses_nobody_for_links_that_it_cannot_measure() -> None:
    """Robots measure theirs to each candidate; an edge that was asked found the best one without a link."""
    tuning = tuning_of(cpu=0.5, memory=0.2, network=0.3, score=ScoreForm.SERVICE)
    candidates = ("edge2", "edge3", "robot1")
    sim = Simulator(fleet=fleet_of(task_of("merge", candidates, tuning=tuning), of=(*EDGES, "robot1")), seed=1)
    sim.start()
    sim.run(5.0)
    value = replace(allocation_of(5, "edge3", 3), tuning=tuning)
    told = {}
    for name in ("edge1", "robot1"):
        node = sim.node(name)
        links = tuple(Link(source=LinkSource.NL80211, peer=peer, rssi_dbm=-60.0) for peer in ("edge1", "robot1"))
        for speaker in sorted({"robot1", "edge3"} - {name}):
            known = node.gateway.fresh(speaker, sim.now)
            assert known is not None
            heard = replace(known, sequence=known.sequence + 1, links=links)
            assert node.gateway.absorb(heard, sim.now) is None
        told[name] = unfit(node, value, "edge2", sim.now)
    assert told == {"edge1": "", "robot1": "network: not measured there, and it has a weight"}


def test_a_move_to_a_node_that_is_gone_is_refused() -> None:
    lone = Lone()
    for number in range(2, 12):
        for name in ("edge1", "edge3"):
            lone.hear(name, number=number)
        lone.wait(0.5)
    assert lone.move("edge2").detail == "edge2 cannot have it: it is gone"


def test_an_order_for_another_revision_or_owner_is_a_conflict() -> None:
    lone = Lone()
    assert lone.move("edge2", base=4).outcome is CommandOutcome.CONFLICT
    assert lone.move("edge2", origin="edge3").detail == "its owner is edge1, not edge3"


def test_a_paused_task_still_moves_by_order_and_is_loud_in_the_status() -> None:
    lone = Lone()
    assert lone.hold(Hold.PAUSE, for_s=7200.0).outcome is CommandOutcome.OK
    lone.wait(1.0)
    task = build_snapshot(lone.node, lone.now).tasks[0]
    assert task.pause is not None
    assert (task.pause.by, task.pause.reason, task.pause.for_s, task.pause.known_s) == (
        "ada@robot1",
        "new battery",
        7200.0,
        1.0,
    )
    (problem,) = [problem for problem in task.problems if "paused" in problem]
    assert problem.startswith("paused by ada@robot1 (new battery): nothing moves it by itself, and a dead owner")
    lone.hear("edge2", number=2)
    assert lone.move("edge2").outcome is CommandOutcome.OK
    assert (lone.value().owner, lone.value().paused) == ("edge2", True)
    assert lone.hold(Hold.RESUME).outcome is CommandOutcome.OK
    assert (lone.value().paused, lone.value().pause) == (False, None)
    assert lone.hold(Hold.RESUME).outcome is CommandOutcome.UNCHANGED


def test_a_pause_ends_by_itself_when_its_time_is_over() -> None:
    lone = Lone()
    lone.hold(Hold.PAUSE, for_s=60.0)
    lone.wait(59.0)
    assert lone.value().paused
    lone.wait(10.0)
    assert not lone.value().paused
    assert lone.node.history["merge"][-1].reason == "the time of its pause is over"


def test_an_end_that_is_under_way_is_not_proposed_once_more(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where electors are slow a round takes longer than `AGAIN_S`, and what waits behind it must not pile up."""
    lone = Lone()
    lone.hold(Hold.PAUSE, for_s=60.0)
    register = lone.node.registers["merge"]
    monkeypatch.setattr(register, "_clocks", lambda: Timing(ballot_s=3.0))
    monkeypatch.setattr(lone, "_carry", lambda _batch: None)
    lone.wait(60.0 + 2.5 * AGAIN_S)
    assert [one.reason for one in register.wanted] == ["the time of its pause is over"]


def test_a_pin_is_to_the_owner_or_to_a_candidate_and_a_move_elsewhere_is_refused() -> None:
    lone = Lone()
    assert lone.hold(Hold.PIN).outcome is CommandOutcome.OK
    assert (lone.value().home, lone.value().epoch) == ("edge1", 3)
    assert "unpin merge" in lone.move("edge2").detail
    assert lone.hold(Hold.PIN, "edge3", hard=True).outcome is CommandOutcome.OK
    assert (lone.value().home, lone.value().is_bound, lone.value().owner) == ("edge3", True, "edge1")
    assert lone.move("edge3").outcome is CommandOutcome.OK, "to its place it may be moved"
    assert lone.hold(Hold.PIN, "robot1").outcome is CommandOutcome.INVALID
    assert lone.hold(Hold.UNPIN).outcome is CommandOutcome.OK
    assert lone.value().home is None
    assert lone.hold(Hold.UNPIN).outcome is CommandOutcome.UNCHANGED
    assert Lone(owner=None, paused=True).hold(Hold.PIN).detail == "it has no owner: name the node to pin it to"


def test_a_lasting_order_and_its_end_leave_owner_and_epoch() -> None:
    """Another epoch would be another ownership: leases and workers would begin anew."""
    lone = Lone()
    for revision, hold in enumerate((Hold.PIN, Hold.PAUSE, Hold.UNPIN, Hold.RESUME), start=6):
        assert lone.hold(hold).outcome is CommandOutcome.OK
        assert (lone.value().revision, lone.value().owner, lone.value().epoch) == (revision, "edge1", 3)
    assert lone.hold(Hold.PAUSE, for_s=60.0).outcome is CommandOutcome.OK
    lone.wait(70.0)
    assert (lone.value().paused, lone.value().owner, lone.value().epoch) == (False, "edge1", 3), "nor when time ends it"


def test_a_tuning_is_agreed_for_the_revision_that_it_was_made_of() -> None:
    lone, wanted = Lone(), tuning_of(bonus=0.3)
    command = TuneTask(task="merge", tuning=wanted, base_revision=5, asked=ADA)
    assert lone.ask(ev.TuneCommanded(request=42, command=command)).outcome is CommandOutcome.OK
    assert (lone.value().tuning, lone.value().epoch) == (wanted, 3)
    assert lone.ask(ev.TuneCommanded(request=42, command=command)).outcome is CommandOutcome.CONFLICT
    again = TuneTask(task="merge", tuning=wanted, base_revision=6, asked=ADA)
    assert lone.ask(ev.TuneCommanded(request=42, command=again)).outcome is CommandOutcome.UNCHANGED
    crossed = TuneTask(task="merge", tuning=replace(wanted, nu_dbm=-30.0), base_revision=6, asked=ADA)
    refused = lone.ask(ev.TuneCommanded(request=42, command=crossed))
    assert (refused.outcome, refused.detail) == (CommandOutcome.INVALID, "nu_dbm (-30) must be below rho_dbm (-40)")
    unknown = TuneTask(task="mergee", tuning=wanted, base_revision=6, asked=ADA)
    assert lone.ask(ev.TuneCommanded(request=42, command=unknown)).outcome is CommandOutcome.INVALID


# --- in the history --------------------------------------------------------------------------------------------------


def test_every_node_writes_down_who_has_ordered_what_it_learns() -> None:
    lone = Lone()
    lone.tell(ev.HoldCommanded(request=42, command=HoldTask(task="merge", hold=Hold.PAUSE, asked=ADA)))
    assert [one.by for one in lone.done if isinstance(one, do.RecordStory) and one.by] == ["ada@robot1"]
    lone.done.clear()
    tuned = TuneTask(task="merge", tuning=tuning_of(bonus=0.4), base_revision=6, asked=ADA)
    lone.tell(ev.TuneCommanded(request=42, command=tuned))
    (story,) = [one for one in lone.done if isinstance(one, do.RecordStory) and one.by]
    assert story.text.endswith("retuned by ada@robot1 (new battery)")


def test_a_node_that_has_not_agreed_an_order_tells_it_from_the_value_alone() -> None:
    lone = Lone()
    other = Node(
        fleet=FLEET,
        me="edge3",
        durable=state_of("edge3"),
        incarnation=7,
        electorate=electorate_hash(FLEET),
        rng=Random(1),
        now=100.0,
    )
    other.start(100.0)
    for hold in (None, Hold.PAUSE, Hold.PIN, Hold.RESUME, Hold.UNPIN):
        if hold is not None:
            lone.hold(hold)
        learnt = Learnt(node="robot1", values=(lone.value(),))
        other.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 101.0)
    who = "by ada@robot1 (new battery)"
    assert [past.reason for past in other.history["merge"]][1:] == [
        f"paused {who}",
        f"pinned to edge1 {who}",
        f"changed {who}",
        f"changed {who}",
    ]


# --- flags -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kind", "why"),
    [(FlagKind.DRAIN, "it is drained by ada@robot1"), (FlagKind.INELIGIBLE, "it takes nothing new, by")],
)
def test_a_flagged_node_gets_no_task_by_an_order(kind: FlagKind, why: str) -> None:
    lone = Lone()
    lone.node.flags.take((Flag(kind=kind, subject="edge2", by="ada@robot1"),), lone.now)
    refused = lone.move("edge2")
    assert refused.outcome is CommandOutcome.INVALID
    assert f"edge2 cannot have it: {why}" in refused.detail
    assert lone.move("edge3").outcome is CommandOutcome.OK


def test_what_was_voted_for_a_node_before_its_flag_was_known_is_not_proposed() -> None:
    for flags, owner in (((), "edge2"), ((Flag(kind=FlagKind.DRAIN, subject="edge2"),), "edge1")):
        lone = Lone()
        voting = lone.node.votes.tasks["merge"]
        base = lone.node.registers["merge"].value.revision
        voting.commit, voting._won_at = MoveOwner(base_revision=base, owner="edge2", reason="better"), lone.now
        lone.node.flags.take(flags, lone.now)
        lone.tell(ev.DeadlineReached())
        assert lone.node.registers["merge"].value.owner == owner
        assert voting.commit is None, "votes may be called again"


def test_a_status_tells_flags_with_their_age() -> None:
    lone = Lone()
    flag = Flag(kind=FlagKind.DRAIN, subject="edge2", by="ada@robot1", reason="new fan", for_s=60.0)
    lone.node.flags.take((flag,), lone.now)
    nodes = {one.name: one for one in build_snapshot(lone.node, lone.now + 5.0).nodes}
    assert nodes["edge2"].flags == (
        FlagStatus(kind="drain", by="ada@robot1", reason="new fan", known_s=5.0, for_s=60.0),
    )
    assert nodes["edge1"].flags == ()
