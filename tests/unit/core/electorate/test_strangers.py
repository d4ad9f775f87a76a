"""Nodes of another generation: nothing of theirs counts, and both sides show the other one."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support import states
from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from support.todos import agreed
from zsched.core.electorate.changes import AdoptDocument
from zsched.core.electorate.founding import founded, recovered
from zsched.core.electorate.recovery import MOVED, Found, Recovery, consider, rejoined, sides_of
from zsched.core.electorate.strangers import KEPT, SHOWN_S, Strangers
from zsched.core.membership.knocking import SHOWN_AFTER_S
from zsched.core.node.node import Node
from zsched.core.node.status import build_snapshot
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat, Grant
from zsched.core.values.durable import DurableState
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Accept, Learnt, Prepare
from zsched.core.values.model import Acceptance, Allocation, Ballot, PeerState, Proposal, RegisterState
from zsched.core.values.todo import ToDo
from zsched.core.vote.agreement import Agreement

NAMES = ("edge1", "robot1", "robot2", "robot3")
ROBOTS = NAMES[1:]
TASK = task_of(candidates=NAMES, exclusive=True)
FLEET = fleet_of(TASK, of=NAMES, electors=ROBOTS)
FIRST = founded(FLEET.name, 0, ROBOTS)
AGREED = replace(
    AdoptDocument(base_revision=1, document="0d", tasks=(("merge", True),), lease_s=1.0).apply(FIRST), settled=True
)
LEFT = recovered(AGREED, "robot1", disk="d1", generation_id="aa" * 16, states=())[0]
RIGHT = recovered(AGREED, "robot3", disk="d3", generation_id="bb" * 16, states=())[0]
ALLOCATION = allocation_of(LEFT.tasks[0].start + 3, "robot3", leased=True)


def state_of(me: str, value: FleetValue | None) -> DurableState:
    held = None if value is None else RegisterState(task=FLEET.name, learnt=value)
    return states.state_of(me, hardware="h", disk=f"d{me[-1]}", fleet_register=held)


def node(
    value: FleetValue | None = LEFT,
    me: str = "robot1",
    state: DurableState | None = None,
    *,
    stored: dict[str, Fleet] | None = None,
) -> Node:
    return Node(
        fleet=FLEET,
        me=me,
        durable=state or state_of(me, value),
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
        stored={"0d": FLEET} if stored is None else stored,
    )


def agreement(value: FleetValue | None = LEFT, me: str = "robot1", state: DurableState | None = None) -> Agreement:
    return node(value, me, state).agreement


def beat(value: FleetValue | None, sender: str = "robot3", sequence: int = 1) -> Beat:
    """What a node that counts by a value beats; ``None``: by its file."""
    return beat_of(
        sender,
        sequence,
        lease_terms="0123456789abcdef" if value is None else value.terms,
        number=0 if value is None else value.number,
        fleet_revision=0 if value is None else value.revision,
    )


def told(value: FleetValue | None, *values: Allocation, sender: str = "robot3") -> ev.LearntReceived:
    learnt = Learnt(node=sender, values=values, fleet=value, incarnation=1, seen=(("robot1", 99, 99),))
    return ev.LearntReceived(learnt=learnt, is_answer=True)


@pytest.mark.parametrize(
    ("ours", "theirs", "is_stranger"),
    [
        (LEFT, RIGHT, True),
        (LEFT, AGREED, True),
        (AGREED, RIGHT, True),
        (LEFT, None, True),
        (None, RIGHT, True),
        (LEFT, LEFT, False),
        (AGREED, None, False),
        (None, AGREED, False),
        (None, None, False),
    ],
)
def test_a_beat_names_its_generation(*, ours: FleetValue | None, theirs: FleetValue | None, is_stranger: bool) -> None:
    assert agreement(ours).is_stranger(beat(theirs), ToDo(), 100.0) is is_stranger


def test_a_stranger_is_shown_with_whom_it_follows_and_what_brings_it_over() -> None:
    one = agreement()
    todo = ToDo()
    assert one.is_stranger(beat(RIGHT), todo, 100.0)
    assert [ask.peer for ask in todo.send if isinstance(ask, do.AskLearnt)] == ["robot3"]
    agreed(one.on_learnt, told(RIGHT), 100.1)
    todo = ToDo()
    assert one.is_stranger(beat(RIGHT, sequence=2), todo, 110.0)
    assert not todo.send, "it is known by whom"
    shown = one.problems["generation", "robot3"]
    assert "robot3 counts by another generation of this fleet, bbbbbbbb (recovered by robot3)" in shown
    assert "this node by aaaaaaaa (recovered by robot1)" in shown
    assert "`zsched fleet recover --rejoin aaaaaaaa` there" in shown
    assert "`zsched fleet recover --rejoin bbbbbbbb` here" in shown
    assert not one.is_stranger(beat(LEFT, sequence=3), ToDo(), 110.1)
    assert ("generation", "robot3") not in one.problems


def test_a_stranger_that_is_not_heard_any_more_is_not_shown() -> None:
    one = agreement()
    one.is_stranger(beat(RIGHT), ToDo(), 100.0)
    one.forget(100.0 + SHOWN_S)
    assert ("generation", "robot3") not in one.problems


@pytest.mark.parametrize(("theirs", "subject"), [(RIGHT, "generation/robot9"), (LEFT, "fleet/robot9")])
def test_a_stranger_that_the_document_does_not_name_is_shown_as_one_too(theirs: FleetValue, subject: str) -> None:
    """A half goes by the document that it knew. `zsched leave` on such a node would change that half, not ours."""
    one = node()
    for number in (1, 2):
        one.handle(ev.BeatReceived(beat=beat(theirs, "robot9", number)), 100.0 + SHOWN_AFTER_S * number)
    told = [text for text in build_snapshot(one, 110.0).problems if "robot9" in text]
    assert [text.partition(":")[0] for text in told] == [subject]
    assert ("To bring robot9 over: `zsched node add` here" in told[0]) is (theirs is RIGHT)
    assert ("`zsched leave`" in told[0]) is (theirs is LEFT)


def test_what_a_stranger_has_learnt_is_not_learnt_and_its_memory_counts_for_nothing() -> None:
    one = agreement()
    known = one.registers["merge"].value
    agreed(one.on_learnt, told(RIGHT, ALLOCATION), 100.1)
    assert one.registers["merge"].value == known
    assert one.fleet_value == LEFT
    assert (one.is_elector, one.witness.seen) == (True, {}), "the life that it remembers was in another generation"
    assert one.counters["learnt_stranger"] == 1
    agreed(one.on_learnt, told(None, ALLOCATION), 100.2)
    assert one.registers["merge"].value == known


def test_an_answer_of_its_own_generation_is_learnt() -> None:
    one = agreement(replace(LEFT, electors=(*LEFT.electors, RIGHT.electors[0])))
    agreed(one.on_learnt, told(one.fleet_value, ALLOCATION), 100.1)
    assert one.registers["merge"].value == ALLOCATION


def test_a_question_of_another_generation_gets_no_answer() -> None:
    one = agreement()
    question = Prepare(
        task="merge",
        ballot=Ballot(counter=5, incarnation=1, node="robot3"),
        electorate="e",
        creation=LEFT.tasks[0].number,
        generation_id=RIGHT.generation_id,
        number=RIGHT.number,
    )
    event = ev.PrepareAsked(request=1, asker="robot3", prepare=question)
    assert not [one for one in agreed(one.acceptor.on_prepare, event, 100.1).send if isinstance(one, do.AnswerElection)]
    assert one.counters["prepare_stranger"] == 1
    accept = Accept(
        task="merge",
        acceptance=Acceptance(ballot=question.ballot, value=ALLOCATION),
        electorate="e",
        creation=question.creation,
        generation_id=question.generation_id,
        number=question.number,
    )
    accepted = ev.AcceptAsked(request=1, asker="robot3", accept=accept)
    assert agreed(one.acceptor.on_accept, accepted, 100.1) == ToDo()
    assert one.counters["accept_stranger"] == 1
    ours = replace(question, generation_id=LEFT.generation_id)
    for name in ROBOTS[1:]:
        one.witness.on_answer(Learnt(node=name, values=()))
    event = ev.PrepareAsked(request=2, asker="robot3", prepare=ours)
    assert [one for one in agreed(one.acceptor.on_prepare, event, 101.0).send if isinstance(one, do.AnswerElection)]
    assert one.counters["prepare_stranger"] == 1


def test_a_stranger_is_no_peer_and_its_other_frames_do_not_count() -> None:
    one = node()
    one.handle(ev.BeatReceived(beat=beat(RIGHT)), 100.1)
    assert one.membership.state("robot3") is not PeerState.ALIVE
    assert one.counters["beat_stranger"] == 1
    proposal = Proposal(
        voter="robot3",
        task="merge",
        base_revision=one.registers["merge"].value.revision,
        candidate="edge1",
        aggregate=0.5,
        reason="test",
    )
    one.handle(ev.ProposalReceived(proposal=proposal), 100.2)
    assert one.counters["proposal_stranger"] == 1
    one.handle(ev.BeatReceived(beat=beat(LEFT, sequence=2)), 100.3)
    assert one.membership.state("robot3") is PeerState.ALIVE
    one.handle(ev.ProposalReceived(proposal=proposal), 100.4)
    assert one.counters["proposal_stranger"] == 1


def test_one_forged_beat_makes_no_stranger_of_a_peer() -> None:
    one = Strangers(in_force=InForce(replace(FLEET, timing=replace(FLEET.timing, suspect_s=1.2))))
    assert not one.hear(beat(LEFT), LEFT.generation_id, is_named=True, now=100.0)
    assert one.hear(beat(RIGHT), LEFT.generation_id, is_named=True, now=100.1)
    assert not one.is_one("robot3", 100.2)
    assert one.is_one("robot3", 101.3)


def test_forged_generations_do_not_fill_the_memory() -> None:
    """Of those that come when it is full nothing is remembered: they are asked about again."""
    one = Strangers(in_force=InForce(replace(FLEET, timing=replace(FLEET.timing, suspect_s=1.2))))
    for number in range(KEPT + 1):
        value = replace(RIGHT, generation_id=f"{number:032x}"[::-1])
        assert one.on_learnt(Learnt(node="robot3", values=(), fleet=value), LEFT, is_named=True)
        one.hear(beat(value), LEFT.generation_id, is_named=True, now=100.0)
        assert one.must_ask("robot3", 100.0 + number) is (number == KEPT)


def granted(one: Agreement, value: FleetValue, now: float) -> tuple[Grant, ...]:
    """What an elector echoes after a beat of the task's owner that counts by a fleet value."""
    owner, epoch = "robot3", ALLOCATION.epoch
    sent = replace(beat(value), learnt=(("merge", ALLOCATION.revision, epoch),))
    one.leases.on_beat(sent, {"merge": (owner, epoch)}, now)
    return one.leases.on_sent(1, now).echoes


def test_a_grant_needs_the_same_generation_as_well_as_the_same_number() -> None:
    assert LEFT.number == RIGHT.number
    one, later = agreement(), 200.0  # what was granted before its start is over
    assert granted(one, RIGHT, later) == ()
    assert [grant.owner for grant in granted(one, LEFT, later)] == ["robot3"]


def test_without_its_document_a_robot_counts_the_electors_that_are_agreed() -> None:
    one = node(stored={})
    one.start(100.0)
    assert one.in_force.electors == LEFT.electorate.names != one.fleet.electors


def test_recover_at_once_grants_nothing_while_a_lease_of_before_may_last() -> None:
    """The leases of the generation before were longer than those of this one."""
    own = replace(state_of("robot1", AGREED), lease_s=7.0)
    it = Found(fleet=FLEET, me="robot1", own=own, others=(), answers=(), documents={"0d": FLEET}, file_hash="0f")
    plan = consider(it)
    assert isinstance(plan, Recovery)
    state = plan.carry_out(generation_id="aa" * 16, disk="d1", incarnation=8, hardware="h")
    one = agreement(state=state)
    assert granted(one, LEFT, 100.0 + 6.9) == ()
    assert [grant.owner for grant in granted(one, LEFT, 100.0 + 7.1)] == ["robot3"]


# --- changing sides --------------------------------------------------------------------------------------------------


def joining(me: str) -> DurableState:
    (side,) = sides_of([build_snapshot(node(LEFT), 100.0)])
    return rejoined(FLEET, me, state_of(me, RIGHT), side, disk="99", incarnation=8, hardware="h")


def test_who_is_to_join_takes_the_first_word_of_that_generation_only() -> None:
    state = joining("robot3")
    assert state.joins == LEFT.generation_id
    one = agreement(None, "robot3", state)
    assert (one.is_elector, one.number, one.disk) == (False, 0, "")
    assert MOVED in one.problems["state", ""]
    assert one.is_stranger(beat(RIGHT, "robot2"), ToDo(), 100.0)
    agreed(one.on_learnt, told(RIGHT, ALLOCATION, sender="robot2"), 100.1)
    assert one.number == 0
    todo = ToDo()
    assert not one.is_stranger(beat(LEFT, "robot1"), todo, 100.2)
    one.compare(beat(LEFT, "robot1"), todo, 100.2)
    assert [ask.peer for ask in todo.send if isinstance(ask, do.AskLearnt)] == ["robot1"]
    agreed(one.on_learnt, told(LEFT, sender="robot1"), 100.3)
    assert (one.fleet_value, one.disk, one.is_elector) == (LEFT, "99", False)
    assert ("state", "") not in one.problems
    kept = one.to_persist(100.4)
    assert kept is not None
    assert agreement(None, "robot3", kept).fleet_value == LEFT


def test_its_beats_tell_which_generation_it_is_to_join() -> None:
    one = node(None, "robot3", joining("robot3"))
    (sent,) = [out.beat for out in one.start(100.0) if isinstance(out, do.PublishBeat)][:1]
    assert not agreement(LEFT).is_stranger(sent, ToDo(), 100.0)
    assert agreement(RIGHT, "robot2").is_stranger(sent, ToDo(), 100.0)
    assert agreement(None, "robot2").is_stranger(sent, ToDo(), 100.0)


def test_two_that_wait_elect_nothing_among_themselves() -> None:
    """Their file names them as electors; under the id that they are to join they have no seats."""
    one, other = agreement(None, "robot3", joining("robot3")), agreement(None, "robot2", joining("robot2"))
    for waiting in (one, other):
        for name in NAMES:
            waiting.witness.on_answer(Learnt(node=name, values=()))
    question = Prepare(
        task="merge",
        ballot=Ballot(counter=5, incarnation=1, node="robot2"),
        electorate=one.electorate,
        generation_id=LEFT.generation_id,
        number=1,
    )
    todo = agreed(one.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=question), 101.0)
    (answer,) = [out.answer for out in todo.send if isinstance(out, do.AnswerElection)]
    assert answer.refusal == "not_elector"  # type: ignore[union-attr]
