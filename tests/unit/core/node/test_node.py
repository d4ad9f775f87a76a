"""The door: what one node makes of what it is told, by itself (whole fleets: tests/sim, test_node_prefixes)."""

from __future__ import annotations

from collections import deque
from dataclasses import fields, is_dataclass, replace
from random import Random
from typing import Any, TypeVar

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of, hear
from support.fleets import fleet_of, task_of, tuning_of
from support.profiles import SAMPLE, load_of, profile_of
from support.proposals import proposal_of, vector_of
from support.states import state_of
from zsched.core.electorate.strangers import SHOWN_S
from zsched.core.executor.handover import HEARS_S
from zsched.core.executor.sparing import Sparing
from zsched.core.membership.identity import QUIET_S
from zsched.core.membership.knocking import KNOCKERS_KEPT, SHOWN_AFTER_S
from zsched.core.node import work
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.node.work import FROM_A_PEER, carry_out
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.document import Text
from zsched.core.values.durable import DurableState
from zsched.core.values.fleet import StreamRule, WorkerSpec, electorate_hash
from zsched.core.values.messages import (
    Accept,
    CommandOutcome,
    Learnt,
    Prepare,
    Promise,
    ReadFleet,
    ReadHistory,
    Refusal,
    Refused,
    RestartTask,
    TakeCertificate,
    Utilities,
)
from zsched.core.values.model import Acceptance, Allocation, Asked, Ballot, PeerState, RegisterState
from zsched.core.values.plan import Direction, ReadyWhen, RoutePhase, StreamCount, WorkerRole
from zsched.core.values.problems import Problem, ProblemKey
from zsched.core.values.profile import Echo, WorkerLoad, WorkerState
from zsched.core.values.startup import Startup
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP

T = TypeVar("T")
ROBOTS, EDGES = ("robot1", "robot2", "robot3"), ("edge1", "edge2")
TUNING = tuning_of()
RULE = StreamRule(direction=Direction.INPUT, from_template="{robot}/map", to_template="{target}/merge/{robot}/map")
FLEET = fleet_of(
    task_of(candidates=EDGES, worker=WorkerSpec(command=("merge",)), rules=(RULE,)),
    of=sorted((*ROBOTS, *EDGES)),
    electors=ROBOTS,
)
ELECTORATE = electorate_hash(FLEET)


def durable(me: str, *registers: RegisterState) -> DurableState:
    return state_of(me, *registers, electorate=ELECTORATE)


def make(
    me: str = "robot1",
    *,
    has_state: bool = True,
    learnt: Allocation | None = None,
    now: float = 100.0,
    creation: int = 0,
) -> Node:
    is_blank = learnt is None and not creation
    state = durable(me) if is_blank else durable(me, RegisterState(task="merge", learnt=learnt, creation=creation))
    return Node(
        fleet=FLEET,
        me=me,
        durable=state if has_state else None,
        incarnation=7,
        electorate=ELECTORATE,
        rng=Random(1),
        now=now,
    )


def started(me: str = "robot1", *, has_state: bool = True, learnt: Allocation | None = None) -> Node:
    """A node that has heard everybody and its own first sample, at 100 s."""
    node = make(me, has_state=has_state, learnt=learnt)
    node.start(100.0)
    for name in (*ROBOTS, *EDGES):
        if name != me:
            node.handle(ev.LearntReceived(learnt=Learnt(node=name, values=()), is_answer=True), 100.0)
            node.handle(ev.BeatReceived(beat=beat(name)), 100.0)
    node.handle(ev.ProfileSampled(device=SAMPLE), 100.0)
    return node


def beat(node: str, sequence: int = 1, *, incarnation: int = 3, revision: int = 0) -> Beat:
    learnt = (("merge", revision, revision),) if revision else ()
    return beat_of(node, sequence, incarnation=incarnation, learnt=learnt)


def ballot(counter: int, node: str) -> Ballot:
    return ballot_of(counter, node)


def prepare(counter: int, node: str, *, task: str = "merge", asker: str | None = None) -> ev.PrepareAsked:
    asked = Prepare(task=task, ballot=ballot(counter, node), electorate=ELECTORATE)
    return ev.PrepareAsked(request=counter, asker=asker or node, prepare=asked)


def accept(counter: int, node: str, allocation: Allocation, *, asker: str | None = None) -> ev.AcceptAsked:
    acceptance = Acceptance(ballot=ballot(counter, node), value=allocation)
    asked = Accept(task=allocation.task, acceptance=acceptance, electorate=ELECTORATE)
    return ev.AcceptAsked(request=counter, asker=asker or node, accept=asked)


def profile(node: str, *, draining: bool = False) -> ev.ProfileReceived:
    return ev.ProfileReceived(profile=profile_of(node, incarnation=3, memory_used_mb=1.0, draining=draining))


def proposal(voter: str, candidate: str, *, task: str = "merge", base: int = 0) -> ev.ProposalReceived:
    paper = proposal_of(voter, candidate, task=task, base_revision=base)
    return ev.ProposalReceived(proposal=paper)


def of(batch: tuple[do.Instruction, ...], kind: type[T]) -> list[T]:
    return [one for one in batch if isinstance(one, kind)]


def digest(thing: Any, seen: frozenset[int] = frozenset()) -> Any:
    """Every field of every object that hangs on ``thing``, but what is only shown and what only refers to code."""
    if isinstance(thing, Random):
        return thing.getstate()
    if isinstance(thing, str | int | float | bool | None):
        return thing
    if id(thing) in seen:
        return "..."
    seen |= {id(thing)}
    if isinstance(thing, dict):
        return {str(key): digest(item, seen) for key, item in thing.items()}
    if isinstance(thing, list | tuple | deque | set | frozenset):
        return [digest(item, seen) for item in thing]
    names = [field.name for field in fields(thing)] if is_dataclass(thing) else list(getattr(thing, "__dict__", ()))
    names += [name for name in getattr(type(thing), "__slots__", ()) if hasattr(thing, name)]
    skipped = {"counters", "dropped_at", "knocking", "_handlers", "fleet", "_fleet"}
    return {name: digest(getattr(thing, name), seen) for name in names if name not in skipped}


# --- strangers -------------------------------------------------------------------------------------------------------

STRANGER_VALUE = replace(allocation_of(9, "edge1"), task="other")
STRANGERS: dict[str, ev.Event] = {
    "beat of a node that the file does not name": ev.BeatReceived(beat=beat("ghost", revision=99)),
    "token of it": ev.TokenSeen(node="ghost", incarnation=1),
    "lost token of it": ev.TokenLost(node="ghost", incarnation=1),
    "lost token of a life we do not know": ev.TokenLost(node="edge1", incarnation=99),
    "profile of it": profile("ghost"),
    "prepare of it": prepare(5, "ghost"),
    "accept of it": accept(5, "ghost", allocation_of(1, "edge1")),
    "learnt value of it": ev.LearntReceived(
        learnt=Learnt(node="ghost", values=(allocation_of(5, "edge2"),)), is_answer=True
    ),
    "its utilities": ev.UtilityReceived(gather=1, utilities=Utilities(voter="ghost", vectors=())),
    "proposal of it": proposal("ghost", "edge1"),
    "proposal of an edge": proposal("edge1", "edge1"),
    "proposal in our own name": proposal("robot1", "edge1"),
    "proposal for an unknown task": proposal("robot2", "edge1", task="other"),
    "proposal for a robot, which is no candidate": proposal("robot2", "robot3"),
    "prepare for an unknown task": prepare(5, "robot2", task="other"),
    "prepare under another's ballot": prepare(5, "robot2", asker="robot3"),
    "accept for an unknown task": accept(5, "robot2", STRANGER_VALUE),
    "accept under another's ballot": accept(5, "robot2", allocation_of(1, "edge1"), asker="robot3"),
    "answer for an unknown task": ev.ElectorAnswered(
        answer=Promise(elector="robot2", task="other", ballot=ballot(1, "robot1"))
    ),
    "answer of a node that is no elector": ev.ElectorAnswered(
        answer=Promise(elector="edge1", task="merge", ballot=ballot(1, "robot1"))
    ),
    "learnt value of an unknown task": ev.LearntReceived(
        learnt=Learnt(node="robot2", values=(STRANGER_VALUE,)), is_answer=True
    ),
    "vectors that are another's": ev.UtilityReceived(
        gather=1,
        utilities=Utilities(voter="robot2", vectors=(vector_of("robot3", {}),)),
    ),
    "late utilities": ev.UtilityReceived(gather=77, utilities=Utilities(voter="robot2", vectors=())),
    "frame that the bus dropped": ev.FrameDropped(kind="beat", reason="size"),
    "stale profile": profile("edge2"),
    "slot of an unknown task": ev.SlotReady(task="other", epoch=1),
    "flip of an unknown task": ev.SlotFlipped(task="other", epoch=1),
    "drain of an unknown task": ev.SlotDrained(task="other", epoch=1),
}
UNCOUNTED = {
    "lost token of it",
    "lost token of a life we do not know",
    "slot of an unknown task",
    "flip of an unknown task",
    "drain of an unknown task",
}
"""What comes from our own machine, or is ordinary."""


@pytest.mark.parametrize("name", STRANGERS)
def test_strangers_frame_raises_a_counter_and_changes_nothing(name: str) -> None:
    node = started()
    node.handle(profile("edge2"), 100.0)
    while node.next_deadline() <= 100.0:
        node.handle(ev.DeadlineReached(), 100.0)
    before, counted = digest(node), node.counters + node.agreement.counters

    batch = node.handle(STRANGERS[name], 100.0)

    assert batch == ()
    assert digest(node) == before
    raised = (node.counters + node.agreement.counters).total() - counted.total()
    assert raised == (0 if name in UNCOUNTED else 1)


def test_digest_sees_a_change_deep_inside() -> None:
    """The test above can fail: an ordinary frame changes the digest."""
    node = started()
    before = digest(node)
    node.handle(prepare(5, "robot2"), 100.0)
    assert digest(node) != before


# --- the disk --------------------------------------------------------------------------------------------------------


def test_promise_is_persisted_in_front_of_its_answer() -> None:
    batch = started().handle(prepare(5, "robot2"), 100.0)
    assert isinstance(batch[0], do.PersistState)
    assert batch[0].state.registers[0].promised == ballot(5, "robot2")
    (answer,) = of(batch, do.AnswerElection)
    assert isinstance(answer.answer, Promise)


def test_node_whose_disk_refuses_its_start_knows_what_was_agreed_and_is_no_elector() -> None:
    """It dropped its whole state, and began by its fleet file."""
    value = allocation_of(5, "edge1", tuning=FLEET.tasks[0].tuning)
    node = make(learnt=value)
    node.agreement.on_persist_failed("cannot write state: No space left on device")
    batch = node.start(100.0)
    assert node.values()["merge"] == value
    batch += node.handle(prepare(6, "robot3"), 100.0)
    assert not of(batch, do.PersistState)
    assert [type(one.answer) for one in of(batch, do.AnswerElection)] == [Refused]
    snapshot = build_snapshot(node, 100.0)
    assert (snapshot.quorum.this_node, snapshot.tasks[0].owner) == ("lost_state", "edge1")
    assert any("No space left" in text and "no elector until it is restarted" in text for text in snapshot.problems)


def test_node_whose_disk_refused_is_no_elector_and_says_so() -> None:
    node = started()
    node.handle(prepare(5, "robot2"), 100.0)
    node.handle(ev.PersistFailed(reason="no space left on device"), 100.0)

    batch = node.handle(prepare(6, "robot3"), 100.0)

    assert not of(batch, do.PersistState)
    (answer,) = of(batch, do.AnswerElection)
    assert isinstance(answer.answer, Refused)
    assert answer.answer.refusal is Refusal.NOT_ELECTOR
    snapshot = build_snapshot(node, 100.0)
    assert snapshot.quorum.this_node == "lost_state"
    assert snapshot.quorum.alive == 2
    assert any("no space left" in text and "restarted" in text for text in snapshot.problems)
    (told,) = of(node.handle(ev.DeadlineReached(), 102.0), do.PublishBeat)
    assert told.beat.votes == node.agreement.answer().votes == 0, "more in the beat, and all would ask it for ever"


def test_refused_disk_loses_no_route() -> None:
    """The batch that carried the plan was cut off; the plan comes again with the failure."""
    node = started()
    first = node.handle(
        ev.LearntReceived(learnt=Learnt(node="robot2", values=(allocation_of(1, "edge1"),)), is_answer=True), 100.0
    )
    again = node.handle(ev.PersistFailed(reason="read-only"), 100.0)
    assert [one.plan for one in of(again, do.ApplyRoutes)] == [one.plan for one in of(first, do.ApplyRoutes)]
    assert of(again, do.ApplyRoutes)[0].plan.phase is RoutePhase.PREPARE


def test_refused_disk_loses_no_role_and_no_worker_start() -> None:
    node = started("edge1")
    node.handle(
        ev.LearntReceived(learnt=Learnt(node="robot2", values=(allocation_of(1, "edge1"),)), is_answer=True), 100.0
    )
    again = node.handle(ev.PersistFailed(reason="read-only"), 100.0)
    assert do.StartWorker(task="merge") in again
    assert [one.role.role for one in of(again, do.SetRole)] == [WorkerRole.ACTIVE]


def test_learnt_values_apply_on_a_node_without_state_too() -> None:
    node = started(has_state=False)
    batch = node.handle(
        ev.LearntReceived(learnt=Learnt(node="robot2", values=(allocation_of(1, "edge1"),)), is_answer=True), 100.0
    )
    assert not of(batch, do.PersistState)
    assert of(batch, do.ApplyRoutes)
    (answer,) = of(node.handle(prepare(9, "robot2"), 100.0), do.AnswerElection)
    assert isinstance(answer.answer, Refused)
    assert answer.answer.refusal is Refusal.NOT_ELECTOR


def test_restart_carries_out_again_what_was_learnt() -> None:
    (plan,) = of(make("robot1", learnt=allocation_of(4, "edge1", 2)).start(100.0), do.ApplyRoutes)
    assert plan.plan.phase is RoutePhase.PREPARE


def test_a_restarted_owner_is_told_its_role_once_a_majority_is_heard_and_knows_nothing_newer() -> None:
    """What it has stored may be older than a move that was made while it was away."""
    node = make("edge1", learnt=allocation_of(4, "edge1", 2))
    assert not of(node.start(100.0), do.SetRole)
    assert not of(node.handle(ev.BeatReceived(beat=beat("robot1", revision=4)), 100.1), do.SetRole)
    told = node.handle(ev.BeatReceived(beat=beat("robot2", revision=4)), 100.2)
    assert [(one.role.role, one.role.epoch) for one in of(told, do.SetRole)] == [(WorkerRole.ACTIVE, 2)]


def test_a_restarted_owner_that_was_replaced_is_never_told_to_be_active() -> None:
    node = make("edge1", learnt=allocation_of(4, "edge1", 2))
    batches = [node.start(100.0)]
    for name, revision in (("robot1", 4), ("robot2", 5), ("robot3", 5)):
        batches.append(node.handle(ev.BeatReceived(beat=beat(name, revision=revision)), 100.1))
    batches.append(node.handle(learnt_from("robot2", allocation_of(5, "edge2", 3)), 100.2))
    roles = [one.role.role for batch in batches for one in of(batch, do.SetRole)]
    assert roles == [WorkerRole.IDLE]


def test_a_node_of_another_generation_keeps_no_restarted_owner_from_its_work() -> None:
    node = make("edge1", learnt=allocation_of(4, "edge1", 2))
    node.start(100.0)
    other = replace(beat("robot3", revision=2**32), generation=1)
    batches = [node.handle(ev.BeatReceived(beat=one), 100.1) for one in (other, beat("robot1"), beat("robot2"))]
    assert [one.role.role for batch in batches for one in of(batch, do.SetRole)] == [WorkerRole.ACTIVE]


def test_a_value_that_is_learnt_in_this_life_is_carried_out_whatever_anybody_tells() -> None:
    node = started("edge1")
    node.handle(ev.BeatReceived(beat=beat("robot3", revision=99)), 100.0)
    told = node.handle(learnt_from("robot2", allocation_of(5, "edge1", 3)), 100.1)
    assert [one.role.role for one in of(told, do.SetRole)] == [WorkerRole.ACTIVE]


def test_an_elector_whose_disk_is_full_still_confirms_what_an_owner_has_stored() -> None:
    node = make("edge1", learnt=allocation_of(4, "edge1", 2))
    node.start(100.0)
    full = replace(beat("robot1", revision=4), has_lost_state=True, disk_refusal="No space left on device")
    batches = [node.handle(ev.BeatReceived(beat=one), 100.1) for one in (full, beat("robot2", revision=4))]
    assert [one.role.role for batch in batches for one in of(batch, do.SetRole)] == [WorkerRole.ACTIVE]


def learnt_from(peer: str, value: Allocation) -> ev.LearntReceived:
    return ev.LearntReceived(learnt=Learnt(node=peer, values=(value,)), is_answer=True)


def moves_in(batch: tuple[do.Instruction, ...]) -> list[tuple[str | None, str | None, int, bool]]:
    stories = of(batch, do.RecordStory)
    return [(one.move.left, one.move.owner, one.move.epoch, one.move.is_known) for one in stories if one.move]


@pytest.mark.parametrize(
    ("revision", "epoch", "told"),
    [
        pytest.param(5, 3, "moved by ada@robot1", id="she has moved it"),
        pytest.param(6, 4, "moved by ada@robot1", id="a vote and then she, or she twice"),
        pytest.param(6, 3, FROM_A_PEER, id="a vote, and then she has changed its weights, or the other way round"),
    ],
)
def test_an_order_that_came_behind_a_move_is_not_told_as_the_move(revision: int, epoch: int, told: str) -> None:
    """A robot was away while the task moved; it must not tell, nor count, an operator's move that nobody ordered."""
    node = started(learnt=allocation_of(4, "edge1", 2))
    now = node.next_deadline()
    value = allocation_of(revision, "edge2", epoch, asked=Asked(by="ada@robot1"))
    node.handle(learnt_from("robot2", value), now)
    assert node.history["merge"][-1].reason == told
    assert len(node.rounds.tasks["merge"].fuse.memory().moves) == (told == FROM_A_PEER)


def test_that_another_node_committed_a_value_hangs_on_no_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(work, "FROM_A_PEER", "somebody said so")
    node = started()
    batch = node.handle(learnt_from("robot2", allocation_of(4, "edge1", 2)), node.next_deadline())
    assert [is_known for *_, is_known in moves_in(batch)] == [True], "the first news"
    node.handle(learnt_from("robot2", allocation_of(6, "edge2", 3, asked=Asked(by="ada@robot1"))), 100.5)
    assert node.history["merge"][-1].reason == "somebody said so"
    assert len(node.rounds.tasks["merge"].fuse.memory().moves) == 1


def test_an_owner_that_was_there_before_the_start_is_told_as_known_and_the_next_one_as_a_move() -> None:
    node = make("robot1", learnt=allocation_of(4, "edge1", 2))
    assert moves_in(node.start(100.0)) == [(None, "edge1", 2, True)]
    assert moves_in(node.handle(learnt_from("robot2", allocation_of(5, "edge2", 3)), 100.0)) == [
        ("edge1", "edge2", 3, False)
    ]
    assert moves_in(node.handle(learnt_from("robot2", allocation_of(6, "edge2", 3)), 100.0)) == [], "the same owner"
    assert moves_in(make("robot1", learnt=allocation_of(1, None, 0)).start(100.0)) == [], "nobody has it"


def test_who_has_not_committed_a_move_tells_the_reason_of_one_that_wanted_it() -> None:
    node = make("robot1", learnt=allocation_of(4, "edge1", 2))
    node.start(100.0)
    for voter, candidate in (("robot2", "edge1"), ("robot3", "edge2")):
        paper = proposal_of(voter, candidate, base_revision=4, reason=f"{candidate} is idle")
        node.handle(ev.ProposalReceived(proposal=paper), 100.0)
    batch = node.handle(learnt_from("robot2", allocation_of(5, "edge2", 3)), 100.1)
    (move,) = [one.move for one in of(batch, do.RecordStory) if one.move]
    assert (move.reason, move.votes) == ("edge2 is idle", (("robot2", "edge1"), ("robot3", "edge2")))


@pytest.mark.parametrize(("epoch", "is_known"), [(1, False), (2, True), (CREATION_STEP + 1, False)])
def test_of_a_peers_first_news_only_the_first_placement_is_a_move(epoch: int, is_known: bool) -> None:
    node = make("edge1", creation=epoch // CREATION_STEP)
    node.start(100.0)
    hear(node, *ROBOTS, now=100.0)
    batch = node.handle(learnt_from("robot2", allocation_of(epoch, "edge1")), 100.0)
    assert moves_in(batch) == [(None, "edge1", epoch, is_known)]
    assert any("first news here" in one.text for one in of(batch, do.RecordStory)) is is_known


@pytest.mark.parametrize("life", [3, 4], ids=["the same life", "another life"])
def test_an_owner_that_this_machine_missed_for_a_while_is_asked_for_its_worker_s_state(life: int) -> None:
    """Its link was away, not the owner: nobody moved the task then, and the owner's worker has what the task knows."""
    node, now = started("edge2", learnt=allocation_of(1, "edge1")), 100.0
    while node.membership.state("edge1") is not PeerState.GONE:
        now = node.next_deadline()
        assert now < 110.0
        node.handle(ev.DeadlineReached(), now)
    node.handle(ev.BeatReceived(beat=beat("edge1", 2, incarnation=life)), now)
    batch = node.handle(learnt_from("robot2", allocation_of(2, "edge2")), now + 1.0)
    (role,) = [one.role for one in of(batch, do.SetRole)]
    assert (role.role, role.predecessor) == (WorkerRole.ACTIVE, "edge1")


# --- own events like peers' ------------------------------------------------------------------------------------------


def test_a_robot_that_drains_what_it_owns_asks_at_once_who_shall_have_it() -> None:
    (task,) = FLEET.tasks
    fleet = replace(FLEET, tasks=(replace(task, candidates=(*EDGES, "robot1")),))
    for owner, asks in (("robot1", True), ("edge1", False)):
        node = Node(
            fleet=fleet, me="robot1", durable=durable("robot1"), incarnation=7, electorate="e", rng=Random(1), now=100.0
        )
        learnt = Learnt(node="robot2", values=(allocation_of(1, owner),))
        node.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 100.0)
        for name in ("robot2", "robot3"):
            node.handle(ev.BeatReceived(beat=beat(name)), 100.0)
        node.handle(ev.DeadlineReached(), node.rounds.next_deadline())
        node.handle(ev.DeadlineReached(), node.rounds.next_deadline())  # the gather that ran is over
        now = node.rounds.next_deadline() - 0.1
        assert bool(of(node.handle(ev.StopRequested(), now), do.AskUtilities)) is asks


def test_movable_is_what_a_living_candidate_that_does_not_drain_could_take() -> None:
    node = started("edge1", learnt=allocation_of(1, "edge1"))
    assert (node.owned(), node.movable(100.0)) == (("merge",), ("merge",))
    node.handle(profile("edge2", draining=True), 100.0)
    assert node.movable(100.0) == ()
    alone = make("edge1", learnt=allocation_of(1, "edge1"))
    alone.start(100.0)
    assert (alone.owned(), alone.movable(100.0)) == (("merge",), ())


def test_a_candidate_that_begins_anew_is_not_ready_by_the_word_of_its_former_life() -> None:
    node = make("edge1", learnt=allocation_of(1, "edge1"))
    node.start(100.0)
    node.handle(ev.BeatReceived(beat=beat("edge2")), 100.0)
    assert [one.sparing for one in node.lacking(100.0)] == [Sparing.STARTING], "no profile of it has come"
    ready = profile_of("edge2", incarnation=3, workers=(load_of("merge", WorkerState.READY),))
    node.handle(ev.ProfileReceived(profile=ready), 100.0)
    assert node.lacking(100.0) == ()
    node.handle(ev.BeatReceived(beat=beat("edge2", incarnation=4)), 100.5)
    assert [one.sparing for one in node.lacking(100.5)] == [Sparing.STARTING], "it has not told yet"
    starting = replace(ready, incarnation=4, workers=(load_of("merge", WorkerState.STARTING),))
    node.handle(ev.ProfileReceived(profile=starting), 100.6)
    assert [one.sparing for one in node.lacking(100.6)] == [Sparing.STARTING]
    node.handle(ev.ProfileReceived(profile=replace(ready, incarnation=4, sequence=9)), 100.7)
    assert node.lacking(100.7) == ()


def test_a_newer_profile_in_our_name_is_not_ours_either() -> None:
    node = make()
    (published,) = of(node.handle(ev.ProfileSampled(device=SAMPLE), 100.0), do.PublishProfile)
    before, counters = node.gateway.newest("robot1", 100.0), dict(node.counters)
    forged = replace(published.profile, sequence=published.profile.sequence + 1, cpu_used_cores=4.0)
    assert node.handle(ev.ProfileReceived(profile=forged), 100.0) == ()
    assert node.gateway.newest("robot1", 100.0) == before
    assert node.counters == counters


@pytest.mark.parametrize(("base", "counted"), [(3, "proposal_stale"), (5, "proposal_ahead"), (4, None)])
def test_proposals_on_another_base_are_counted_by_which_side_is_behind(base: int, counted: str | None) -> None:
    node = started(learnt=allocation_of(4, "edge1"))
    node.handle(proposal("robot2", "edge2", base=base), 100.0)
    assert [name for name in node.counters if name.startswith("proposal_")] == ([] if counted is None else [counted])
    assert counted is None or node.counters[counted] == 1


def test_stopped_worker_is_told_in_the_same_batch_and_once() -> None:
    node = started("edge1")
    batch = node.handle(ev.WorkerChanged(task="merge", state=WorkerState.FAILED, reason="exit code 1"), 100.1)
    (published,) = of(batch, do.PublishProfile)
    assert [load.state for load in published.profile.workers] == [WorkerState.FAILED]
    assert published.is_news
    assert [one.text for one in of(batch, do.RecordStory)] == ["worker failed: exit code 1"]
    assert node.handle(ev.WorkerChanged(task="merge", state=WorkerState.FAILED), 100.1) == ()


# --- what people are told --------------------------------------------------------------------------------------------


def test_relay_that_is_down_is_a_problem_until_it_is_up() -> None:
    node = started()
    node.handle(ev.RelayChanged(is_running=False, reason="exit code 1"), 100.0)
    assert "relay: the relay is down: exit code 1" in build_snapshot(node, 100.0).problems
    node.handle(ev.RelayChanged(is_running=True), 100.0)
    assert build_snapshot(node, 100.0).problems == ()
    assert node.counters["relay_exits"] == 1


def test_a_machine_that_measures_nothing_any_more_is_a_problem_until_it_does() -> None:
    """A reader that hangs raises nothing, and profiles go on without figures."""
    node = started()
    for at, is_told in ((110.0, False), (111.2, True)):
        node.handle(ev.DeadlineReached(), at)
        assert any("measuring: nothing of this machine" in one for one in build_snapshot(node, at).problems) is is_told
    node.handle(ev.ProfileSampled(device=SAMPLE), 112.0)
    assert not any("measuring" in one for one in build_snapshot(node, 112.0).problems)


def test_a_relay_that_keeps_ending_is_a_problem_on_every_node() -> None:
    robot1, robot2 = started("robot1"), started("robot2")

    def told(at: float) -> set[str]:
        """What is heard of robot2 in time, and then shown by both."""
        for published in of(robot2.handle(ev.DeadlineReached(), at), do.PublishProfile):
            robot1.handle(ev.ProfileReceived(profile=published.profile), at)
        robot2.handle(ev.BeatReceived(beat=beat("robot1", round(at))), at)
        robot1.handle(ev.BeatReceived(beat=beat("robot2", round(at))), at)
        shown = {tuple(one for one in build_snapshot(node, at).problems if "relay" in one) for node in (robot1, robot2)}
        assert len(shown) == 1
        return set(shown.pop())

    for at in (101.0, 102.0, 103.0):
        assert told(at) == set()
        robot2.handle(ev.RelayChanged(is_running=False, reason="exit code -9"), at)
        robot2.handle(ev.RelayChanged(is_running=True), at + 0.1)
    why = (
        "has ended 3 times in 60 s, last: exit code -9; its streams rest meanwhile: look at the log of zsched on robot2"
    )
    assert told(104.0) == {f"the relay of robot2 {why}"}
    assert told(162.0) == set()


def test_a_problem_of_a_relay_is_sent_at_once_and_not_said_of_a_node_that_is_not_there() -> None:
    robot1, robot2 = started("robot1"), started("robot2")
    down = ev.RelayChanged(is_running=False, reason="exit code -9")
    assert not of((*robot2.handle(down, 100.1), *robot2.handle(down, 100.1)), do.PublishProfile)
    (published,) = of(robot2.handle(down, 100.1), do.PublishProfile)
    assert published.is_news
    robot1.handle(ev.ProfileReceived(profile=published.profile), 100.1)
    assert len(build_snapshot(robot1, 100.1).problems) == 1
    robot1.handle(ev.DeadlineReached(), 120.0)
    assert not [one for one in build_snapshot(robot1, 120.0).problems if "relay" in one]


def test_what_a_relay_complained_of_ends_with_it_and_with_the_task() -> None:
    node = started()
    for source in ("relay/merge", "relay/other", "relay/local", "profile"):
        node.handle(ev.ProblemReported(source=source, problem="broken"), 100.0)
    less = replace(FLEET, tasks=(replace(*FLEET.tasks, name="other"),))
    node.handle(ev.FleetChanged(fleet=less), 100.1)
    assert {*node.problems} == {("relay", "other"), ("relay", "local"), ("profile", "")}
    node.handle(ev.RelayChanged(is_running=False, reason="exit code -9"), 100.2)
    assert {*node.problems} == {("relay", ""), ("profile", "")}
    node.handle(ev.ProblemReported(source="relay/local", problem="broken"), 100.3)
    node.handle(ev.RelayChanged(is_running=True), 100.4)
    assert {*node.problems} == {("relay", "local"), ("profile", "")}, "the next one has said it before it was ready"


def test_a_relay_that_has_gone_leaves_every_slot_to_be_taken_again() -> None:
    node = started(learnt=allocation_of(1, "edge1"))
    for event in (ev.SlotReady(task="merge", epoch=1), ev.SlotFlipped(task="merge", epoch=1)):
        node.handle(event, 101.0)
    assert build_snapshot(node, 111.0).tasks[0].problems == ()
    node.handle(ev.SlotReady(task="merge", epoch=1, is_ready=False, has_token=False), 109.0)
    node.handle(ev.RelayChanged(is_running=False, reason="exited"), 110.0)
    node.handle(ev.RelayChanged(is_running=True), 110.5)
    (problem,) = build_snapshot(node, 115.0).tasks[0].problems
    assert problem.startswith("this robot's streams have waited for edge1 for 5 s")
    assert "worker's token, or its subscriptions: `zsched ping" in problem, (
        "what the old relay missed is its own affair"
    )
    node.handle(ev.SlotReady(task="merge", epoch=1), 116.0)
    assert build_snapshot(node, 120.0).tasks[0].problems == ()


def test_a_slot_of_a_foreign_worker_says_which_key_nobody_takes() -> None:
    (task,) = FLEET.tasks
    foreign = replace(task, worker=WorkerSpec(ready_when=ReadyWhen.MATCHING))
    answers = replace(RULE, direction=Direction.OUTPUT)
    for rules, what in (((answers, RULE), "edge1/"), ((answers,), "them")):
        fleet = replace(FLEET, tasks=(replace(foreign, rules=rules),))
        node = Node(
            fleet=fleet, me="robot1", durable=durable("robot1"), incarnation=7, electorate="e", rng=Random(1), now=100.0
        )
        learnt = Learnt(node="robot2", values=(allocation_of(1, "edge1"),))
        node.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 100.0)
        (problem,) = build_snapshot(node, 105.0).tasks[0].problems
        assert f"our relay sees nobody take {what}" in problem


def test_our_own_name_elsewhere_is_a_problem_until_its_token_goes() -> None:
    node = started()
    node.handle(ev.TokenSeen(node="robot1", incarnation=8), 100.0)
    assert node.problems["membership", ""].startswith("another daemon calls itself 'robot1'; stop it")
    node.handle(ev.TokenLost(node="robot1", incarnation=7), 100.0)
    assert node.problems, "our own token, seen from outside, says nothing about the other's"
    node.handle(ev.TokenLost(node="robot1", incarnation=8), 100.0)
    assert node.problems == {}


def hear_twin(node: Node, start: float, beats: int, *, first: int = 100) -> tuple[do.Instruction, ...]:
    """Beats in the node's own name, five a second."""
    batch: tuple[do.Instruction, ...] = ()
    for step in range(beats):
        now = start + step * 0.2
        batch += node.handle(ev.BeatReceived(beat=beat("robot1", first + step, incarnation=8)), now)
    return batch


def test_beats_in_our_name_alone_are_a_complaint_that_ends_and_nothing_else() -> None:
    """Anybody can put beats: they write nothing to disk, make nobody leave, and are forgotten."""
    node = started()
    batch = hear_twin(node, 100.0, 60)
    assert "somebody sends beats in the name of 'robot1'" in node.problems["membership", ""]
    assert of(batch, do.StandDown) == []
    assert not any(one.state.disputed for one in of(batch, do.PersistState))
    assert node.agreement.is_elector
    node.handle(ev.ProfileSampled(device=SAMPLE), 111.9 + QUIET_S)
    node.handle(ev.DeadlineReached(), 112.0 + QUIET_S)
    assert node.problems == {}


def test_younger_twin_leaves_and_the_older_one_stays() -> None:
    """Who has beaten less often came later; one beat alone may be an echo of an earlier life."""
    young, old = started(), started()
    for node in (young, old):
        node.handle(ev.TokenSeen(node="robot1", incarnation=8), 100.0)
    batch = hear_twin(young, 100.5, 2)
    assert len(of(batch, do.StandDown)) == 1
    for step in range(40):
        old.handle(ev.DeadlineReached(), 100.0 + step * 0.2)
    batch = hear_twin(old, 108.0, 2, first=1)
    assert of(batch, do.StandDown) == []
    assert old.agreement.is_elector


def test_a_peer_s_beat_about_twins_is_only_a_reason_to_ask_it() -> None:
    node = started()
    said = replace(beat("robot2", 2), twins=("robot1",))
    batch = node.handle(ev.BeatReceived(beat=said), 100.2)
    assert [one.peer for one in of(batch, do.AskLearnt)] == ["robot2"]
    assert of(batch, do.StandDown) == []
    assert node.problems == {}
    unasked = Learnt(node="robot2", values=(), twins=(("robot1", 7, 2), ("robot1", 6, 500)))
    for step in range(50):
        told = replace(unasked, twins=(("robot1", 7, 2), ("robot1", 6, 500 + step)))
        batch = node.handle(ev.LearntReceived(learnt=told), 100.2 + step * 0.1)
        assert of(batch, do.StandDown) == []
    assert node.problems == {}


def test_a_young_node_leaves_when_peers_answer_that_they_hear_an_older_one() -> None:
    node = started()
    left = []
    for step in range(20):
        learnt = Learnt(node="robot2", values=(), twins=(("robot1", 7, 2), ("robot1", 6, 500 + step)))
        batch = node.handle(ev.LearntReceived(learnt=learnt, is_answer=True), 101.0 + step * 0.1)
        left += of(batch, do.StandDown)
    assert left
    assert "another daemon calls itself 'robot1': robot2 hears it; stop it, or give" in left[0].reason


def test_a_node_that_hears_twins_tells_them_and_the_operator() -> None:
    node = started()
    for incarnation in (3, 4):
        node.handle(ev.TokenSeen(node="edge1", incarnation=incarnation), 100.0)
    batch: tuple[do.Instruction, ...] = ()
    for step in range(1, 10):
        for incarnation in (3, 4):
            heard = beat("edge1", step + 1, incarnation=incarnation)
            batch += node.handle(ev.BeatReceived(beat=heard), 100.0 + step * 0.2)
    assert ("edge1",) in [one.beat.twins for one in of(batch, do.PublishBeat)]
    assert "edge1" in [one.peer for one in of(batch, do.AskLearnt)]
    assert any(one.text == "two daemons call themselves edge1" for one in of(batch, do.RecordStory))
    here = Learnt(node="edge1", values=(), daemon=4)
    node.handle(ev.LearntReceived(learnt=here, is_answer=True, where="tcp/10.0.0.9:7447"), 101.8)
    answer = of(node.handle(ev.LearntAsked(request=1), 101.8), do.AnswerLearnt)[0].learnt
    assert (answer.daemon, answer.twins) == (7, (("edge1", 3, 10), ("edge1", 4, 10)))
    node.handle(ev.BeatReceived(beat=beat("edge1", 11, incarnation=3)), 102.0)
    problem = build_snapshot(node, 102.0).problems[0]
    assert "2 daemons call themselves 'edge1'" in problem
    assert "tcp/10.0.0.9:7447 (incarnation 4)" in problem


def test_twin_that_stays_disputes_the_name_on_disk() -> None:
    node = started()
    node.handle(ev.TokenSeen(node="robot1", incarnation=8), 100.0)
    batch = hear_twin(node, 110.0, 40)
    assert not node.agreement.is_elector
    assert any(one.state.disputed for one in of(batch, do.PersistState))
    assert of(batch, do.StandDown) == []


def test_another_fleet_file_is_a_problem_until_it_is_the_same() -> None:
    node = started()
    strange = replace(beat("robot2", 1), fleet_file="0123456789abcdef")
    node.handle(ev.BeatReceived(beat=strange), 100.0)
    told = f"robot2 goes by another fleet file (0123456789abcdef, here {node.fleet_file}): compare them ("
    assert node.problems["fleet", "robot2"].startswith(told)
    assert node.problems["fleet", "robot2"].endswith(
        "restart no daemon: docs/guide/service.md, Add or remove a machine"
    )
    node.startup = Startup(fleet_path="/etc/zsched/fleet.yaml")
    node.handle(ev.BeatReceived(beat=replace(strange, sequence=2)), 100.1)
    assert f"here {node.fleet_file} of /etc/zsched/fleet.yaml)" in node.problems["fleet", "robot2"]
    node.handle(ev.BeatReceived(beat=replace(beat("robot2", 3), fleet_file=node.fleet_file)), 100.2)
    assert node.problems == {}


def test_a_node_of_another_generation_is_told_while_it_beats() -> None:
    """Also by a node where nothing else is due that would look for it."""
    node, now = started(), 100.1
    said: dict[str, dict[str, Any]] = {"robot2": {"generation": 1}, "robot3": {"lease_terms": f"{'ab' * 8}/2"}}
    for name, strange in said.items():
        node.handle(ev.BeatReceived(beat=beat_of(name, 2, incarnation=3, **strange)), now)
    assert set(node.agreement.problems) == {(Problem.GENERATION, name) for name in said}
    while now < 100.1 + SHOWN_S + 1.0:
        now = node.next_deadline()
        node.handle(ev.DeadlineReached(), now)
    assert node.agreement.problems == {}


def test_who_goes_while_it_has_another_fleet_file_is_no_problem_until_it_is_back_with_it() -> None:
    """It was switched off during a change: the others would beat at full pace until it is back."""
    node, now = started(), 100.0
    strange = replace(beat("robot2", 2), fleet_file="0123456789abcdef")
    node.handle(ev.BeatReceived(beat=strange), now)
    assert ("fleet", "robot2") in node.problems
    while node.membership.state("robot2") is not PeerState.GONE:
        now = node.next_deadline()
        assert now < 110.0
        node.handle(ev.DeadlineReached(), now)
    assert ("fleet", "robot2") not in node.problems
    node.handle(ev.BeatReceived(beat=replace(strange, sequence=3)), now)
    assert ("fleet", "robot2") in node.problems


def test_a_node_that_our_file_does_not_name_is_told_while_it_beats() -> None:
    node = started()

    def knock(now: float, *numbers: int) -> None:
        for number in numbers:
            beat_ = replace(beat(f"robot{number + 10}", round(now * 10)), fleet_file="0123456789abcdef")
            node.handle(ev.BeatReceived(beat=beat_), now)

    def told(now: float) -> list[str]:
        return [one for one in build_snapshot(node, now).problems if "beats in this fleet" in one]

    knock(100.0, *range(9))
    assert told(100.0) == [], "one that has just been taken out ends in a moment"
    last = 100.0 + SHOWN_AFTER_S
    knock(last, *range(9))
    said = told(last + QUIET_S - 0.01)
    assert len(said) == KNOCKERS_KEPT
    assert said[0].startswith(
        "fleet/robot10: robot10 beats in this fleet, goes by another fleet file (0123456789abcdef, "
    )
    assert "and is in no line of this one: compare them (`zsched check` tells a file's hash)" in said[0]
    agreed = node.knocking.problems(last, is_agreed=True)
    assert agreed[Problem.FLEET, "robot10"] == (
        "robot10 beats in this fleet, and the agreed document does not name it: `zsched leave` on that "
        "machine if it was taken out, `zsched invite robot10` here if it shall come"
    )
    assert told(last + QUIET_S) == []
    again = last + QUIET_S
    knock(again, 89)
    knock(again + SHOWN_AFTER_S, 89)
    assert any("robot99" in one for one in told(again + SHOWN_AFTER_S)), "the others made room"


# --- peers -----------------------------------------------------------------------------------------------------------


def test_changes_of_peers_are_told_at_once() -> None:
    """The others may wait for a second observer: the beat leaves in the same batch, with the accusation."""
    node = started()
    batch = node.handle(ev.TokenLost(node="edge1", incarnation=3), 100.1)
    (told,) = of(batch, do.PublishBeat)
    assert told.beat.suspects == ("edge1",)
    assert told.is_news, "it wakes its receivers up"
    assert node.membership.state("edge1") is PeerState.SUSPECT


def test_whoever_is_heard_again_is_no_suspect_in_the_same_batch() -> None:
    """A suspect that goes on being named by this node could be held for gone by another one."""
    node = started()
    node.handle(ev.TokenLost(node="edge1", incarnation=3), 100.1)
    batch = node.handle(ev.BeatReceived(beat=beat("edge1", 2)), 100.15)
    assert node.membership.state("edge1") is PeerState.ALIVE
    (told,) = of(batch, do.PublishBeat)
    assert told.beat.suspects == ()
    assert any("suspect -> alive" in one.text for one in of(batch, do.RecordStory) if one.stage == "membership")


def test_beats_are_numbered_one_by_one() -> None:
    """A gap would look like lost beats."""
    node, now = started(), 100.0
    numbers: list[int] = []
    while len(numbers) < 4:
        now = max(node.next_deadline(), now)
        numbers += [one.beat.sequence for one in of(node.handle(ev.DeadlineReached(), now), do.PublishBeat)]
    assert numbers == list(range(numbers[0], numbers[0] + 4))


@pytest.mark.parametrize(
    ("news", "is_calm"),
    [
        (ev.ProblemReported(source="disk", problem="slow"), True),
        ((Problem.OWN_FILE, ""), True),
        ((Problem.FLEET, ""), True),
        (ev.StreamsCounted(counts=(StreamCount(stream="merge/in/0", last_seen_s=1.5),)), True),
        ((Problem.FLEET, "robot9"), False),
        (ev.StreamsCounted(counts=(StreamCount(stream="merge/in/0", in_flight=1),)), False),
        (accept(5, "robot2", allocation_of(5, "edge2", 3)), False),
    ],
    ids=[
        "at rest",
        "a file of its own",
        "a changed file that is not in force",
        "a relay that tells no more",
        "another file elsewhere",
        "a sample under way",
        "a value that is not learnt yet",
    ],
)
def test_beats_say_that_a_node_is_calm_while_nothing_goes_on_there(
    news: ev.Event | ProblemKey, *, is_calm: bool
) -> None:
    node, sent = started(learnt=allocation_of(4, "edge1", 2)), False
    if isinstance(news, tuple):
        node.set_problem(news[0], "told", news[1])
    else:
        node.handle(news, 100.0)
    for number in range(2, 35):
        now = 100.0 + 0.2 * number
        while node.next_deadline() < now:
            for told in of(node.handle(ev.DeadlineReached(), node.next_deadline()), do.PublishBeat):
                sent = told.beat.calm
        for name in ("robot2", "robot3", *EDGES):
            node.handle(ev.BeatReceived(beat=beat(name, number)), now)
    assert sent is is_calm


def test_after_a_stall_nobody_is_accused_whose_beat_waits() -> None:
    """Absorbed one after the other, judged at the end; whoever has sent nothing meanwhile is suspect."""
    node, now = started(), 105.0
    for name in ("robot2", "robot3", "edge1"):
        node.absorb(ev.BeatReceived(beat=beat(name, 30)), now)
    batch = node.handle(ev.DeadlineReached(), now)
    accused = [one.text.split()[0] for one in of(batch, do.RecordStory) if "suspect" in one.text]
    assert accused == ["edge2"]
    hasty = started()
    batch = hasty.handle(ev.BeatReceived(beat=beat("robot2", 30)), now)
    assert len([one for one in of(batch, do.RecordStory) if "-> suspect" in one.text]) == 3, "what it is good for"


# --- a node that a task has left -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("votes", "is_failure"),
    [
        pytest.param({}, False, id="away: the others have moved the task by plan, or not"),
        pytest.param({"robot1": True}, False, id="away: it would have fled itself"),
        pytest.param({"robot1": False, "robot2": False}, False, id="a planned move, and then it was gone"),
        pytest.param({"robot2": True}, True, id="another robot fled"),
        pytest.param({"robot1": True, "robot2": False}, True, id="it fled itself, and others answered"),
    ],
)
def test_a_node_has_failed_by_a_vote_for_an_escape_and_not_because_this_robot_was_away(
    votes: dict[str, bool], *, is_failure: bool
) -> None:
    """What one robot holds against a node counts with all of them."""
    node = started(learnt=allocation_of(4, "edge1", 2))
    node.rounds.tasks["merge"].judge.kept.look({"edge1": 0.9}, None, 90.0)
    while node.membership.state("edge1") is not PeerState.GONE:
        node.handle(ev.DeadlineReached(), node.next_deadline())
    now = node.next_deadline()
    for voter, is_escape in votes.items():
        paper = proposal_of(voter, "edge2", base_revision=4, is_escape=is_escape)
        node.votes.tasks["merge"].absorb(paper, node.values()["merge"], now)
    node.handle(learnt_from("robot3", allocation_of(5, "edge2", 3)), now)
    assert set(node.rounds.tasks["merge"].judge.kept.seen) == ({"edge1"} if is_failure else set())


def test_who_has_committed_an_escape_remembers_the_failure() -> None:
    node = started(learnt=allocation_of(4, "edge1", 2))
    node.rounds.tasks["merge"].judge.kept.look({"edge1": 0.9}, None, 90.0)
    while node.membership.state("edge1") is not PeerState.GONE:
        node.handle(ev.DeadlineReached(), node.next_deadline())
    carry_out(node, allocation_of(5, "edge2", 3), "edge1 is gone", ToDo(), node.next_deadline())
    assert set(node.rounds.tasks["merge"].judge.kept.seen) == {"edge1"}


@pytest.mark.parametrize("is_escape", [True, False])
def test_a_node_that_is_silent_for_a_moment_has_failed_only_if_the_task_fled_from_it(*, is_escape: bool) -> None:
    """A machine is left because it is full, and then its beats come late: a planned move holds nothing against it."""
    node = started(learnt=allocation_of(4, "edge1", 2))
    node.rounds.tasks["merge"].judge.kept.look({"edge1": 0.9}, None, 90.0)
    while node.membership.state("edge1") is not PeerState.SUSPECT:
        node.handle(ev.DeadlineReached(), node.next_deadline())
    now = node.next_deadline()
    for voter in ("robot1", "robot2"):
        paper = proposal_of(voter, "edge2", base_revision=4, is_escape=is_escape)
        node.votes.tasks["merge"].absorb(paper, node.values()["merge"], now)
    carry_out(node, allocation_of(5, "edge2", 3), "2 of 2 for edge2", ToDo(), now)
    assert set(node.rounds.tasks["merge"].judge.kept.seen) == ({"edge1"} if is_escape else set())


@pytest.mark.parametrize("is_escape", [True, False])
def test_a_flight_from_a_node_that_has_not_failed_counts_in_the_cap_of_escapes(*, is_escape: bool) -> None:
    """It is too far, or drains: six of them a minute held back planned moves, and sixty held nothing back."""
    node = started(learnt=allocation_of(4, "edge1", 2))
    for voter in ("robot1", "robot2"):
        paper = proposal_of(voter, "edge2", base_revision=4, is_escape=is_escape)
        node.votes.tasks["merge"].absorb(paper, node.values()["merge"], 100.0)
    node.handle(learnt_from("robot3", allocation_of(5, "edge2", 3)), 100.1)
    task = node.rounds.tasks["merge"]
    assert task.judge.kept.seen == {}
    assert task.fuse.memory().moves == ((100.1, is_escape),)


# --- an operator who has mended something ----------------------------------------------------------------------------


def test_a_worker_that_somebody_has_mended_is_held_against_its_node_no_more() -> None:
    node = make("robot1")
    kept = node.rounds.tasks["merge"].judge.kept
    kept.look(dict.fromkeys(EDGES, 0.9), None, 99.0)
    for left in EDGES:
        node.rounds.on_moved("merge", left, has_failed=True, now=100.0)
    tells = profile("edge1").profile
    for number, state in enumerate((WorkerState.FAILED, WorkerState.FAILED, WorkerState.STARTING), 5):
        assert set(kept.seen) == set(EDGES)
        loads = (WorkerLoad(task="merge", state=state),)
        node.handle(ev.ProfileReceived(profile=replace(tells, sequence=number, workers=loads)), 100.0)
    assert set(kept.seen) == set(EDGES) - {"edge1"}


def test_a_worker_that_runs_by_an_old_recipe_is_started_again_once() -> None:
    edge = started("edge1")
    edge.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    assert of(edge.handle(ev.DeadlineReached(), 100.1), do.RenewWorker) == []
    batch = edge.handle(ev.RecipeCompared(task="merge", is_old=True), 100.2)
    assert of(batch, do.RenewWorker) == [do.RenewWorker(task="merge")]
    assert of(edge.handle(ev.DeadlineReached(), 100.3), do.RenewWorker) == []


def test_a_worker_that_the_next_relay_sees_is_waited_for_no_longer_than_it_takes_to_hear_its_role() -> None:
    edge = started("edge1")
    edge.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    executor = edge.executors["merge"]
    for leased in (False, True):
        executor.execute(replace(allocation_of(1, "edge1"), leased=leased), ToDo(), 100.1)
    assert executor.may_work_unleased(200.0), "what it has said went with the relay"
    edge.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 200.0)
    assert not executor.may_work_unleased(200.0 + HEARS_S)


def test_what_a_worker_complains_of_is_in_the_next_profile() -> None:
    edge = started("edge1")
    edge.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    edge.handle(ev.WorkerTroubled(task="merge", count=2, text="ValueError: x"), 100.1)
    (told,) = of(edge.handle(ev.ProfileSampled(device=SAMPLE), 102.0), do.PublishProfile)
    assert told.profile.workers[0].reason == "callback raised 2 times: ValueError: x"


def test_a_state_that_is_lost_in_a_move_is_in_the_story() -> None:
    edge = started("edge1")
    batch = edge.handle(ev.WorkerTroubled(task="merge", count=0, text="began epoch 2 cold", is_cold=True), 100.1)
    assert [one.text for one in of(batch, do.RecordStory)] == ["the worker began epoch 2 cold"]


def test_a_restart_is_for_a_worker_that_runs_here_and_is_no_failure() -> None:
    edge = make("edge1")
    for state in (WorkerState.STARTING, WorkerState.READY, WorkerState.FAILED):
        edge.handle(ev.WorkerChanged(task="merge", state=state), 100.0)
        batch = edge.handle(ev.RestartCommanded(request=7, command=RestartTask(task="merge")), 100.0)
        assert of(batch, do.RenewWorker) == [do.RenewWorker(task="merge")]
        result = of(batch, do.AnswerCommand)[0].result
        assert (result.outcome, result.detail) == (
            CommandOutcome.OK,
            f"its worker is started again, it was {state}",
        )


@pytest.mark.parametrize(
    ("name", "task", "state", "said"),
    [
        ("edge1", "other", None, "no task 'other'"),
        ("robot1", "merge", None, "robot1 has no worker of merge"),
        ("edge1", "merge", WorkerState.STOPPED, "its worker does not run"),
    ],
)
def test_a_restart_of_what_does_not_run_is_refused(name: str, task: str, state: WorkerState | None, said: str) -> None:
    node = make(name)
    if state is not None:
        node.handle(ev.WorkerChanged(task="merge", state=state), 100.0)
    batch = node.handle(ev.RestartCommanded(request=7, command=RestartTask(task=task)), 100.0)
    assert of(batch, do.RenewWorker) == []
    result = of(batch, do.AnswerCommand)[0].result
    assert (result.outcome, result.detail) == (CommandOutcome.INVALID, said)


def test_a_worker_that_somebody_else_starts_is_not_restarted_here() -> None:
    fleet, state = fleet_of(task_of(candidates=EDGES)), durable("edge1")
    edge = Node(fleet=fleet, me="edge1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0)
    edge.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    batch = edge.handle(ev.RestartCommanded(request=7, command=RestartTask(task="merge")), 100.0)
    assert of(batch, do.RenewWorker) == []
    result = of(batch, do.AnswerCommand)[0].result
    assert result.outcome is CommandOutcome.INVALID
    assert result.detail.startswith("somebody else starts it")


def test_a_certificate_is_handed_on_whoever_has_sent_it() -> None:
    event = ev.CertificateSent(request=7, command=TakeCertificate(certificate=Text("pem")))
    assert of(make("edge1").handle(event, 100.0), do.TakeCertificate) == [
        do.TakeCertificate(request=7, certificate="pem")
    ]
    with pytest.raises(ValueError, match="at most 4096"):
        TakeCertificate(certificate=Text("x" * 4097))


def test_a_question_for_the_history_is_handed_on_and_names_a_place_in_a_log() -> None:
    batch = make("edge1").handle(ev.HistoryAsked(request=7, command=ReadHistory(cursor="4711:12")), 100.0)
    assert of(batch, do.AnswerHistory) == [do.AnswerHistory(request=7, cursor="4711:12")]
    for bad in ("4711", "a:1", f"1:{'9' * 16}", "1:2 "):
        with pytest.raises(ValueError, match=r"history\.cursor"):
            ReadHistory(cursor=bad)


def test_a_node_tells_by_which_fleet_value_it_goes() -> None:
    node = make("robot1")
    for with_document in (True, False):
        command = ReadFleet(with_document=with_document)
        (order,) = of(node.handle(ev.FleetReadAsked(request=7, command=command), 100.0), do.AnswerFleetRead)
        assert (order.request, order.with_document) == (7, with_document)
        assert (order.told.node, order.told.value) == ("robot1", node.agreement.fleet_value)
        assert (order.told.fleet_file, order.told.content) == (node.fleet_file, None)


@pytest.mark.parametrize("is_draining", [False, True])
def test_an_owner_that_drains_hurries_the_next_round(*, is_draining: bool) -> None:
    node = started(learnt=allocation_of(1, "edge1"))
    node.handle(ev.DeadlineReached(), node.rounds.next_deadline())  # the gather that ran is over
    now = node.rounds.next_deadline() - 0.1
    new = replace(profile("edge1", draining=is_draining).profile, sequence=5)
    asked = of(node.handle(ev.ProfileReceived(profile=new), now), do.AskUtilities)
    assert bool(asked) is is_draining


def test_a_profile_that_comes_late_hurries_no_decision_by_what_it_says() -> None:
    node = started(learnt=allocation_of(1, "edge1"))
    new = replace(profile("edge1").profile, sequence=5)
    node.handle(ev.ProfileReceived(profile=new), 100.0)
    now = node.rounds.next_deadline()
    node.handle(ev.DeadlineReached(), now)  # nobody answers: the gather that ran is over
    due = node.rounds.next_deadline()
    assert due > now + 0.001
    for sequence in (5, 4):
        late = replace(new, sequence=sequence, draining=True)
        assert not of(node.handle(ev.ProfileReceived(profile=late), now + 0.001), do.AskUtilities)
        assert node.rounds.next_deadline() == due


# --- the workers' word of their jobs -------------------------------------------------------------------------------


def word(done: int, **more: Any) -> ev.WorkerJobs:
    figures = {"time_s": 0.1 * done, "cpu_s": 0.05 * done, "wait_s": 0.0}
    return ev.WorkerJobs(task="merge", incarnation="7", at_s=float(done), done=done, **{**figures, **more})


def test_what_a_worker_here_says_of_its_jobs_is_in_the_next_profile_and_in_the_status() -> None:
    node = started("edge1")
    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    sample = replace(SAMPLE, workers=(load_of(cpu_cores=0.5, memory_mb=9.0),))
    published: list[do.PublishProfile] = []
    for number in range(1, 11):
        now = 100.0 + number
        for event in (word(5 * number), ev.ProfileSampled(device=sample)):
            published += of(node.handle(event, now), do.PublishProfile)
    jobs = published[-1].profile.workers[0].jobs
    assert jobs is not None
    assert jobs.time_s == pytest.approx(0.1)
    assert jobs.cpu_s == pytest.approx(0.05)
    assert node.counters["jobs_refused"] == 0
    (shown,) = (one for one in build_snapshot(node, 110.0).nodes if one.name == "edge1")
    assert shown.workers[0].jobs is not None


def test_work_that_a_worker_had_when_it_was_killed_is_no_hang_of_the_next_one() -> None:
    """Who follows says nothing before it has work; it was told to hang, and to start it anew changed nothing."""
    node = started("edge1")

    def unended_s(now: float) -> float | None:
        sample = replace(SAMPLE, workers=(load_of(cpu_cores=0.0, memory_mb=9.0),))
        (told,) = of(node.handle(ev.ProfileSampled(device=sample), now), do.PublishProfile)
        found: float | None = told.profile.workers[0].unended_s
        return found

    node.handle(ev.WorkerChanged(task="merge", state=WorkerState.READY), 100.0)
    node.handle(word(1, waiting=1), 100.0)
    assert unended_s(140.0) == pytest.approx(40.0)
    for state in (WorkerState.STARTING, WorkerState.READY):
        node.handle(ev.WorkerChanged(task="merge", state=state), 141.0)
    assert unended_s(200.0) is None
    node.handle(replace(word(1, waiting=1), incarnation="8"), 201.0)
    assert unended_s(240.0) == pytest.approx(39.0)


def test_a_worker_s_word_that_cannot_be_true_or_is_of_no_worker_here_only_counts() -> None:
    node = started("edge1")
    node.handle(word(50), 100.0)
    for number, lie in enumerate((word(10), word(60, cpu_s=1e9), replace(word(60), task="other")), 1):
        node.handle(lie, 101.0)
        assert node.counters["jobs_refused"] == number


def test_profiles_are_echoed_in_a_fleet_with_a_deadline_and_only_there() -> None:
    late = replace(FLEET.tasks[0], tuning=replace(TUNING, deadline_ms=100.0))
    for fleet, is_echoed in ((FLEET, False), (replace(FLEET, tasks=(late,)), True)):
        node = Node(
            fleet=fleet,
            me="robot1",
            durable=durable("robot1"),
            incarnation=7,
            electorate=ELECTORATE,
            rng=Random(1),
            now=100.0,
        )
        node.start(100.0)
        node.handle(ev.BeatReceived(beat=beat("edge1")), 100.0)
        (own,) = of(node.handle(ev.ProfileSampled(device=SAMPLE), 100.0), do.PublishProfile)
        echo = Echo(node="robot1", incarnation=7, sequence=own.profile.sequence, held_s=0.5)
        heard = profile("edge1").profile
        node.handle(ev.ProfileReceived(profile=replace(heard, echoes=(echo,))), 100.52)
        (own,) = of(node.handle(ev.ProfileSampled(device=SAMPLE), 101.02), do.PublishProfile)
        found = [(one.node, one.sequence, round(one.held_s, 3)) for one in own.profile.echoes]
        assert found == ([("edge1", heard.sequence, 0.5)] if is_echoed else [])
        assert own.is_news is is_echoed, "one that waited for the hearer's next deadline would tell of that, too"
        assert {name: round(far_s, 3) for name, far_s in node.round_trips.seconds().items()} == (
            {"edge1": 0.02} if is_echoed else {}
        )


def test_whether_a_task_may_become_exclusive_hangs_on_no_late_beat_of_a_peer_that_is_gone() -> None:
    node, now = started(learnt=allocation_of(1, "edge1")), 100.0
    node.handle(learnt_from("robot2", allocation_of(2, "robot3", 2)), now)
    while node.membership.state("robot2") is not PeerState.GONE:
        now = max(now, node.next_deadline())
        node.handle(ev.DeadlineReached(), now)
    others = {"edge1", "edge2", "robot2", "robot3"}
    assert (set(node.sealing._gone), node.sealing._owners) == (others, {"merge": {"edge1", "robot3"}})
    node.handle(ev.BeatReceived(beat=beat("robot2")), now)
    assert set(node.sealing._gone) == others
    node.handle(ev.BeatReceived(beat=beat("robot2", 2)), now)
    assert set(node.sealing._gone) == others - {"robot2"}


@pytest.mark.parametrize("is_known", [True, False])
def test_profiles_are_echoed_where_an_operator_has_set_a_deadline(*, is_known: bool) -> None:
    """The fleet file has none; the task had one before this node's start, or it gets one later."""
    late = allocation_of(2, "edge1", epoch=1, tuning=replace(TUNING, deadline_ms=100.0))
    node = started(learnt=late if is_known else None)
    if not is_known:
        node.handle(learnt_from("robot2", late), 100.1)
    assert node.values()["merge"].tuning.deadline_ms == 100.0
    (own,) = of(node.handle(ev.ProfileSampled(device=replace(SAMPLE, cpu_used_cores=3.0)), 101.2), do.PublishProfile)
    echo = Echo(node="robot1", incarnation=7, sequence=own.profile.sequence, held_s=0.1)
    node.handle(ev.ProfileReceived(profile=replace(profile("edge1").profile, echoes=(echo,))), 101.5)
    assert {name: round(far_s, 3) for name, far_s in node.round_trips.seconds().items()} == {"edge1": 0.2}
    (own,) = of(node.handle(ev.ProfileSampled(device=SAMPLE), 102.3), do.PublishProfile)
    assert [one.node for one in own.profile.echoes] == ["edge1"]


def test_a_drained_node_is_known_to_keep_nothing() -> None:
    node = started()
    assert node._doubts(FLEET.tasks[0], 100.0).left == frozenset()
    node.flags.drained = {"edge2": "drained by ada"}
    assert node._doubts(FLEET.tasks[0], 100.0).left == {"edge2"}


def test_so_is_an_owner_whose_worker_is_not_ready_in_time() -> None:
    node = started(learnt=allocation_of(1, "edge1"))
    (spec,) = FLEET.tasks
    node.rounds.tasks[spec.name].judge.absences.since = 100.0
    start_s = spec.worker.start_deadline_s
    assert node._doubts(spec, 100.0 + start_s).left == frozenset()
    assert node._doubts(spec, 100.1 + start_s).left == {"edge1"}


def test_links_that_begin_and_cease_to_hold_beats_up_are_in_the_story() -> None:
    """One peer's every third beat comes 0.7 s late for ten seconds, then all come in time."""
    node, now, sequence = started(), 100.0, 1
    told: list[str] = []
    while now < 140.0:
        sequence += 1
        due = now + (0.7 if sequence % 3 == 0 and now < 110.0 else 0.2)
        while node.next_deadline() <= due:
            now = max(now, node.next_deadline())
            told += [one.text for one in of(node.handle(ev.DeadlineReached(), now), do.RecordStory)]
        now = due
        for name in (*ROBOTS, *EDGES):
            number = sequence if name == "edge1" else round(now * 100)
            batch = node.handle(ev.BeatReceived(beat=beat(name, number)), now) if name != "robot1" else ()
            told += [one.text for one in of(batch, do.RecordStory)]
    assert [text for text in told if text.startswith("links")] == [
        "links lose packets and hold beats up: a peer is suspect after 1.68 s of silence",
        "links hold no beats up any more: a peer is suspect after 1.2 s of silence",
    ]
    assert node.counters["links_lossy"] == 1


@pytest.mark.parametrize("life", [4, 3], ids=["begins again", "beats again after silence"])
def test_a_peer_that_comes_hears_of_this_machine_soon(life: int) -> None:
    node, now, sent = started("edge2"), 100.0, [100.0]
    while now < 101.6:
        now = node.next_deadline()
        sent += [now for _ in of(node.handle(ev.DeadlineReached(), now), do.PublishProfile)]
        node.handle(ev.ProfileSampled(device=SAMPLE), now)
    came = max(sent) + 0.05
    node.handle(ev.BeatReceived(beat=beat("edge1", 2, incarnation=life)), came)
    soon = [came + 0.1 * step for step in range(1, 4)]
    assert [at for at in soon for _ in of(node.handle(ev.DeadlineReached(), at), do.PublishProfile)]


def test_a_gap_at_a_move_is_in_the_story_of_its_task_once() -> None:
    node = make("robot1", learnt=allocation_of(2, "edge1", 2))
    node.start(100.0)
    gap = StreamCount(stream="merge/out/0", move_gap_s=0.25, move_epoch=2)
    foreign = replace(gap, stream="gone/out/0")
    batches = [node.handle(ev.StreamsCounted(counts=(gap, foreign)), now) for now in (101.0, 102.0)]
    told = [one for batch in batches for one in of(batch, do.RecordStory) if one.gap_s is not None]
    assert [(one.stage, one.task, one.epoch, one.gap_s) for one in told] == [("route", "merge", 2, 0.25)]
    assert told[0].text.startswith("merge/out/0: 250 ms")


def test_a_document_that_was_not_valid_beside_this_machines_file_is_tried_again_when_that_has_changed() -> None:
    """It was refused until the daemon's next start, though the operator had done what the problem said."""
    node = started()
    refused = node.agreement._numbers.documents.refused
    refused["0d"] = Problem.DOCUMENT, "it has no section `security:`, and the file here has one"
    node.handle(ev.FleetChanged(fleet=FLEET), 101.0)
    assert refused == {}


@pytest.mark.parametrize(("epoch", "waits"), [(1, False), (2, True)])
def test_streams_wait_for_a_new_owner_from_its_own_lack_on(epoch: int, *, waits: bool) -> None:
    """What a relay misses of a slot that has been left is no word about the newest."""
    node = started(learnt=allocation_of(1, "edge1"))
    node.handle(learnt_from("robot2", allocation_of(2, "edge2", 2)), 101.0)
    for event in (ev.SlotReady(task="merge", epoch=2), ev.SlotFlipped(task="merge", epoch=2)):
        node.handle(event, 102.0)
    node.handle(ev.SlotReady(task="merge", epoch=epoch, is_ready=False), 103.0)
    told = [one for one in build_snapshot(node, 113.0).tasks[0].problems if "streams have waited" in one]
    assert [one.partition(": ")[0] for one in told] == ["this robot's streams have waited for edge2 for 10 s"] * waits


@pytest.mark.parametrize(("voter", "late"), [("robot2", 1), ("edge1", 0)])
def test_utilities_of_who_has_no_vote_are_nothing_that_comes_late(voter: str, late: int) -> None:
    """Edges hear the question, too."""
    node = started()
    node.handle(ev.UtilityReceived(gather=77, utilities=Utilities(voter=voter, vectors=())), 100.0)
    assert node.counters["utility_late"] == late


def test_an_owner_that_has_ceased_to_answer_is_one_that_this_robot_does_not_reach() -> None:
    """Inputs flow, and answers have ended."""
    node = started(learnt=allocation_of(1, "edge1"))
    for event in (ev.SlotReady(task="merge", epoch=1), ev.SlotFlipped(task="merge", epoch=1)):
        node.handle(event, 100.5)
    told = []
    for second in range(12):
        at, taken, given = 101.0 + second, 10 * second, min(10 * second, 60)
        count = StreamCount(stream="merge/in/0", messages=taken, acknowledged=given, in_flight=taken - given)
        for tenth in range(9):  # a node that stood still begins again
            node.handle(ev.DeadlineReached(), at - 0.9 + tenth / 10)
        node.handle(ev.StreamsCounted(counts=(count,)), at)
        problems = build_snapshot(node, at).tasks[0].problems
        is_shown = any("edge1 has had inputs of this robot and answered none" in one for one in problems)
        assert is_shown is any("`zsched tune merge reach=all`" in one for one in problems)
        told.append((is_shown, "edge1" in node._doubts(FLEET.tasks[0], at).unseen))
    assert told == [(second >= 10, second >= 10) for second in range(12)]
    node.handle(ev.SlotReady(task="merge", epoch=1, is_ready=False), 112.0)
    assert node.unanswered_s("merge", 112.5) is not None
    assert node.unanswered_s("merge", 114.5) is None, "that its worker is missed is told by itself"
