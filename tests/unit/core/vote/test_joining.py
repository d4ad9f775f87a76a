"""Questions of several registers in one frame: the answers are those that each would get alone, after one write."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleet_values import fleet_value_of
from support.fleets import fleet_of, task_of
from support.states import state_of
from support.todos import agreed
from zsched.core.electorate.changes import AddElector, AdoptDocument
from zsched.core.electorate.founding import founded
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.electorate import Elector, FleetValue
from zsched.core.values.in_force import InForce
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
from zsched.core.values.todo import ToDo
from zsched.core.vote.acceptor import PREPARE_BURST
from zsched.core.vote.agreement import Agreement
from zsched.core.vote.joining import joined
from zsched.core.vote.questions import ASK_LEARNT_EVERY_S, VOTES_WAIT_S

ROBOTS = ("robot1", "robot2", "robot3")
TASKS = ("guard", "merge", "plan")
FLEET = fleet_of(
    *(task_of(name, ROBOTS, exclusive=name == "guard") for name in TASKS),
    of=ROBOTS,
    electors=ROBOTS,
)


def elector(*registers: RegisterState) -> Agreement:
    agreement = Agreement(
        in_force=InForce(FLEET),
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
            todo = agreed(agreement.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=one), 100.0)
        else:
            todo = agreed(agreement.acceptor.on_accept, ev.AcceptAsked(request=1, asker="robot2", accept=one), 100.0)
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
    assert not one.acceptor.has_parked
    assert alone(one, [question]) == []
    assert one.acceptor.has_parked


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
    value = fleet_value_of(2, Elector(name="robot1"), number=2, fleet="lab", generation_id="aa")
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


# --- with the fleet value that brought the number --------------------------------------------------------------------

FIRST = founded(FLEET.name, 0, ROBOTS)
AGREED = replace(
    AdoptDocument(base_revision=1, document="0d", tasks=tuple((name, False) for name in TASKS), lease_s=1.0).apply(
        FIRST
    ),
    settled=True,
)
CHANGED = AddElector(base_revision=2, name="edge1", disk="ed").apply(AGREED)


def elector_of_a_change(*, has_accepted: bool = True) -> Agreement:
    """It goes by `AGREED`; ``has_accepted``: a proposer has asked it to accept `CHANGED`."""
    held = RegisterState(task=FLEET.name, learnt=AGREED)
    if has_accepted:
        held = replace(held, accepted=Acceptance(ballot=ballot_of(4, "robot2"), value=CHANGED))
    agreement = Agreement(
        in_force=InForce(FLEET),
        me="robot1",
        durable=replace(state_of("robot1"), disk="d1", fleet_register=held),
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
        stored={"0d": FLEET},
    )
    for name in ROBOTS[1:]:
        agreement.witness.on_answer(Learnt(node=name, values=()))
    return agreement


def test_names_that_are_no_node_s_take_no_memory() -> None:
    """Each left what it may ask for how often, for ever; a node's own questions are counted as before."""
    one = elector_of_a_change()
    for number in range(1000):
        ask(one, prepare(TASKS[0], node=f"x{number}"), asker=f"x{number}")
    assert one.acceptor._buckets == {}
    assert one.counters["prepare_foreign"] == 1000
    ask(one, prepare(TASKS[0]))
    assert list(one.acceptor._buckets) == ["robot2"]


def settling(fleet: FleetValue | None = CHANGED) -> ev.BallotsAsked:
    """The first frame with which the proposer of `CHANGED` settles it."""
    asked = [
        replace(prepare(name), generation_id=CHANGED.generation_id, number=CHANGED.number)
        for name in (*TASKS, FLEET.name)
    ]
    ballots = Ballots(prepares=tuple(asked[:-1]), ahead=asked[-1], fleet=fleet)
    return ev.BallotsAsked(request=9, asker="robot2", ballots=ballots)


def test_who_has_accepted_the_fleet_value_that_comes_along_learns_it_and_answers_after_one_write() -> None:
    one = elector_of_a_change()
    todo = agreed(one.on_ballots, settling(), 100.0)
    told = votes(todo)
    assert [it.task for it in told.promises] == list(TASKS)
    assert told.ahead is not None
    assert isinstance(told.ahead.content, Promise)
    assert told.refused == ()
    assert todo.must_persist
    written = one.to_persist(100.0)
    assert written is not None
    assert written.fleet_register is not None
    assert written.fleet_register.learnt == CHANGED, "on disk before the first answer under it"
    promised = [state.promised for state in written.registers] + [written.fleet_register.promised]
    assert set(promised) == {ballot_of(5, "robot2")}
    assert one.witness.votes == len(TASKS) + 1


FOREIGN_VALUES = [
    replace(CHANGED, settled=True),
    replace(CHANGED, revision=CHANGED.revision + 1),
    replace(CHANGED, electors=CHANGED.electors[:1]),
    replace(CHANGED, lease_s=0.9),
]


@pytest.mark.parametrize(("has_accepted", "told"), [(False, CHANGED), *((True, value) for value in FOREIGN_VALUES)])
def test_a_fleet_value_that_this_elector_has_not_accepted_is_asked_for_and_not_learnt(
    has_accepted: bool, told: FleetValue
) -> None:
    """Anybody who can reach the network could have said it."""
    one = elector_of_a_change(has_accepted=has_accepted)
    todo = agreed(one.on_ballots, settling(told), 100.0)
    (answered,) = [it for it in todo.send if isinstance(it, do.AnswerBallots)]
    assert {it.refusal for it in answered.votes.refused} == {Refusal.NUMBER}
    assert not answered.votes.promises
    assert one.fleet_value == AGREED
    assert [it.peer for it in todo.send if isinstance(it, do.AskLearnt)] == ["robot2"], "once, for all questions"


def asked_along_with(agreement: Agreement, fleet: FleetValue) -> ToDo:
    """Questions under the number of `AGREED`, and a fleet value with them."""
    prepares = tuple(replace(prepare(name), generation_id=AGREED.generation_id, number=AGREED.number) for name in TASKS)
    ballots = Ballots(prepares=prepares, fleet=fleet)
    return agreed(agreement.on_ballots, ev.BallotsAsked(request=9, asker="robot2", ballots=ballots), 100.0)


@pytest.mark.parametrize(
    ("told", "is_asked"),
    [
        (CHANGED, True),
        (AGREED, False),
        (replace(CHANGED, generation_id="77"), False),
        (replace(CHANGED, fleet="other"), False),
    ],
    ids=["news", "known", "another generation's", "another fleet's"],
)
def test_only_a_newer_fleet_value_of_the_own_generation_is_asked_for(told: FleetValue, *, is_asked: bool) -> None:
    todo = asked_along_with(elector_of_a_change(has_accepted=False), told)
    assert any(isinstance(it, do.AskLearnt) for it in todo.send) is is_asked


def test_a_node_that_knows_no_generation_asks_nobody_for_a_fleet_value() -> None:
    blank = Agreement(
        in_force=InForce(FLEET),
        me="robot1",
        durable=None,
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
        stored={},
    )
    assert not any(isinstance(it, do.AskLearnt) for it in asked_along_with(blank, CHANGED).send)


def test_the_word_of_a_change_is_proof_only_to_who_has_accepted_it() -> None:
    said = ev.LearntReceived(learnt=Learnt(node="robot3", values=(), fleet=CHANGED))
    one = elector_of_a_change()
    todo = agreed(one.on_learnt, said, 100.0)
    assert (one.fleet_value, todo.must_persist, todo.send) == (CHANGED, True, [])
    other = elector_of_a_change(has_accepted=False)
    todo = agreed(other.on_learnt, said, 100.0)
    assert (other.fleet_value, todo.must_persist) == (AGREED, False)
    assert todo.send == [do.AskLearnt(peer="robot3", deadline_s=FLEET.timing.ballot_s)]


def test_one_peer_is_asked_for_a_fleet_value_and_another_one_when_it_does_not_answer() -> None:
    one = elector_of_a_change(has_accepted=False)
    for now, asked in ((100.0, ["robot2"]), (100.2, []), (100.01 + ASK_LEARNT_EVERY_S, ["robot2", "robot3"])):
        found: list[str] = []
        for name in ("robot2", "robot3"):
            heard = beat_of(name, fleet_revision=CHANGED.revision, number=CHANGED.number)
            todo = agreed(one.compare, heard, now)
            found += [it.peer for it in todo.send if isinstance(it, do.AskLearnt)]
        assert found == asked


def test_forged_beats_do_not_keep_a_node_from_asking_for_a_fleet_value() -> None:
    """A stranger tells of some revision in a silent peer's name, again and again."""
    one, asked = elector_of_a_change(has_accepted=False), []
    for step in range(10):
        for name, revision in (("robot3", CHANGED.revision + 1 + step), ("robot2", CHANGED.revision)):
            heard = beat_of(name, fleet_revision=revision, number=CHANGED.number)
            todo = agreed(one.compare, heard, 100.0 + 0.2 * step)
            asked += [it.peer for it in todo.send if isinstance(it, do.AskLearnt)]
    assert asked.count("robot2") >= 3


def test_forged_words_of_two_revisions_do_not_keep_a_node_from_asking_either() -> None:
    """In a silent peer's name, by turns: each revision holds others up once, whatever was told in between."""
    one, asked = elector_of_a_change(has_accepted=False), []
    for step in range(10):
        for revision, at in ((CHANGED.revision + 1, 0.0), (CHANGED.revision, 0.06)):
            word = Learnt(node="robot3", values=(), fleet=replace(CHANGED, revision=revision))
            agreed(one.on_learnt, ev.LearntReceived(learnt=word), 100.0 + 0.2 * step + at)
        heard = beat_of("robot2", fleet_revision=CHANGED.revision, number=CHANGED.number)
        todo = agreed(one.compare, heard, 100.1 + 0.2 * step)
        asked += [it.peer for it in todo.send if isinstance(it, do.AskLearnt)]
    assert asked.count("robot2") >= 3


def test_while_the_electors_change_they_are_not_asked_how_often_they_have_voted_but_not_for_long() -> None:
    one = elector_of_a_change()
    agreed(one.on_ballots, settling(), 100.0)
    heard = beat_of("robot2", votes=7, fleet_revision=CHANGED.revision, number=CHANGED.number)
    assert agreed(one.compare, heard, 100.1).send == []
    assert agreed(one.compare, heard, 100.1 + VOTES_WAIT_S).send != []
    one.witness._answered.discard("robot3")
    heard = beat_of("robot3", fleet_revision=CHANGED.revision, number=CHANGED.number)
    assert agreed(one.compare, heard, 100.2).send != [], "it has just started, and has to know"


def test_beats_of_two_numbers_do_not_keep_a_node_from_asking_how_often_others_have_voted() -> None:
    """Who is behind may hear others that are, and others that are not; or a stranger's beats between the real ones."""
    one, asked = elector_of_a_change(), []
    agreed(one.on_ballots, settling(), 100.0)
    for step in range(10):
        now = 100.0 + 0.4 * step
        for name, number, votes in (("robot2", CHANGED.number, 7 + step), ("robot3", CHANGED.number + 1 + step % 3, 9)):
            heard = beat_of(name, votes=votes, fleet_revision=CHANGED.revision, number=number)
            todo = agreed(one.compare, heard, now)
            asked += [(it.peer, step) for it in todo.send if isinstance(it, do.AskLearnt)]
    assert {step for name, step in asked if name == "robot2"} >= set(range(3, 10)), "each time that it has voted"


def test_the_word_goes_behind_the_questions_that_bring_the_fleet_value() -> None:
    word = do.PublishLearnt(learnt=Learnt(node="robot2", values=()))
    first = Prepare(task=FLEET.name, ballot=ballot_of(5, "robot2"), electorate="e")
    ahead = do.AskElectors(to=ROBOTS, question=first, deadline_s=0.2, may_join=True)
    batch: list[do.Instruction] = [word, sent("guard"), ahead]
    ballots = Ballots(prepares=(prepare("guard"),), ahead=first, fleet=CHANGED)
    assert joined(batch, CHANGED) == [do.SendBallots(ballots=ballots, deadline_s=0.2), word]
    assert joined([word, ahead], CHANGED) == [
        do.SendBallots(ballots=Ballots(ahead=first, fleet=CHANGED), deadline_s=0.2),
        word,
    ], "a fleet without a task"
    accepts: list[do.Instruction] = [do.SendAccept(accept=accept("merge"), deadline_s=0.3, may_join=True)]
    assert joined(accepts, CHANGED) == accepts, "who has promised knows it"
    assert joined([sent("guard", may_join=False)], CHANGED) == [sent("guard", may_join=False)]


def test_only_the_first_of_many_frames_brings_it() -> None:
    frames = joined([sent(f"task{number:02}") for number in range(MOST_BALLOTS + 2)], CHANGED)
    assert [it.ballots.fleet for it in frames if isinstance(it, do.SendBallots)] == [CHANGED, None]
