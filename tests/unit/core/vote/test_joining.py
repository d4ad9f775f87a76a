"""Questions of several registers in one frame: the answers are those that each would get alone, after one write."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import fleet_of, tuning_of
from support.states import state_of
from support.todos import agreed
from zsched.core import events as ev
from zsched.core import instructions as do
from zsched.core.todo import ToDo
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.fleet import TaskSpec
from zsched.core.values.messages import (
    MOST_BALLOTS,
    Accept,
    Accepted,
    Ballots,
    Learnt,
    Prepare,
    Promise,
    Refusal,
    Refused,
    Votes,
    votes_of,
)
from zsched.core.values.model import Acceptance, RegisterState
from zsched.core.vote.agreement import PREPARE_BURST, Agreement
from zsched.core.vote.joining import joined

ROBOTS = ("robot1", "robot2", "robot3")
TASKS = ("guard", "merge", "plan")
FLEET = fleet_of(
    *(TaskSpec(name=name, candidates=ROBOTS, tuning=tuning_of(), exclusive=name == "guard") for name in TASKS),
    of=ROBOTS,
    electors=ROBOTS,
)


def elector(*registers: RegisterState) -> Agreement:
    agreement = Agreement(
        fleet=FLEET,
        me="robot1",
        durable=state_of("robot1", *registers),
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
    )
    for name in ROBOTS[1:]:
        agreement.witness.on_answer(Learnt(node=name, values=()))
    return agreement


def prepare(task: str, counter: int = 5, node: str = "robot2") -> Prepare:
    return Prepare(task=task, ballot=ballot_of(counter, node), electorate="e")


def accept(task: str, counter: int = 5, owner: str = "robot3", revision: int = 1) -> Accept:
    held = Acceptance(ballot=ballot_of(counter, "robot2"), value=allocation_of(revision, owner, task=task))
    return Accept(task=task, acceptance=held, electorate="e")


def ask(agreement: Agreement, *questions: Prepare | Accept, asker: str = "robot2", now: float = 100.0) -> ToDo:
    ballots = Ballots(
        prepares=tuple(one for one in questions if isinstance(one, Prepare)),
        accepts=tuple(one for one in questions if isinstance(one, Accept)),
    )
    return agreed(agreement.on_ballots, ev.BallotsAsked(request=9, asker=asker, ballots=ballots), now)


def votes(todo: ToDo) -> Votes:
    (answered,) = todo.send
    assert isinstance(answered, do.AnswerBallots)
    assert answered.request == 9
    return answered.votes


def alone(agreement: Agreement, questions: Iterable[Prepare | Accept]) -> list[Promise | Accepted | Refused]:
    """What the same elector answers to each question in a frame of its own."""
    found: list[Promise | Accepted | Refused] = []
    for one in questions:
        if isinstance(one, Prepare):
            todo = agreed(agreement.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=one), 100.0)
        else:
            todo = agreed(agreement.on_accept, ev.AcceptAsked(request=1, asker="robot2", accept=one), 100.0)
        found += [sent.answer for sent in todo.send if isinstance(sent, do.AnswerElection)]
    return found


# --- the elector -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "questions",
    [
        (prepare("merge"), prepare("plan")),
        (prepare("merge"), prepare("plan", 1)),
        (prepare("merge"), accept("plan")),
        (accept("merge"), accept("plan", 1)),
        (prepare("merge"), replace(prepare("plan"), electorate="other")),
        (prepare("merge"), replace(prepare("plan"), number=4, generation_id="ab")),
        (prepare("merge"), prepare("plan", node="robot3"), prepare("nosuch"), accept("merge", owner="ghost")),
    ],
)
def test_each_question_gets_the_answer_that_it_would_get_alone(questions: tuple[Prepare | Accept, ...]) -> None:
    known = RegisterState(task="plan", promised=ballot_of(3, "robot3"))
    one = elector(known)
    todo = ask(one, *questions)
    kinds = (Promise, Accepted, Refused)
    assert list(votes(todo).answers) == sorted(alone(elector(known), questions), key=lambda it: kinds.index(type(it)))
    assert todo.must_persist
    written = one.to_persist(100.0)
    assert written is not None
    promised = {state.task for state in written.registers if state.promised >= ballot_of(5, "robot2")}
    yes = {it.task for it in votes(todo).answers if not isinstance(it, Refused)}
    assert yes <= promised, "one write holds every promise before the one frame of answers leaves"
    assert one.witness.votes == len(votes(todo).promises) + len(votes(todo).accepted)


def test_questions_that_get_no_answer_alone_get_none_together() -> None:
    """Another's ballots, and a task that is in no file: no frame at all leaves."""
    one = elector()
    assert ask(one, prepare("merge", node="robot3"), prepare("nosuch")).send == []
    assert ask(one, prepare("merge"), accept("plan"), asker="ghost").send == []
    assert one.counters["prepare_foreign"] == 3
    assert one.counters["accept_foreign"] == 1


def test_an_accept_that_would_wait_for_a_lease_is_refused_at_once_and_waits_when_it_comes_alone() -> None:
    """The others of its frame must not wait for it, and a question has one answer."""
    held = RegisterState(task="guard", learnt=replace(allocation_of(3, "robot2", task="guard"), leased=True))
    question = accept("guard", revision=4)
    one = elector(held)
    told = votes(ask(one, question, accept("merge")))
    assert [it.task for it in told.accepted] == ["merge"]
    assert [(it.task, it.refusal) for it in told.refused] == [("guard", Refusal.LEASE)]
    assert not one.has_parked
    assert alone(one, [question]) == []
    assert one.has_parked


def test_a_frame_counts_as_one_question_at_the_rate() -> None:
    """It costs one write."""
    one = elector()
    for counter in range(1, int(PREPARE_BURST) + 1):
        told = votes(ask(one, prepare("merge", counter), prepare("plan", counter)))
        assert len(told.promises) == 2
    told = votes(ask(one, prepare("merge", 99), prepare("plan", 99)))
    assert [it.refusal for it in told.refused] == [Refusal.RATE] * 2
    assert one.counters["prepare_rate"] == 2


def test_the_newest_fleet_value_goes_along_once() -> None:
    value = FleetValue(
        fleet="lab",
        generation_id="aa",
        revision=2,
        number=2,
        electors=(Elector(name="robot1"),),
        settled=True,
        lease_s=1.0,
        guard_lease_s=1.0,
    )
    no = Refused(
        elector="robot1",
        task="merge",
        ballot=ballot_of(5, "robot2"),
        refusal=Refusal.NUMBER,
        promised=ballot_of(1, "robot1"),
        number=2,
        fleet=value,
    )
    told = votes_of((no, replace(no, task="plan"), replace(no, task="guard")))
    assert [one.fleet for one in told.refused] == [value, None, None]


# --- the proposer ----------------------------------------------------------------------------------------------------


def sent(task: str, *, may_join: bool = True) -> do.SendPrepare:
    return do.SendPrepare(prepare=prepare(task), deadline_s=0.3, may_join=may_join)


def test_what_may_join_goes_in_one_frame_where_the_first_stood() -> None:
    other, own = do.AskLearnt(peer="robot2", deadline_s=0.3), sent("plan", may_join=False)
    batch: list[do.Instruction] = [
        other,
        sent("guard"),
        own,
        do.SendAccept(accept=accept("merge"), deadline_s=0.3, may_join=True),
    ]
    together = do.SendBallots(ballots=Ballots(prepares=(prepare("guard"),), accepts=(accept("merge"),)), deadline_s=0.3)
    assert joined(batch) == [other, together, own]
    assert joined([other, sent("guard"), own]) == [other, sent("guard"), own], "one alone stays as it is"


def test_many_go_in_frames_of_a_bounded_size() -> None:
    names = [f"task{number:02}" for number in range(2 * MOST_BALLOTS + 1)]
    frames = joined([sent(name) for name in names])
    asked = [
        [part.prepare.task for part in frame.parts if isinstance(part, do.SendPrepare)]
        if isinstance(frame, do.SendBallots)
        else [frame.prepare.task]
        for frame in frames
        if isinstance(frame, do.SendBallots | do.SendPrepare)
    ]
    assert [len(part) for part in asked] == [MOST_BALLOTS, MOST_BALLOTS, 1]
    assert [name for part in asked for name in part] == names


def test_what_had_no_success_together_is_asked_alone() -> None:
    """An elector of an older version reads no such frame."""
    one = elector()
    register = one.registers["merge"]
    (first,) = agreed(register.settle, 100.0).send
    assert isinstance(first, do.SendPrepare)
    assert first.may_join
    now = 100.0
    while True:
        now = max(register.next_deadline(), now)
        again = agreed(register.tick, now).send
        if again:
            break
    assert [one.may_join for one in again if isinstance(one, do.SendPrepare)] == [False]


@pytest.mark.parametrize("count", [0, MOST_BALLOTS + 1])
def test_a_frame_of_nothing_or_of_too_much_is_none(count: int) -> None:
    with pytest.raises(ValueError, match=rf"ballots: expected 1 to {MOST_BALLOTS}, not {count}"):
        Ballots(prepares=(prepare("merge"),) * count)


def test_the_answers_of_two_electors_are_no_frame() -> None:
    yes = Promise(elector="robot1", task="merge", ballot=ballot_of(5, "robot2"))
    with pytest.raises(ValueError, match="one elector"):
        Votes(promises=(yes, replace(yes, elector="robot2")))
