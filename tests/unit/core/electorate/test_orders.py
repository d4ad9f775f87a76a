"""A node's changes of the fleet: which commands are taken, what is on disk before an answer, what is kept."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import TypeVar

import pytest

from support.fleets import fleet_of, task_of
from support.states import state_of
from support.todos import agreed, under
from zsched.core.electorate import orders
from zsched.core.electorate.changes import AdoptDocument, SetDocument, SetLease
from zsched.core.electorate.documents import RECENT
from zsched.core.electorate.founding import founded
from zsched.core.electorate.numbers import in_force
from zsched.core.electorate.orders import MAX_OPEN, document_change
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import RoundOutcome, told_end
from zsched.core.values.document import Document, Flag, FlagKind, Rollout, Text
from zsched.core.values.electorate import FleetValue
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import (
    Accept,
    Accepted,
    ChangeFleet,
    CommandOutcome,
    FleetAnswer,
    Learnt,
    Prepare,
    Promise,
    Refusal,
    Refused,
    fleet_question,
)
from zsched.core.values.model import Acceptance, Asked, Ballot, RegisterState
from zsched.core.values.problems import Problem
from zsched.core.values.todo import ToDo
from zsched.core.vote.agreement import SETTLE_AFTER_START_S, Agreement

T = TypeVar("T")
NAMES = ("edge1", "robot1", "robot2", "robot3")
ROBOTS = NAMES[1:]
TASK = task_of(candidates=NAMES, exclusive=True)
FLEET = fleet_of(TASK, of=NAMES, electors=ROBOTS)
SAID = replace(FLEET, zenoh_config="z.json5")
FIRST = founded(FLEET.name, 0, ROBOTS)
ADOPT = AdoptDocument(base_revision=1, document="0d", tasks=(("merge", True),), lease_s=1.0)
ADOPTED = replace(ADOPT.apply(FIRST), settled=True)
BALLOT = Ballot(counter=5, node="robot2", incarnation=9)


def make(
    value: FleetValue | None = None,
    stored: dict[str, Fleet] | None = None,
    flags: dict[str, tuple[Flag, ...]] | None = None,
) -> Agreement:
    held = None if value is None else RegisterState(task=FLEET.name, learnt=value)
    state = state_of("robot1", hardware="h", disk="d1", fleet_register=held)
    agreement = Agreement(
        in_force=InForce(FLEET),
        me="robot1",
        durable=state,
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
        stored=stored or {},
        flags=flags or {},
    )
    for name in NAMES:
        agreement.witness.on_answer(Learnt(node=name, values=()))
    return agreement


def of(todo: ToDo, kind: type[T]) -> list[T]:
    return [one for one in (*todo.send, *todo.apply) if isinstance(one, kind)]


def prepare_of(ballot: Ballot = BALLOT, value: FleetValue = FIRST) -> Prepare:
    return Prepare(
        task=FLEET.name, ballot=ballot, electorate="e", generation_id=value.generation_id, number=value.number
    )


def accept_of(value: FleetValue, under: FleetValue = FIRST) -> Accept[FleetValue]:
    acceptance = Acceptance(ballot=BALLOT, value=value)
    return Accept(
        task=FLEET.name,
        acceptance=acceptance,
        electorate="e",
        generation_id=under.generation_id,
        number=under.number,
    )


def asked(
    agreement: Agreement, question: Prepare | Accept[FleetValue], asker: str = "robot2"
) -> tuple[ToDo, FleetAnswer | None]:
    event = ev.FleetAsked(request=1, asker=asker, question=fleet_question(question))
    todo = agreed(agreement.acceptor.on_fleet_asked, event, 100.1)
    answers = of(todo, do.AnswerFleet)
    return todo, answers[0].answer if answers else None


def commanded(agreement: Agreement, command: ChangeFleet, request: int = 3) -> ToDo:
    todo = ToDo()
    agreement.orders.take(ev.FleetCommanded(request=request, command=command), todo, 100.1)
    return todo


def told(todo: ToDo) -> tuple[CommandOutcome, str]:
    (answer,) = of(todo, do.AnswerCommand)
    return answer.result.outcome, answer.result.detail


def test_documents_of_changes_that_are_under_way_stay_however_many_others_come() -> None:
    """The first of many was chosen after its document had gone here: the node went by a fleet that it did not know."""
    agreement = make(ADOPTED, {"0d": FLEET})
    documents = [f"a{number}" for number in range(RECENT + 3)]
    kept: tuple[str, ...] = ()
    for request, document in enumerate(documents):
        commanded(agreement, ChangeFleet(document=Document(text=Text(document))), request)
        todo = agreed(agreement.on_stored, ev.DocumentStored(document=document, fleet=SAID, request=request), 100.2)
        for one in of(todo, do.KeepDocuments):
            kept = one.documents
    assert {"0d", *documents} <= set(kept)
    assert agreement.fleet_value == ADOPTED, "all of them wait"


def test_of_more_commands_than_can_wait_the_oldest_ends_with_an_answer_and_changes_nothing() -> None:
    agreement = make(FIRST)
    for request in range(MAX_OPEN):
        content = Document(text=Text(f"fleet: {request}"))
        assert of(commanded(agreement, ChangeFleet(document=content), request), do.AnswerCommand) == []
    todo = commanded(agreement, ChangeFleet(document=Document(text=Text("fleet: new"))), MAX_OPEN)
    (answer,) = of(todo, do.AnswerCommand)
    assert (answer.request, answer.result.outcome) == (0, CommandOutcome.CONFLICT)
    assert "try again" in answer.result.detail
    late = ToDo()
    stored = ev.DocumentStored(document="0d", fleet=SAID, request=0)
    agreement.orders.on_stored(stored, late, 100.2)
    assert of(late, do.AnswerCommand) == []


# --- electors --------------------------------------------------------------------------------------------------------


def test_a_promise_of_the_first_change_is_on_disk_before_its_answer_and_after_a_restart() -> None:
    agreement = make()
    todo, answer = asked(agreement, prepare_of())
    assert answer is not None
    assert answer.promise is not None
    assert todo.must_persist
    state = agreement.to_persist(100.1)
    assert state is not None
    assert state.fleet_register is not None
    assert state.fleet_register.promised == BALLOT
    again = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=state, incarnation=8, electorate="e", rng=Random(1), now=200.0
    )
    for name in NAMES:
        again.witness.on_answer(Learnt(node=name, values=()))
    _, answer = asked(again, prepare_of(replace(BALLOT, counter=4)))
    assert answer is not None
    assert answer.refused is not None
    assert answer.refused.refusal is Refusal.BALLOT


@pytest.mark.parametrize("asker", ["robot3", "ghost"])
def test_a_ballot_that_is_not_its_asker_s_is_counted_and_not_answered(asker: str) -> None:
    agreement = make()
    assert asked(agreement, prepare_of(), asker)[1] is None
    assert agreement.counters["fleet_foreign"] == 1


def test_fleet_questions_are_rate_limited_as_all_prepares_are() -> None:
    """Each promise costs an fsync."""
    agreement = make()
    answers = [asked(agreement, prepare_of(replace(BALLOT, counter=number + 1)))[1] for number in range(60)]
    refused = [one.refused.refusal for one in answers if one is not None and one.refused is not None]
    assert refused == [Refusal.RATE] * agreement.counters["prepare_rate"]
    assert 0 < len(refused) < 60


def test_a_value_of_another_generation_than_its_question_is_not_accepted() -> None:
    agreement = make(stored={"0d": SAID})
    asked(agreement, prepare_of())
    todo, answer = asked(agreement, accept_of(replace(ADOPT.apply(FIRST), generation_id="77")))
    assert answer is None
    assert not todo.must_persist
    _, answer = asked(agreement, accept_of(ADOPT.apply(FIRST)))
    assert answer is not None
    assert answer.accepted is not None


def test_an_answer_of_no_node_of_the_fleet_is_counted_and_completes_no_majority() -> None:
    agreement = make(ADOPTED, {"0d": FLEET})
    (ask,) = of(commanded(agreement, ChangeFleet(remove_elector="robot2")), do.AskElectors)
    assert isinstance(ask.question, Prepare)
    for name in ("ghost", "ghost2"):
        promise: Promise[FleetValue] = Promise(elector=name, task=FLEET.name, ballot=ask.question.ballot)
        event = ev.FleetAnswered(answer=FleetAnswer(promise=promise))
        assert agreed(agreement.on_fleet_answer, event, 100.3) == ToDo()
    assert agreement.counters["answer_foreign"] == 2


def test_another_electorate_of_a_file_is_refused() -> None:
    _, answer = asked(make(), replace(prepare_of(), electorate="other"))
    assert answer is not None
    assert answer.refused is not None
    assert answer.refused.refusal is Refusal.ELECTORATE


def test_a_value_is_accepted_once_its_document_is_stored() -> None:
    agreement = make()
    asked(agreement, prepare_of())
    accept = accept_of(ADOPT.apply(FIRST))
    todo, answer = asked(agreement, accept)
    assert answer is not None
    assert answer.refused is not None
    assert answer.refused.refusal is Refusal.DOCUMENT
    (fetch,) = of(todo, do.FetchDocument)
    assert (fetch.document, fetch.peers[0]) == ("0d", "robot2")
    assert "robot1" not in fetch.peers
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID), 100.2)
    assert of(todo, do.KeepDocuments) == [do.KeepDocuments(documents=("0d",))]
    todo, answer = asked(agreement, accept)
    assert answer is not None
    assert answer.accepted is not None
    assert todo.must_persist
    assert of(todo, do.KeepDocuments) == [], "it is kept already"
    assert agreement.fleet_value == FIRST, "accepted is not learnt"


def test_the_document_of_an_accepted_value_stays_however_many_others_come() -> None:
    """The state names it: after a restart the value could not be read without it."""
    agreement = make()
    asked(agreement, prepare_of())
    agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID), 100.2)
    asked(agreement, accept_of(ADOPT.apply(FIRST)))
    for number in range(RECENT + 2):
        todo = agreed(agreement.on_stored, ev.DocumentStored(document=f"a{number}", fleet=SAID), 100.3)
    (kept,) = of(todo, do.KeepDocuments)
    assert "0d" in kept.documents
    assert len(kept.documents) == 1 + RECENT


def test_a_document_that_names_this_node_no_more_is_another_problem() -> None:
    agreement = make()
    asked(agreement, prepare_of())
    asked(agreement, accept_of(ADOPT.apply(FIRST)))
    agreement.on_refused(ev.DocumentRefused(document="0d", reason="you are not in it", is_taken_out=True), ToDo())
    assert "you are not in it" in agreement.problems[Problem.TAKEN_OUT, ""]
    assert (Problem.DOCUMENT, "") not in agreement.problems


def test_a_value_is_refused_for_good_while_its_document_is_not_valid_here() -> None:
    agreement = make()
    asked(agreement, prepare_of())
    asked(agreement, accept_of(ADOPT.apply(FIRST)))
    agreement.on_refused(ev.DocumentRefused(document="0d", reason="no robot"), ToDo())
    todo, answer = asked(agreement, accept_of(ADOPT.apply(FIRST)))
    assert answer is not None
    assert answer.refused is not None
    assert of(todo, do.FetchDocument) == []
    assert "no robot" in agreement.problems[Problem.DOCUMENT, ""]
    assert agreement.counters["document_refused"] == 1
    agreement.retry_documents()
    assert "no robot" not in agreement.problems.get(("fleet/document", ""), "")
    assert of(asked(agreement, accept_of(ADOPT.apply(FIRST)))[0], do.FetchDocument), "the file here has changed"


# --- what is learnt --------------------------------------------------------------------------------------------------


def test_a_learnt_value_is_followed_once_the_disk_takes_its_document() -> None:
    agreement = make()
    value = ADOPT.apply(FIRST)
    answer = Learnt(node="robot3", values=(), fleet=value)
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=answer, is_answer=True), 100.1)
    (fetch,) = of(todo, do.FetchDocument)
    full = ev.DocumentRefused(document="0d", reason="free or remount the disk", is_of_disk=True)
    agreement.on_refused(full, ToDo())
    assert "cannot be stored here" in agreement.problems["fleet/document", ""]
    assert agreement.problems["fleet/document", ""].endswith(": free or remount the disk")
    assert of(agreed(agreement.tick, 103.2), do.FetchDocument) == [fetch]
    agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID), 104.0)
    assert agreement.fleet_value == value
    assert ("fleet/document", "") not in agreement.problems


def test_a_learnt_value_is_followed_once_its_document_is_stored_and_asked_for_until_then() -> None:
    agreement = make()
    value = ADOPT.apply(FIRST)
    answer = Learnt(node="robot3", values=(), fleet=value)
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=answer, is_answer=True), 100.1)
    (fetch,) = of(todo, do.FetchDocument)
    assert fetch.peers[0] == "robot3"
    assert (agreement.number, todo.must_persist) == (0, False)
    assert of(agreed(agreement.tick, agreement.next_deadline()), do.FetchDocument) == []
    assert of(agreed(agreement.tick, 103.2), do.FetchDocument) == [fetch]
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID), 104.0)
    assert (agreement.fleet_value, todo.must_persist, todo.in_force) == (value, True, in_force(SAID, value))


def test_a_node_that_has_come_by_the_file_is_asked_for_documents_too() -> None:
    agreement = make()
    under(agreement, fleet_of(TASK, of=(*NAMES, "robot4"), electors=ROBOTS), 100.0)
    told = Learnt(node="robot3", values=(), fleet=ADOPT.apply(FIRST))
    todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=told, is_answer=True), 100.1)
    assert [one.peers for one in of(todo, do.FetchDocument)] == [("robot3", "robot2", "edge1", "robot4")]


def test_an_elector_that_starts_again_asks_what_became_of_a_value_that_it_has_accepted() -> None:
    agreement = make(stored={"0d": FLEET})
    asked(agreement, prepare_of())
    asked(agreement, accept_of(ADOPTED))
    state = agreement.to_persist(100.2)
    again = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=state, incarnation=8, electorate="e", rng=Random(1), now=200.0
    )
    todo = agreed(again.tick, 200.0 + SETTLE_AFTER_START_S)
    assert [type(one.question) for one in of(todo, do.AskElectors)] == [Prepare]


def learns_what_goes(agreement: Agreement, value: FleetValue, said: Fleet) -> ToDo:
    """A round of this node chooses ``value``, whose document has gone from here while the round ran."""
    agreed(agreement.on_stored, ev.DocumentStored(document=value.document, fleet=said), 100.0)
    agreement.change_fleet(SetLease(base_revision=2, lease_s=2.0), todo := ToDo(), 100.1)
    (ask,) = of(todo, do.AskElectors)
    assert isinstance(ask.question, Prepare)
    todo = ToDo()
    for name in ROBOTS[1:]:
        held = Acceptance(ballot=BALLOT, value=value)
        promise = Promise(elector=name, task=FLEET.name, ballot=ask.question.ballot, accepted=held)
        agreement.on_fleet_answer(ev.FleetAnswered(answer=FleetAnswer(promise=promise)), todo, 100.2)
    for number in range(RECENT + 1):
        agreed(agreement.on_stored, ev.DocumentStored(document=f"a{number}", fleet=said), 100.3)
    todo = ToDo()
    for name in ROBOTS[1:]:
        accepted = Accepted(elector=name, task=FLEET.name, ballot=ask.question.ballot)
        agreement.on_fleet_answer(ev.FleetAnswered(answer=FleetAnswer(accepted=accepted)), todo, 100.4)
    return todo


def test_a_value_whose_document_goes_while_its_round_runs_is_followed_once_that_is_fetched_again() -> None:
    """Another node's value, which this round hands on: no change of this node's keeps its document here."""
    agreement, value = make(ADOPTED, {"0d": FLEET}), replace(ADOPTED, document="0e", revision=3)
    todo = learns_what_goes(agreement, value, SAID)
    assert (agreement.fleet_value, todo.in_force) == (value, None)
    assert "this node asks its peers" in agreement.problems["fleet/document", ""]
    assert [one.document for one in of(todo, do.FetchDocument)] == ["0e"]
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0e", fleet=SAID), 100.5)
    assert (todo.in_force, agreement.problems) == (in_force(SAID, value), {})


def test_a_task_that_such_a_value_lacks_is_known_here_until_its_document_is_back() -> None:
    """All stages go by the fleet of before, and ask for the task's value."""
    agreement, value = make(ADOPTED, {"0d": FLEET}), replace(ADOPTED, document="0e", revision=3, tasks=())
    bare = replace(SAID, tasks=())
    learns_what_goes(agreement, value, bare)
    assert agreement.fleet_value == value
    assert list(agreement.values()) == ["merge"]
    agreement.leases.doubt(agreement.standing())
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0e", fleet=bare), 100.5)
    assert todo.in_force == in_force(bare, value)
    assert list(agreement.values()) == []


def test_what_is_known_here_is_kept_on_disk_and_older_ones_go() -> None:
    """A document that comes back is known, so it is not fetched: then it must still be on the disk."""
    agreement = make(ADOPTED, {"0d": FLEET})
    before, seen = ADOPTED, list[str]()
    kept: tuple[str, ...] = ("0d",)
    for document in ("0e", "0f", "0d", "1a", "1b", "1c", "1d", "0d"):
        after = replace(before, document=document, revision=before.revision + 1)
        answer = Learnt(node="robot3", values=(), fleet=after)
        todo = agreed(agreement.on_learnt, ev.LearntReceived(learnt=answer, is_answer=True), 100.1)
        kept = next((one.documents for one in of(todo, do.KeepDocuments)), kept)
        if of(todo, do.FetchDocument):
            seen.append(f"fetches {document}")
            todo = agreed(agreement.on_stored, ev.DocumentStored(document=document, fleet=SAID), 100.2)
            for one in of(todo, do.KeepDocuments):
                kept = one.documents
        assert agreement.fleet_value == after
        assert {document, before.document} <= set(kept), "the newest and the one before"
        assert len(kept) <= 2 + RECENT
        before = after
    assert seen == [f"fetches {one}" for one in ("0e", "0f", "1a", "1b", "1c", "1d", "0d")], "0d is old in the end"


def test_a_node_that_has_lost_its_document_goes_on_and_asks_for_it() -> None:
    agreement = make(ADOPTED, {})
    assert [one.document for one in of(agreement.at_start, do.FetchDocument)] == ["0d"]
    assert "not on this disk" in agreement.problems["fleet/document", ""]
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID), 100.2)
    assert todo.in_force == in_force(SAID, ADOPTED)
    assert agreement.problems == {}


def test_the_agreed_electors_and_lease_are_in_force_and_not_the_document_s() -> None:
    value = replace(ADOPTED, electors=ADOPTED.electors[1:], lease_s=0.7)
    fleet = in_force(SAID, value)
    assert (fleet.electors, fleet.timing.lease_s, fleet.zenoh_config) == (("robot2", "robot3"), 0.7, "z.json5")


# --- commands --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("command", "outcome", "detail"),
    [
        (ChangeFleet(remove_elector="robot2", base_revision=1), CommandOutcome.CONFLICT, "at revision 2, not 1"),
        (ChangeFleet(remove_elector="edge1"), CommandOutcome.INVALID, "edge1 is no elector"),
        (ChangeFleet(add_elector="robot2", disk="d2"), CommandOutcome.INVALID, "robot2 is an elector"),
        (ChangeFleet(add_elector="robot9", disk="d9"), CommandOutcome.INVALID, "robot9 is no node of the fleet"),
    ],
)
def test_a_change_that_cannot_be_made_is_answered_at_once(
    command: ChangeFleet, outcome: CommandOutcome, detail: str
) -> None:
    kind, text = told(commanded(make(ADOPTED, {"0d": FLEET}), command))
    assert kind is outcome
    assert detail in text


def test_no_elector_is_changed_before_a_document_is_agreed() -> None:
    assert told(commanded(make(), ChangeFleet(remove_elector="robot2"))) == (
        CommandOutcome.INVALID,
        "no document is agreed yet",
    )


def test_a_document_is_stored_then_proposed() -> None:
    agreement = make()
    content = Document(text=Text("fleet: test"))
    todo = commanded(agreement, ChangeFleet(document=content))
    assert todo.send == [do.StoreDocument(request=3, content=content)]
    todo = agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=SAID, request=3), 100.2)
    (ask,) = of(todo, do.AskElectors)
    assert ask.to == ROBOTS
    assert isinstance(ask.question, Prepare)
    todo = ToDo()
    for name in ROBOTS[1:]:
        promise: Promise[FleetValue] = Promise(elector=name, task=FLEET.name, ballot=ask.question.ballot)
        agreement.on_fleet_answer(ev.FleetAnswered(answer=FleetAnswer(promise=promise)), todo, 100.3)
    (accept,) = [one.question for one in of(todo, do.AskElectors)]
    assert isinstance(accept, Accept)
    assert accept.acceptance.value == ADOPT.apply(FIRST)


def test_a_document_that_cannot_be_used_answers_its_command() -> None:
    agreement = make()
    commanded(agreement, ChangeFleet(document=Document(text=Text("?"))))
    todo = ToDo()
    agreement.on_refused(ev.DocumentRefused(document="0d", reason="no nodes", request=3), todo)
    assert told(todo) == (CommandOutcome.INVALID, "no nodes")
    assert agreement.problems == {}, "it is the operator's mistake, not this node's"


def test_a_document_without_an_elector_is_refused() -> None:
    agreement = make(ADOPTED, {"0d": FLEET})
    commanded(agreement, ChangeFleet(document=Document(text=Text("fewer"))))
    fewer = replace(SAID, nodes=tuple(node for node in SAID.nodes if node.name != "robot3"))
    event = ev.DocumentStored(document="0e", fleet=fewer, request=3)
    kind, text = told(agreed(agreement.on_stored, event, 100.2))
    assert kind is CommandOutcome.INVALID
    assert "robot3: an elector, and not in the document" in text


def test_each_end_of_a_change_has_its_answer() -> None:
    words = {
        RoundOutcome.COMMITTED: CommandOutcome.OK,
        RoundOutcome.CONFLICT: CommandOutcome.CONFLICT,
        RoundOutcome.NO_QUORUM: CommandOutcome.NO_QUORUM,
        RoundOutcome.UNKNOWN: CommandOutcome.UNKNOWN,
    }
    for outcome, kind in words.items():
        agreement = make(ADOPTED, {"0d": FLEET})
        commanded(agreement, ChangeFleet(remove_elector="robot2"))
        ((change, *_),) = agreement.orders._running
        todo = ToDo()
        agreement.orders.on_ended(change, outcome, todo)
        assert told(todo)[0] is kind
        agreement.orders.on_ended(change, outcome, again := ToDo())
        assert of(again, do.AnswerCommand) == []


def test_a_command_that_another_change_has_made_impossible_is_told_why() -> None:
    """A round that finds nothing to change ends as unchanged: then the value that is in force says why."""
    agreement = make(ADOPTED, {"0d": FLEET})
    commanded(agreement, ChangeFleet(remove_elector="robot2"))
    ((change, *_),) = agreement.orders._running
    gone = replace(ADOPTED, electors=(ADOPTED.electors[0], ADOPTED.electors[2]), number=3, revision=3)
    answer = Learnt(node="robot3", values=(), fleet=gone)
    agreed(agreement.on_learnt, ev.LearntReceived(learnt=answer, is_answer=True), 100.2)
    agreement.orders.on_ended(change, RoundOutcome.UNCHANGED, todo := ToDo())
    assert told(todo) == (CommandOutcome.INVALID, "robot2 is no elector")


def test_a_change_to_a_document_that_this_node_cannot_take_over_is_not_proposed() -> None:
    foreign = replace(SAID, name="other")
    agreement = make(ADOPTED, {"0d": FLEET, "0e": foreign})
    for document, why in (("0e", "the file is of fleet 'other'"), ("0f", "the document 0f is not stored here")):
        change = SetDocument(base_revision=ADOPTED.revision, document=document, tasks=())
        fault = agreement.change_fleet(change, todo := ToDo(), 100.1)
        assert fault.startswith(why)
        assert todo.send == []


def test_a_refusal_s_fleet_value_waits_for_its_document() -> None:
    agreement = make(ADOPTED, {"0d": FLEET})
    newer = replace(ADOPTED, document="0e", number=3, revision=5)
    refused = Refused(
        elector="robot2",
        task=FLEET.name,
        ballot=BALLOT,
        refusal=Refusal.NUMBER,
        promised=BALLOT,
        number=3,
        fleet=newer,
    )
    todo = agreed(agreement.on_fleet_answer, ev.FleetAnswered(answer=FleetAnswer(refused=refused)), 100.1)
    assert [one.document for one in of(todo, do.FetchDocument)] == ["0e"]
    assert agreement.fleet_value == ADOPTED


# --- in whose name ---------------------------------------------------------------------------------------------------

ANA = Asked(by="ana.operator", reason="new fan")
BOB = "bob@robot1"
"""Whom the program names, and who has not given the command."""
DRAINED = Flag(kind=FlagKind.DRAIN, subject="robot3", by="eve@robot2", reason="a wheel", revision=2)
WAITS = Rollout(task="merge", first=("robot1",), command=(Text("old"),), by="eve@robot2", revision=2)


def names_in(content: Document, *, asked: Asked | None = ANA) -> tuple[list[str], list[str]]:
    """Whose names stand in the document that is written for a command: of its flags, and of its rollouts."""
    fleet = replace(FLEET, tasks=(replace(TASK, rollout=WAITS),))
    agreement = make(ADOPTED, {"0d": fleet}, {"0d": (DRAINED,)})
    (store,) = of(commanded(agreement, ChangeFleet(document=content, asked=asked)), do.StoreDocument)
    assert replace(store.content, flags=(), rollouts=()) == replace(content, flags=(), rollouts=())
    return [flag.by for flag in store.content.flags], [one.by for one in store.content.rollouts]


def test_who_gives_a_command_is_named_by_what_is_new_or_changed_and_by_nothing_else() -> None:
    new = Flag(kind=FlagKind.INELIGIBLE, subject="robot2", by=BOB, revision=3)
    text = Text("fleet: new")
    assert names_in(Document(text=text, flags=(DRAINED, new), rollouts=(WAITS,))) == (
        ["eve@robot2", "ana.operator"],
        ["eve@robot2"],
    )
    changed = replace(DRAINED, reason="another wheel")
    wave = replace(WAITS, first=("robot2",))
    assert names_in(Document(text=text, flags=(changed,), rollouts=(wave,))) == (["ana.operator"], ["ana.operator"])
    for renamed in (replace(DRAINED, by=BOB), replace(DRAINED, by="")):
        assert names_in(Document(text=text, flags=(renamed,))) == (["ana.operator"], []), "no flag gets another's name"


def test_a_command_of_an_older_program_without_a_name_stays_as_it_is() -> None:
    new = Flag(kind=FlagKind.DRAIN, subject="robot2", by=BOB, revision=3)
    assert names_in(Document(text=Text("fleet: new"), flags=(new,)), asked=None) == ([BOB], [])


def test_flags_of_a_first_document_are_in_the_name_of_who_brings_it() -> None:
    content = Document(text=Text("fleet: hall"), flags=(DRAINED,))
    (store,) = of(commanded(make(FIRST), ChangeFleet(document=content, asked=ANA)), do.StoreDocument)
    assert [flag.by for flag in store.content.flags] == ["ana.operator"]


def ended(outcome: RoundOutcome, asked: Asked | None = ANA, reason: str = "drain robot2") -> do.RecordStory:
    """What the journal tells of a change that has ended."""
    agreement = make(ADOPTED, {"0d": FLEET})
    commanded(agreement, ChangeFleet(remove_elector="robot2", reason=reason, asked=asked))
    ((change, *_),) = agreement.orders._running
    agreement.orders.on_ended(change, outcome, todo := ToDo())
    (story,) = of(todo, do.RecordStory)
    return story


def test_the_journal_tells_who_has_changed_the_fleet() -> None:
    done = ended(RoundOutcome.COMMITTED)
    told_first = "ana.operator (new fan): drain robot2, on revision 2: committed"
    assert (done.text, done.by) == (told_first, "ana.operator")
    assert ended(RoundOutcome.UNKNOWN).by == "ana.operator", "it may have been agreed"
    assert ended(RoundOutcome.CONFLICT).by == "", "nothing was changed"
    nameless = ended(RoundOutcome.COMMITTED, None)
    assert (nameless.text, nameless.by) == ("drain robot2, on revision 2: committed", "")


# --- flags whose time is over ----------------------------------------------------------------------------------------

STAYS = (Flag(kind=FlagKind.INELIGIBLE, subject="robot3", revision=3),)


def test_the_document_without_a_flag_whose_time_is_over_is_written_then_proposed() -> None:
    agreement = make(ADOPTED, {"0d": FLEET})
    agreement.orders.end_flags(STAYS, todo := ToDo())
    assert todo.send == [do.AmendDocument(document="0d", flags=STAYS)]
    foreign = ev.DocumentStored(document="0e", fleet=FLEET)
    assert of(agreed(agreement.on_stored, foreign, 100.1), do.AskElectors) == [], "another one, of a peer"
    event = ev.DocumentStored(document="0f", fleet=FLEET, flags=STAYS)
    (ask,) = of(agreed(agreement.on_stored, event, 100.2), do.AskElectors)
    assert isinstance(ask.question, Prepare)
    assert of(agreed(agreement.on_stored, event, 100.3), do.AskElectors) == [], "it is proposed once"
    assert of(agreed(agreement.on_stored, event, 100.3), do.AnswerCommand) == []


def test_a_document_that_is_fetched_is_not_taken_for_the_one_without_those_flags() -> None:
    """It may be an older one, by which machines that have joined since would be thrown out again."""
    agreement = make(ADOPTED, {"0d": FLEET})
    agreement.orders.end_flags((), ToDo())
    older = ev.DocumentStored(document="0e", fleet=SAID)
    assert of(agreed(agreement.on_stored, older, 100.1), do.AskElectors) == []
    wanted = ev.DocumentStored(document="0f", fleet=FLEET)
    assert len(of(agreed(agreement.on_stored, wanted, 100.2), do.AskElectors)) == 1, "that one is still waited for"


def test_a_state_s_document_brings_its_flags() -> None:
    agreement = make(ADOPTED, {"0d": FLEET}, {"0d": STAYS})
    assert agreement.flags == STAYS
    assert make().flags == ()


def test_a_document_that_is_fetched_brings_its_flags() -> None:
    agreement = make(ADOPTED)
    agreed(agreement.on_stored, ev.DocumentStored(document="0d", fleet=FLEET, flags=STAYS), 100.1)
    assert agreement.flags == STAYS


def test_the_first_document_knows_the_leases_of_the_files_before() -> None:
    """They may be longer, and still run when the document's electors and tasks change."""
    adopted = document_change(FIRST, "0d", FLEET, file_lease_s=9.0).apply(FIRST)
    assert (adopted.lease_s, adopted.guard_lease_s) == (FLEET.timing.lease_s, 9.0)


@pytest.mark.parametrize("electors", [1, 3])
def test_how_a_command_ended_is_told_without_what_to_do(electors: int) -> None:
    """The verbs add that: both together say everything twice."""
    told = [orders._UNCHANGED, *(told_end(outcome, electors)[1] for outcome in RoundOutcome)]
    assert all(told)
    assert [text for text in told if ";" in text or "nothing" in text] == []
