"""Numbers in a node's agreement: founded from its file, learnt from peers, told in questions, beats and the state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from random import Random
from types import MappingProxyType
from typing import Any, TypeVar

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from support.states import state_of
from support.todos import agreed, under
from zsched.core.electorate.changes import AddElector, AdoptDocument, RemoveElector, SetDocument, SetLease
from zsched.core.electorate.founding import founded
from zsched.core.register.register import MAX_REVISION
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat, Grant
from zsched.core.values.change import MoveOwner
from zsched.core.values.codec import decode_state, encode_state
from zsched.core.values.electorate import Creation, FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import hold_s
from zsched.core.values.messages import (
    Accept,
    Accepted,
    FleetAnswer,
    FleetQuestion,
    Learnt,
    Prepare,
    Promise,
    Refusal,
    Refused,
    fleet_answer,
)
from zsched.core.values.model import NO_BALLOT, Acceptance, Ballot, RegisterState
from zsched.core.values.todo import ToDo
from zsched.core.values.words import CREATION_STEP
from zsched.core.vote.agreement import Agreement
from zsched.core.vote.belief import GENERATION_STEP, MAX_AHEAD
from zsched.core.vote.lease import Leases
from zsched.core.vote.questions import ASK_LEARNT_EVERY_S

T = TypeVar("T")
NAMES = ("edge1", "robot1", "robot2", "robot3")
ROBOTS = NAMES[1:]
TASK = task_of(candidates=NAMES, exclusive=True)
FLEET = fleet_of(TASK, of=NAMES, electors=ROBOTS)
GENERATION = 2
FIRST = founded(FLEET.name, GENERATION, ROBOTS)
ADOPTED = AdoptDocument(base_revision=1, document="0d", tasks=(("merge", True),), lease_s=1.0).apply(FIRST)
NEXT = replace(FIRST, revision=2)
WITH_EDGE = AddElector(base_revision=2, name="edge1", disk="ed").apply(replace(ADOPTED, settled=True))
WITHOUT_ROBOT1 = RemoveElector(base_revision=2, name="robot1").apply(replace(ADOPTED, settled=True))


def make(
    fleet_value: FleetValue | None = None,
    *,
    me: str = "robot1",
    has_state: bool = True,
    registers: tuple[RegisterState, ...] = (),
    stored: Mapping[str, Fleet] = MappingProxyType({"0d": FLEET}),
    seed: int = 1,
    lost: str = "",
    disputed: str = "",
) -> Agreement:
    held = None if fleet_value is None else RegisterState(task=FLEET.name, learnt=fleet_value)
    state = state_of(
        me,
        *registers,
        generation=GENERATION,
        hardware="h",
        disk="d1",
        fleet_register=held,
        lost=lost,
        disputed=disputed,
    )
    agreement = Agreement(
        in_force=InForce(FLEET),
        me=me,
        durable=state if has_state else None,
        incarnation=7,
        electorate="e",
        rng=Random(seed),
        now=100.0,
        stored=stored,
    )
    for name in NAMES:
        if name != me:
            agreement.witness.on_answer(Learnt(node=name, values=()))
    return agreement


def of(todo: ToDo, kind: type[T]) -> list[T]:
    return [one for one in (*todo.send, *todo.apply) if isinstance(one, kind)]


def proposed(agreement: Agreement) -> Prepare:
    value = agreement.registers["merge"].value
    change = MoveOwner(base_revision=value.revision, owner="edge1", reason="test")
    todo = agreed(agreement.propose, "merge", change, 100.0)
    return of(todo, do.SendPrepare)[0].prepare


def asked(agreement: Agreement, prepare: Prepare, asker: str = "robot2") -> tuple[ToDo, Promise | Accepted | Refused]:
    ballot = replace(prepare.ballot, node=asker, counter=prepare.ballot.counter + 10)
    event = ev.PrepareAsked(request=1, asker=asker, prepare=replace(prepare, ballot=ballot))
    todo = agreed(agreement.acceptor.on_prepare, event, 100.1)
    return todo, of(todo, do.AnswerElection)[0].answer


# --- founded ---------------------------------------------------------------------------------------------------------


def test_every_prepare_and_accept_names_generation_number_and_creation() -> None:
    agreement = make()
    prepare = proposed(agreement)
    assert (prepare.generation_id, prepare.number, prepare.creation) == (FIRST.generation_id, 1, GENERATION)
    todo = ToDo()
    for name in ROBOTS[:2]:
        promise = Promise(elector=name, task="merge", ballot=prepare.ballot)
        agreement.on_answer(ev.ElectorAnswered(answer=promise), todo, 100.1)
    (accept,) = [one.accept for one in of(todo, do.SendAccept)]
    assert (accept.generation_id, accept.number, accept.creation) == (FIRST.generation_id, 1, GENERATION)


def test_founding_needs_no_message_and_nothing_of_it_goes_to_disk_or_into_beats() -> None:
    agreement, other = make(), make(me="robot2")
    assert proposed(agreement).generation_id == proposed(other).generation_id
    state = agreement.to_persist(100.0)
    assert state is not None
    assert (state.fleet_register, state.disk) == (None, "d1")
    assert (agreement.number, agreement.fleet_revision, agreement.learnt().fleet) == (0, 0, None)


@pytest.mark.parametrize("is_told", [True, False])
def test_a_question_without_a_number_is_answered_while_nothing_has_changed(*, is_told: bool) -> None:
    agreement = make()
    prepare = proposed(agreement)
    by_file = replace(prepare, generation_id="", number=0, creation=0)
    assert isinstance(asked(agreement, prepare if is_told else by_file)[1], Promise)


@pytest.mark.parametrize(
    "change", [AddElector(base_revision=1, name="edge1", disk="1"), RemoveElector(base_revision=1, name="robot1")]
)
def test_a_fleet_that_goes_by_its_files_agrees_a_document_first(change: AddElector | RemoveElector) -> None:
    assert change.fault(FIRST) == "no document is agreed yet"
    assert SetLease(base_revision=1, lease_s=2.0).fault(FIRST) == "no document is agreed yet"
    assert SetDocument(base_revision=1, document="0d", tasks=()).apply(FIRST) == FIRST


def test_the_first_document_keeps_the_registers_and_raises_the_number() -> None:
    assert (ADOPTED.number, ADOPTED.settled, ADOPTED.lease_s, ADOPTED.guard_lease_s) == (2, False, 1.0, 1.0)
    assert [(one.task, one.number, one.exclusive) for one in ADOPTED.tasks] == [("merge", GENERATION, True)]
    again = AdoptDocument(base_revision=2, document="0e", tasks=(), lease_s=1.0)
    assert again.fault(ADOPTED) == "a document is agreed already"
    assert again.apply(ADOPTED) == ADOPTED
    before = make()
    start = GENERATION * GENERATION_STEP
    learnt = allocation_of(start + 3, epoch=start + 2)
    before.registers["merge"].learn(learnt, ToDo(), 100.0)
    register = before.registers["merge"]
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=ADOPTED)
    agreed(before.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert before.registers["merge"] is register
    assert register.value == learnt


# --- forged ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("change", [{"fleet": "other"}, {"revision": MAX_REVISION + 1}, {"number": MAX_REVISION + 1}])
def test_promises_of_a_fleet_value_that_cannot_be_are_counted_and_complete_no_majority(change: dict[str, Any]) -> None:
    """A question about such a value, or the next one after it, cannot even be made."""
    agreement = make(replace(ADOPTED, settled=True))
    todo = ToDo()
    assert agreement.change_fleet(AddElector(base_revision=2, name="edge1", disk="ed"), todo, 100.0) == ""
    (ask,) = of(todo, do.AskElectors)
    assert isinstance(ask.question, Prepare)
    held = Acceptance(ballot=ballot_of(1, "robot3"), value=replace(WITH_EDGE, **change))
    for name in ROBOTS[:2]:
        promise = Promise(elector=name, task=FLEET.name, ballot=ask.question.ballot, accepted=held)
        forged = ev.FleetAnswered(answer=fleet_answer(promise))
        assert agreed(agreement.on_fleet_answer, forged, 100.1) == ToDo()
    assert agreement.counters == {"answer_unfit": 2}


def test_a_fleet_value_of_another_name_is_not_accepted() -> None:
    """What an elector has accepted every later round would have to ask about, and could not."""
    agreement = make()
    accept = Accept(
        task="merge",
        acceptance=Acceptance(ballot=ballot_of(9, "robot2"), value=replace(FIRST, fleet="merge", revision=2)),
        electorate=agreement.electorate,
        generation_id=FIRST.generation_id,
        number=1,
    )
    answers = []
    for forged in (accept, replace(accept, task=FLEET.name, acceptance=replace(accept.acceptance, value=NEXT))):
        event = ev.FleetAsked(request=1, asker="robot2", question=FleetQuestion(accept=forged))
        answers.append(of(agreed(agreement.acceptor.on_fleet_asked, event, 100.1), do.AnswerFleet))
    assert answers[0] == []
    assert isinstance(answers[1][0].answer.content, Accepted), "all else about it was right"


AHEAD: list[dict[str, Any]] = [{"revision": 2 + MAX_AHEAD + 1}, {"number": 2 + MAX_AHEAD + 1}]


@pytest.mark.parametrize("ahead", AHEAD)
def test_a_fleet_value_that_is_absurdly_far_ahead_is_neither_learnt_nor_accepted(ahead: dict[str, Any]) -> None:
    """One such answer would make every true value too old, on disk."""
    value = replace(ADOPTED, settled=True)
    agreement = make(value)
    far = replace(WITH_EDGE, **ahead)
    told = Learnt(node="edge1", values=(), generation=GENERATION, fleet=far)
    assert not agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1).must_persist
    ballot = ballot_of(9, "robot2")
    for task in ("merge", FLEET.name):
        refused = Refused(
            elector="robot2",
            task=task,
            ballot=ballot,
            refusal=Refusal.NUMBER,
            promised=NO_BALLOT,
            number=far.number,
            fleet=far,
        )
        agreed(agreement.on_answer, ev.ElectorAnswered(answer=refused), 100.2)
        agreed(agreement.on_fleet_answer, ev.FleetAnswered(answer=fleet_answer(refused)), 100.2)
    accept = Accept(
        task=FLEET.name,
        acceptance=Acceptance(ballot=ballot, value=far),
        electorate=agreement.electorate,
        generation_id=value.generation_id,
        number=value.number,
    )
    asked_for = ev.FleetAsked(request=1, asker="robot2", question=FleetQuestion(accept=accept))
    (said,) = of(agreed(agreement.acceptor.on_fleet_asked, asked_for, 100.3), do.AnswerFleet)
    assert isinstance(said.answer.content, Refused)
    assert said.answer.content.refusal is Refusal.VALUE
    assert agreement.fleet_value == value
    assert agreement.counters == {"learnt_unfit": 1, "answer_unfit": 4, "accept_unfit": 1}
    true = Learnt(node="robot2", values=(), generation=GENERATION, fleet=WITH_EDGE)
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=true, is_answer=True), 100.4)
    assert agreement.fleet_value == WITH_EDGE


# --- learnt ----------------------------------------------------------------------------------------------------------


def test_a_lower_number_is_refused_and_told_a_higher_one_is_asked() -> None:
    prepare = proposed(make())
    todo, answer = asked(make(WITH_EDGE), prepare)
    assert isinstance(answer, Refused)
    assert (answer.refusal, answer.number, answer.fleet) == (Refusal.NUMBER, 3, WITH_EDGE)
    assert answer.promised == NO_BALLOT
    todo, answer = asked(make(), proposed(make(WITH_EDGE)))
    assert isinstance(answer, Refused)
    assert (answer.refusal, answer.number, answer.fleet) == (Refusal.NUMBER, 1, None)
    assert [one.peer for one in of(todo, do.AskLearnt)] == ["robot2"]


def test_an_accept_that_waits_for_a_lease_is_refused_when_its_task_leaves_the_fleet() -> None:
    held = RegisterState(task="merge", creation=GENERATION, learnt=HELD)
    value, bare = replace(ADOPTED, settled=True), fleet_of(of=NAMES, electors=ROBOTS, tasks=())
    agreement = make(value, registers=(held,), stored={"0d": FLEET, "0e": bare})
    ballot = Ballot(counter=9, node="robot3", incarnation=3, disk="d3")
    accept = Accept(
        task="merge",
        acceptance=Acceptance(ballot=ballot, value=replace(HELD, revision=8, epoch=4, owner="robot3")),
        electorate="e",
        creation=GENERATION,
        generation_id=value.generation_id,
        number=value.number,
    )
    event = ev.AcceptAsked(request=4, asker="robot3", accept=accept)
    assert of(agreed(agreement.acceptor.on_accept, event, 100.1), do.AnswerElection) == []
    after = SetDocument(base_revision=value.revision, document="0e", tasks=()).apply(value)
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=after)
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.2)
    (answer,) = of(todo, do.AnswerElection)
    assert isinstance(answer.answer, Refused)
    assert (answer.request, answer.answer.refusal, answer.answer.ballot) == (4, Refusal.NUMBER, ballot)
    assert not agreement.acceptor.has_parked


def test_an_accept_under_a_lower_number_is_refused_too() -> None:
    agreement = make(WITH_EDGE)
    prepare = proposed(make())
    value = replace(agreement.registers["merge"].value, revision=GENERATION * GENERATION_STEP + 1, owner="edge1")
    accept = Accept(
        task="merge",
        acceptance=Acceptance(ballot=replace(prepare.ballot, node="robot2"), value=value),
        electorate=prepare.electorate,
        creation=prepare.creation,
        generation_id=prepare.generation_id,
        number=1,
    )
    todo = agreed(agreement.acceptor.on_accept, ev.AcceptAsked(request=3, asker="robot2", accept=accept), 100.1)
    (answer,) = [one.answer for one in of(todo, do.AnswerElection)]
    assert isinstance(answer, Refused)
    assert (answer.refusal, answer.fleet) == (Refusal.NUMBER, WITH_EDGE)


def test_a_question_without_a_number_is_refused_once_something_has_changed() -> None:
    by_file = replace(proposed(make()), generation_id="", number=0, creation=0)
    assert not isinstance(asked(make(WITH_EDGE), by_file)[1], Promise)


def test_a_refusal_brings_the_newer_number_and_the_round_goes_on_under_it() -> None:
    agreement = make()
    ballot = proposed(agreement).ballot
    refused = Refused(
        elector="robot2",
        task="merge",
        ballot=ballot,
        refusal=Refusal.NUMBER,
        promised=NO_BALLOT,
        number=3,
        fleet=WITH_EDGE,
    )
    todo = agreed(agreement.on_answer, ev.ElectorAnswered(answer=refused), 100.1)
    assert (agreement.number, agreement.electors) == (3, NAMES)
    assert todo.must_persist
    todo = agreed(agreement.tick, 100.2)
    (prepare,) = [one.prepare for one in of(todo, do.SendPrepare)]
    assert (prepare.number, prepare.ballot.disk) == (3, "d1")
    state = agreement.to_persist(100.2)
    assert state is not None
    assert state.fleet_register is not None
    assert state.fleet_register.learnt == WITH_EDGE
    assert decode_state(encode_state(state)) == state
    assert make(state.fleet_register.learnt).number == 3


def test_a_peer_s_beat_with_a_newer_fleet_value_leads_to_a_question_and_its_answer_is_followed() -> None:
    agreement = make()
    beat = beat_of("robot2", generation=GENERATION, number=3, fleet_revision=WITHOUT_ROBOT1.revision)
    todo = ToDo()
    agreement.compare(beat, todo, 100.1)
    assert [one.peer for one in of(todo, do.AskLearnt)] == ["robot2"]
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=WITHOUT_ROBOT1)
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.2)
    assert (agreement.number, agreement.fleet_revision, agreement.is_elector) == (3, 3, False)
    assert agreement.learnt().fleet == WITHOUT_ROBOT1
    assert agreement.witness.electors == ("robot2", "robot3")
    _, answer = asked(agreement, proposed(make(WITHOUT_ROBOT1, me="robot2")))
    assert isinstance(answer, Refused)
    assert answer.refusal is Refusal.NOT_ELECTOR


def test_a_fleet_value_counts_once_its_document_is_on_disk() -> None:
    agreement = make(stored={})
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=WITHOUT_ROBOT1)
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert (agreement.number, agreement.witness.electors) == (0, ROBOTS), "it waits for the document"
    agreement.on_stored(ev.DocumentStored(document="0d", fleet=FLEET), ToDo(), 100.2)
    assert (agreement.number, agreement.is_elector) == (3, False)
    assert agreement.witness.electors == ("robot2", "robot3"), "and what counts by it does so, too"
    assert not agreement.acceptor.is_elector


def test_the_document_of_a_value_that_is_no_newer_than_the_learnt_one_is_not_fetched() -> None:
    agreement = make(WITH_EDGE)
    for value in (ADOPTED, WITH_EDGE):
        older = Learnt(node="robot2", values=(), generation=GENERATION, fleet=replace(value, document="0c"))
        todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=older, is_answer=True), 100.1)
        assert of(todo, do.FetchDocument) == []
    newer = replace(older, fleet=replace(WITHOUT_ROBOT1, revision=WITH_EDGE.revision + 1, document="0c"))
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=newer, is_answer=True), 100.2)
    assert [one.document for one in of(todo, do.FetchDocument)] == ["0c"]


@pytest.mark.parametrize("value", [None, WITH_EDGE])
def test_everybody_is_told_the_same_value_again_after_a_while_only(value: FleetValue | None) -> None:
    agreement = make(value)
    assert agreement.word(100.0) == agreement.learnt()
    assert agreement.word(100.0 + 0.9 * ASK_LEARNT_EVERY_S) is None
    assert agreement.word(100.0 + ASK_LEARNT_EVERY_S) == agreement.learnt()


def test_a_fleet_value_whose_tasks_could_have_no_register_is_not_learnt() -> None:
    """Registers begin at the task's number times `CREATION_STEP`, which must leave room to count."""
    last = MAX_REVISION // CREATION_STEP
    for number, is_learnt in ((last + 1, False), (2**30, False), (last, True)):
        agreement = make()
        tasks = (Creation(task="merge", number=number, exclusive=True),)
        told = replace(WITH_EDGE, creations=number, tasks=tasks)
        said = Learnt(node="robot2", values=(), generation=GENERATION, fleet=told)
        agreed(agreement.on_learnt, ev.LearntReceived(learnt=said, is_answer=True), 100.1)
        assert (agreement.number == 3) is is_learnt
        assert (("fleet/register", "") in agreement.problems) is not is_learnt


def test_a_fleet_value_whose_tasks_are_not_its_document_s_is_not_learnt() -> None:
    """By it the node would go by a document whose tasks have no register."""
    agreement = make()
    for tasks, is_learnt in (((), False), ((Creation(task="other", number=1),), False), (WITH_EDGE.tasks, True)):
        said = Learnt(node="robot2", values=(), generation=GENERATION, fleet=replace(WITH_EDGE, tasks=tasks))
        agreed(agreement.on_learnt, ev.LearntReceived(learnt=said, is_answer=True), 100.1)
        assert (agreement.number == 3) is is_learnt
        assert list(agreement.registers) == ["merge"]


def test_what_is_told_unasked_leads_to_a_question_only() -> None:
    agreement = make()
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=WITH_EDGE)
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=False), 100.1)
    assert agreement.number == 0
    assert [one.peer for one in of(todo, do.AskLearnt)] == ["robot2"]


def test_another_generation_s_fleet_value_changes_nothing() -> None:
    agreement = make()
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=replace(WITH_EDGE, generation_id="77"))
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert agreement.number == 0


def test_another_fleet_s_value_changes_nothing_though_it_tells_the_same_generation() -> None:
    agreement = make()
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=replace(WITH_EDGE, fleet="other"))
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert (agreement.fleet_value, todo.must_persist) == (FIRST, False)


def test_a_state_that_tells_no_fleet_value_is_refused() -> None:
    state = state_of("robot1", hardware="h", disk="d1", fleet_register=RegisterState(task=FLEET.name))
    with pytest.raises(ValueError, match="none is learnt"):
        Agreement(
            in_force=InForce(FLEET), me="robot1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0
        )


def test_a_value_that_names_no_document_leaves_the_node_with_the_fleet_that_it_goes_by() -> None:
    agreement = make()
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=replace(WITH_EDGE, document=""))
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert (agreement.number, todo.in_force) == (3, None)
    newer = replace(told, fleet=replace(WITH_EDGE, document="0e", revision=4))
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=newer, is_answer=True), 100.2)
    assert [one.peers for one in of(todo, do.FetchDocument)] == [("robot2", "edge1", "robot3")], "the file's nodes"


def test_a_node_that_knows_no_generation_heeds_no_fleet_value_and_proposes_nothing() -> None:
    agreement = make(has_state=False)
    refused = Refused(
        elector="robot2",
        task=FLEET.name,
        ballot=Ballot(counter=1, node="robot1", incarnation=7),
        refusal=Refusal.NUMBER,
        promised=NO_BALLOT,
        number=3,
        fleet=WITH_EDGE,
    )
    event = ev.FleetAnswered(answer=FleetAnswer(refused=refused))
    assert agreed(agreement.on_fleet_answer, event, 100.1) == ToDo()
    assert agreed(agreement.on_stored, ev.DocumentStored(document="0e", fleet=FLEET), 100.1).in_force is None
    assert (agreement.fleet_value, agreement.number) == (None, 0)
    change = SetLease(base_revision=1, lease_s=2.0)
    fault = agreement.change_fleet(change, todo := ToDo(), 100.1)
    assert fault == "this node does not know the fleet's generation yet"
    assert todo.send == []


def test_an_accepted_value_whose_document_is_gone_at_a_start_is_followed_once_it_is_fetched() -> None:
    value = ADOPTED
    accepted = Acceptance(ballot=Ballot(counter=5, node="robot2", incarnation=9), value=value)
    held = RegisterState(task=FLEET.name, learnt=FIRST, promised=accepted.ballot, accepted=accepted)
    state = state_of("robot1", generation=GENERATION, hardware="h", disk="d1", fleet_register=held)
    agreement = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=state, incarnation=7, electorate="e", rng=Random(1), now=100.0
    )
    told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=value)
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=False), 100.1)
    assert [one.document for one in of(todo, do.FetchDocument)] == ["0d"]
    assert agreement.fleet_value == FIRST
    agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=FLEET), 100.2)
    assert agreement.fleet_value == value


def test_a_node_without_a_state_founds_the_value_of_the_generation_that_it_hears_of() -> None:
    agreement = make(has_state=False)
    told = Learnt(node="robot2", values=(), generation=GENERATION, incarnation=1)
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    prepare = proposed(agreement)
    assert (prepare.generation_id, prepare.number, prepare.creation) == (FIRST.generation_id, 1, GENERATION)
    assert not agreement.is_elector
    assert isinstance(asked(make(), prepare)[1], Promise)


def test_an_elector_whose_name_is_disputed_answers_nobody_under_any_number() -> None:
    agreement = make(WITH_EDGE)
    agreement.dispute("two daemons", ToDo())
    _, answer = asked(agreement, proposed(make(WITH_EDGE, me="robot2")))
    assert isinstance(answer, Refused)
    assert answer.refusal is Refusal.NOT_ELECTOR


def test_an_elector_whose_name_is_disputed_takes_nobody_for_gone() -> None:
    """Its own seat, which names no disk, among them: it has no opinion, as any node that does not elect."""
    agreement = make(ADOPTED)
    agreement.dispute("two daemons", ToDo())
    assert agreement.helm.opinion(agreement.disk, 100.0) == ((), ())


@pytest.mark.parametrize("why", ["", "two daemons", "the disk is full"])
def test_who_has_lost_its_state_and_gets_another_seat_elects_if_nothing_else_forbids_it(why: str) -> None:
    disputed = why if why == "two daemons" else ""
    agreement = make(replace(ADOPTED, settled=True), lost="its folder is old", disputed=disputed)
    if why and not disputed:
        agreement.on_persist_failed(why)
    gone = replace(WITHOUT_ROBOT1, settled=True)
    back = AddElector(base_revision=gone.revision, name="robot1", disk="d1").apply(gone)
    for value in (gone, back):
        told = Learnt(node="robot2", values=(), generation=GENERATION, fleet=value)
        agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.2)
    assert agreement.fleet_value == back
    assert agreement.is_elector is not bool(why)
    assert (("state", "") in agreement.problems) is bool(why)
    assert why in agreement.problems.get(("state", ""), "")
    after = agreement.to_persist(100.3)
    assert (after is None) is (why == "the disk is full")
    assert after is None or (after.lost, after.disputed) == ("", disputed)


def test_electors_that_start_unsettled_ask_after_a_while_that_differs() -> None:
    begun = {seed: make(ADOPTED, seed=seed).next_deadline() - 100.0 for seed in range(4)}
    assert all(0.5 <= after_s / FLEET.timing.stagger_s < 1.5 for after_s in begun.values())
    assert len(set(begun.values())) == len(begun)


def test_ballots_of_today_s_fleets_carry_no_disk() -> None:
    assert proposed(make()).ballot == Ballot(counter=1, node="robot1", incarnation=7)


# --- a document that is missing at the start -------------------------------------------------------------------------


def test_an_elector_without_its_document_remembers_the_tasks_that_its_file_lacks() -> None:
    """Its register begins when the document comes; a second start before that forgets nothing either."""
    document = replace(FLEET, tasks=(TASK, replace(TASK, name="other")))
    adopt = AdoptDocument(base_revision=1, document="0d", tasks=(("merge", True), ("other", True)), lease_s=1.0)
    value = adopt.apply(FIRST)
    ballot = Ballot(counter=9, node="robot2", incarnation=3)
    states = tuple(
        RegisterState(
            task=one.task,
            creation=one.number,
            promised=ballot,
            accepted=Acceptance(ballot=ballot, value=replace(HELD, task=one.task)),
        )
        for one in value.tasks
    )
    elector = make(value, registers=states, stored={})
    assert (elector.is_elector, tuple(elector.registers)) == (True, ("merge",))
    assert elector.document_hash == "", "it goes by its file"
    written = elector.to_persist(100.0)
    assert written is not None
    assert written.registers == states
    elector.on_stored(ev.DocumentStored(document="0d", fleet=document), ToDo(), 100.1)
    under(elector, document, 100.1)
    assert tuple(register.state for register in elector.registers.values()) == states
    assert elector.document_hash == "0d"
    again = elector.to_persist(100.2)
    assert again is not None
    assert again.registers == states


# --- leases over numbers ---------------------------------------------------------------------------------------------

HELD = allocation_of(7, "robot2", 3, leased=True)
L = FLEET.timing.lease_s


def leases(me: str = "robot1") -> Leases:
    return Leases(in_force=InForce(FLEET), me=me, incarnation=1, standing={"merge": HELD}, now=0.0)


def renumbered(one: Leases, number: int = 2, lease_s: float = L, electors: tuple[str, ...] = ROBOTS) -> Leases:
    one.count_with(electors, terms=f"t/{number}", number=number, lease_s=lease_s, standing={"merge": HELD})
    return one


def beat(number: int, node: str = "robot2", sequence: int = 5, **parts: tuple[Grant, ...]) -> Beat:
    return beat_of(node, sequence, learnt=(("merge", 7, 3),), lease_terms=f"t/{number}", number=number, **parts)


OWNERS = {"merge": ("robot2", 3)}


@pytest.mark.parametrize(("number", "grants"), [(2, True), (1, False), (3, False), (0, False)])
def test_owner_that_never_learns_the_new_number_is_granted_nothing(*, number: int, grants: bool) -> None:
    elector = renumbered(leases())
    assert elector.on_beat(beat(number), OWNERS, 10.0) is grants
    assert bool(elector.on_sent(1, 10.0).echoes) is grants


@pytest.mark.parametrize(
    ("terms", "grants"), [("t/2", True), ("t/2, clock in doubt", True), ("u/2", False), ("", False)]
)
def test_an_owner_of_another_generation_is_granted_nothing_though_number_and_epoch_are_the_same(
    *, terms: str, grants: bool
) -> None:
    elector = renumbered(leases())
    assert elector.on_beat(replace(beat(2), lease_terms=terms), OWNERS, 10.0) is grants
    assert bool(elector.on_sent(1, 10.0).echoes) is grants


def test_who_is_no_elector_any_more_grants_nothing_and_still_knows_what_it_has_granted() -> None:
    """Its name may have a seat yet: another disk's."""
    elector = renumbered(leases())
    assert elector.on_beat(beat(2), OWNERS, 10.0)
    elector.count_with(ROBOTS, terms="t/3", number=3, lease_s=L, standing={})
    assert not elector.on_beat(beat(3, sequence=6), OWNERS, 10.1)
    assert elector.on_sent(1, 10.1).echoes == ()
    renumbered(elector, 4)
    assert not elector.may_accept("merge", "robot3", 10.0 + hold_s(L) - 0.01)
    assert elector.may_accept("merge", "robot3", 10.0 + hold_s(L))


@pytest.mark.parametrize(("disk", "grants"), [("d1", True), ("e0", False)])
def test_a_node_that_starts_grants_only_for_a_seat_of_its_own_disk(*, disk: str, grants: bool) -> None:
    """A lost disk's seat is still its name's until it is given up; a new generation may begin meanwhile."""
    seats = tuple(replace(one, disk=disk) if one.name == "robot1" else one for one in WITH_EDGE.electors)
    one = make(replace(WITH_EDGE, electors=seats))
    assert one.is_elector is grants
    after = 100.0 + hold_s(L) + 0.01
    heard = replace(beat(one.number), lease_terms=one.leases.terms)
    assert one.leases.on_beat(heard, OWNERS, after) is grants
    assert bool(one.leases.on_sent(1, after).echoes) is grants


def test_an_elector_that_its_file_does_not_name_waits_a_lease_after_its_start() -> None:
    """Its document is missing, so it is an elector by the agreed value alone; its life before may have granted."""
    seats = tuple(replace(one, disk="d1") if one.name == "edge1" else one for one in WITH_EDGE.electors)
    number = WITH_EDGE.creation("merge")
    assert number is not None
    register = RegisterState(task="merge", creation=number.number, learnt=HELD)
    one = make(replace(WITH_EDGE, electors=seats), me="edge1", registers=(register,), stored={})
    assert one.is_elector
    heard = replace(beat(one.number), lease_terms=one.leases.terms)
    over_at = 100.0 + hold_s(L)
    for now, is_over in ((100.0, False), (over_at - 0.01, False), (over_at, True)):
        assert one.leases.may_accept("merge", "robot2", now), "its own owner may go on"
        assert one.leases.may_accept("merge", "robot3", now) is is_over
        assert one.leases.on_beat(heard, OWNERS, now) is is_over


def test_another_generation_with_the_same_number_is_counted_anew() -> None:
    one = renumbered(leases())
    one.count_with(("robot1",), terms="u/2", number=2, lease_s=L, standing={"merge": HELD})
    assert (one.terms, one.electors) == ("u/2", ("robot1",))


def test_a_release_counts_whatever_number_its_sender_counts_by() -> None:
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    renumbered(elector)
    assert not elector.may_accept("merge", "robot3", 10.1)
    given_back = Grant(task="merge", owner="robot2", incarnation=1, epoch=3, number=5)
    elector.on_beat(beat(0, sequence=6, released=(given_back,)), OWNERS, 10.1)
    assert elector.may_accept("merge", "robot3", 10.1)


def echoes(node: str, owner: str, number: int) -> tuple[Grant, ...]:
    del node
    return (Grant(task="merge", owner=owner, incarnation=1, epoch=3, number=number),)


def holder() -> Leases:
    """robot1 has sent beat 5 at 10 s, and robot2 and robot3 have echoed it."""
    one = leases()
    one.begin("merge", 3, 5)
    one.on_sent(5, 10.0)
    for name in ("robot2", "robot3"):
        heard = replace(beat(0, name), echoes=echoes(name, "robot1", 5), lease_terms=one.terms)
        one.on_beat(heard, {}, 10.1)
    assert one.until("merge") == 10.0 + L
    return one


def test_change_leaves_the_owner_alone() -> None:
    one = renumbered(holder())
    assert one.until("merge") == 10.0 + L, "what it held runs to its end"
    one.on_sent(6, 10.2)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name, 6), echoes=echoes(name, "robot1", 6)), {}, 10.3)
    assert one.until("merge") == 10.2 + L


def test_an_owner_that_has_sent_no_beat_yet_holds_from_its_first_one_on() -> None:
    one = leases()
    one.begin("merge", 3, 5)
    renumbered(one)
    one.on_sent(5, 10.2)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name), echoes=echoes(name, "robot1", 5)), {}, 10.3)
    assert one.until("merge") == 10.2 + L


def test_an_echo_of_another_number_does_not_count() -> None:
    one = renumbered(holder())
    one.on_sent(6, 10.2)
    for name in ("robot2", "robot3"):
        stale = replace(beat(0, name, 6), echoes=echoes(name, "robot1", 6), lease_terms="t/2")
        one.on_beat(stale, {}, 10.3)
    assert one.until("merge") == 10.0 + L


def test_a_lease_of_before_ends_with_its_release() -> None:
    one = renumbered(holder())
    one.end("merge", 5)
    one.begin("merge", 4, 6)
    assert one.until("merge") == -math.inf


def test_the_new_electors_majority_is_needed() -> None:
    one = renumbered(holder(), electors=NAMES)
    one.on_sent(6, 10.2)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name, 6), echoes=echoes(name, "robot1", 6)), {}, 10.3)
    assert one.until("merge") == 10.0 + L, "two of four"
    one.on_beat(replace(beat(2, "edge1", 6), echoes=echoes("edge1", "robot1", 6)), {}, 10.4)
    assert one.until("merge") == 10.2 + L


def test_lease_shortened_a_grant_of_before_is_guarded_with_its_own_length() -> None:
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    renumbered(elector, lease_s=L / 10)
    assert not elector.may_accept("merge", "robot3", 10.0 + hold_s(L) - 0.01)
    assert elector.may_accept("merge", "robot3", 10.0 + hold_s(L))
    assert elector.on_beat(beat(2, sequence=7), OWNERS, 20.0) is False, "no new grant: the same owner's"
    assert not elector.may_accept("merge", "robot3", 20.0 + hold_s(L / 10) - 0.01)
    assert elector.may_accept("merge", "robot3", 20.0 + hold_s(L / 10))


def test_lease_shortened_a_later_grant_does_not_end_an_earlier_longer_one() -> None:
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    renumbered(elector, lease_s=L / 10)
    elector.on_beat(beat(2, sequence=7), OWNERS, 10.1)
    assert not elector.may_accept("merge", "robot3", 10.0 + hold_s(L) - 0.01)
    assert elector.may_accept("merge", "robot3", 10.0 + hold_s(L))


def test_lease_shortened_the_next_life_still_waits_for_a_grant_of_before() -> None:
    """The state file says how long a grant of this elector may last, whatever the lease is by now."""
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    assert elector.to_remember_s(10.0) == L
    renumbered(elector, lease_s=L / 10)
    over_at = 10.0 + hold_s(L)
    assert elector.to_remember_s(10.1) >= L
    assert elector.to_remember_s(over_at - 0.01) >= L
    assert elector.to_remember_s(over_at) == L / 10
    elector.on_beat(beat(2, sequence=7), OWNERS, 10.2)
    shorter = replace(FLEET, timing=replace(FLEET.timing, lease_s=L / 10))
    granted_s = elector.to_remember_s(10.3)
    next_life = Leases(
        in_force=InForce(shorter), me="robot1", incarnation=2, standing={}, now=10.3, granted_s=granted_s
    )
    assert next_life.over_at >= over_at


def test_lease_shortened_a_clock_in_doubt_does_not_end_the_guard_of_a_grant_of_before() -> None:
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    renumbered(elector, lease_s=L / 10)
    elector.doubt({"merge": HELD})
    assert elector.to_remember_s(10.1) >= L
    elector.trust({"merge": HELD}, 9, 10.2)
    over_at = 10.2 + hold_s(L)
    assert elector.to_remember_s(over_at - 0.01) >= L
    assert not elector.may_accept("merge", "robot3", over_at - 0.01)
    assert elector.may_accept("merge", "robot3", over_at)
    assert elector.to_remember_s(over_at) == L / 10


def test_a_clock_in_doubt_after_a_start_does_not_end_the_guard_of_the_life_before() -> None:
    elector = Leases(
        in_force=InForce(FLEET), me="robot1", incarnation=1, standing={"merge": HELD}, now=0.0, granted_s=3 * L
    )
    elector.doubt({"merge": HELD})
    elector.trust({"merge": HELD}, 9, 0.2)
    assert not elector.may_accept("merge", "robot3", hold_s(3 * L) - 0.01)
    assert elector.may_accept("merge", "robot3", 0.2 + hold_s(3 * L))


def test_lease_lengthened_a_beat_of_before_holds_no_longer_than_its_grant_is_guarded() -> None:
    """Electors may echo what they granted under the number before; they guard it with the shorter length."""
    one = renumbered(holder(), lease_s=10 * L)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name, 6), echoes=echoes(name, "robot1", 5)), {}, 10.2)
    assert one.until("merge") == 10.0 + L
    one.on_sent(6, 10.3)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name, 7), echoes=echoes(name, "robot1", 6)), {}, 10.4)
    assert one.until("merge") == 10.3 + 10 * L


def test_task_removed_and_added_grants_are_remembered_by_name() -> None:
    elector = leases()
    assert elector.on_beat(beat(0), OWNERS, 10.0)
    elector.count_with(ROBOTS, terms="t/2", number=2, lease_s=L, standing={})
    renumbered(elector, 3)
    assert not elector.may_accept("merge", "robot3", 10.0 + hold_s(L) - 0.01)


def test_a_node_that_becomes_an_elector_grants() -> None:
    spare = Leases(in_force=InForce(FLEET), me="edge1", incarnation=1, standing={}, now=0.0)
    assert not spare.on_beat(beat(0), OWNERS, 10.0)
    renumbered(spare, electors=NAMES)
    assert spare.on_beat(beat(2, sequence=6), OWNERS, 10.1)
    assert not spare.may_accept("merge", "robot3", 10.2)


def test_the_same_number_again_changes_nothing() -> None:
    one = renumbered(holder())
    one.on_sent(6, 10.2)
    for name in ("robot2", "robot3"):
        one.on_beat(replace(beat(2, name, 6), echoes=echoes(name, "robot1", 6)), {}, 10.3)
    renumbered(one)
    assert one.until("merge") == 10.2 + L
