"""Agreement: operators' commands, who is asked and told, what goes to disk."""

from __future__ import annotations

from dataclasses import replace
from random import Random
from typing import TypeVar

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from support.states import state_of
from support.todos import agreed, under
from zsched.core.electorate.founding import founded
from zsched.core.electorate.strangers import SHOWN_S
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat
from zsched.core.values.change import MoveOwner, Retune, SetHold, SetLeased
from zsched.core.values.fleet import Fleet
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import (
    Accept,
    Accepted,
    CommandOutcome,
    CommandResult,
    Learnt,
    Prepare,
    Promise,
    Refusal,
    Refused,
)
from zsched.core.values.model import NO_BALLOT, Acceptance, Allocation, Asked, Pause, RegisterState
from zsched.core.values.todo import ToDo
from zsched.core.vote.agreement import SETTLE_AFTER_START_S, Agreement
from zsched.core.vote.belief import GENERATION_STEP, MAX_AHEAD, MAX_GENERATION
from zsched.core.vote.questions import ASK_AT_ONCE_S, ASK_LEARNT_EVERY_S, READ_EVERY_S

T = TypeVar("T")
ROBOTS = ("robot1", "robot2", "robot3")
FLEET = fleet_of(
    *(task_of(name, ("edge1", "robot2")) for name in ("merge", "plan")),
    of=("edge1", *ROBOTS),
    electors=ROBOTS,
)
ADA = Asked(by="ada@robot1")


def make(*registers: RegisterState, me: str = "robot1", has_state: bool = True, fleet: Fleet = FLEET) -> Agreement:
    state = state_of(me, *registers, hardware="h")
    agreement = Agreement(
        in_force=InForce(fleet),
        me=me,
        durable=state if has_state else None,
        incarnation=7,
        electorate="e",
        rng=Random(1),
        now=100.0,
    )
    for name in ("edge1", *ROBOTS):  # who starts asks all others what they remember of it
        if name != me:
            agreement.witness.on_answer(Learnt(node=name, values=()))
    return agreement


def command(cpu: float = 0.75, *, base: int = 0) -> tuple[str, Retune]:
    """An operator's change of a task's weights."""
    return "merge", Retune(base_revision=base, tuning=tuning_of(cpu, 1.0 - cpu), request=42)


def answer(learnt: Learnt) -> ev.LearntReceived:
    """What a peer says when we ask it."""
    return ev.LearntReceived(learnt=learnt, is_answer=True)


def of(effects: ToDo, kind: type[T]) -> list[T]:
    return [one for one in (*effects.send, *effects.apply) if isinstance(one, kind)]


def told(effects: ToDo) -> CommandResult | None:
    answers = of(effects, do.AnswerCommand)
    assert len(answers) <= 1
    if not answers:
        return None
    assert answers[0].request == 42
    return answers[0].result


def promises(agreement: Agreement, effects: ToDo, *, held: Acceptance | None = None) -> ToDo:
    """A majority promises what was asked."""
    (asked,) = of(effects, do.SendPrepare)
    for elector in ROBOTS[:2]:
        promise = Promise(elector=elector, task=asked.prepare.task, ballot=asked.prepare.ballot, accepted=held)
        effects = agreed(agreement.on_answer, ev.ElectorAnswered(answer=promise), 100.0)
    return effects


def accepts(agreement: Agreement, effects: ToDo) -> ToDo:
    (asked,) = of(effects, do.SendAccept)
    for elector in ROBOTS[:2]:
        accepted = Accepted(elector=elector, task=asked.accept.task, ballot=asked.accept.acceptance.ballot)
        effects = agreed(agreement.on_answer, ev.ElectorAnswered(answer=accepted), 100.0)
    return effects


def run_dry(agreement: Agreement, effects: ToDo) -> CommandResult:
    """Nobody answers any more: time passes until the command has ended."""
    for _ in range(200):
        result = told(effects)
        if result is not None:
            return result
        effects = agreed(agreement.tick, agreement.next_deadline())
    raise AssertionError("the command never ends")


# --- commands --------------------------------------------------------------------------------------------------------


def test_command_that_a_majority_accepts_is_ok_learnt_and_published() -> None:
    agreement = make()
    effects = accepts(agreement, promises(agreement, agreed(agreement.propose, *command(), 100.0)))

    result = told(effects)
    assert result is not None
    assert (result.outcome, result.revision) == (CommandOutcome.OK, 1)
    ((learnt, reason),) = effects.learnt
    assert (learnt.tuning.weights.cpu, learnt.epoch, reason) == (0.75, 0, "retuned by an operator")
    assert effects.must_persist
    assert [one.learnt for one in of(effects, do.PublishLearnt)] == [agreement.learnt()]


def test_command_that_another_change_overtakes_is_a_conflict() -> None:
    agreement = make()
    agreed(agreement.propose, *command(), 100.0)
    result = told(agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(1),))), 100.1))
    assert result is not None
    assert (result.outcome, result.revision) == (CommandOutcome.CONFLICT, 1)


def test_command_without_a_majority_of_promises_ends_as_no_quorum() -> None:
    agreement = make()
    effects = agreed(agreement.propose, *command(), 100.0)
    (asked,) = of(effects, do.SendPrepare)
    promise = Promise(elector="robot1", task="merge", ballot=asked.prepare.ballot)
    effects = agreed(agreement.on_answer, ev.ElectorAnswered(answer=promise), 100.0)
    assert run_dry(agreement, effects).outcome is CommandOutcome.NO_QUORUM


def test_the_only_elector_s_own_vote_that_comes_too_late_is_told_as_overload_and_no_lack_of_others() -> None:
    alone = fleet_of(task_of("merge", ("edge1", "robot2")), of=("edge1", *ROBOTS), electors=ROBOTS[:1])
    for fleet, says in ((FLEET, "no majority of the electors answered"), (alone, "this machine is overloaded")):
        agreement = make(fleet=fleet)
        result = run_dry(agreement, agreed(agreement.propose, *command(), 100.0))
        assert (result.outcome, says in result.detail) == (CommandOutcome.NO_QUORUM, True), result.detail


def test_command_whose_accept_left_and_was_not_answered_ends_as_unknown() -> None:
    agreement = make()
    effects = promises(agreement, agreed(agreement.propose, *command(), 100.0))
    assert of(effects, do.SendAccept)
    assert run_dry(agreement, effects).outcome is CommandOutcome.UNKNOWN


@pytest.mark.parametrize(
    "change",
    [
        MoveOwner(base_revision=0, owner="edge1", reason="moved", request=42),
        Retune(base_revision=0, tuning=tuning_of(bonus=0.3), request=42),
        SetHold(base_revision=0, pause=Pause(asked=ADA, revision=1), pin=None, reason="paused", request=42),
    ],
    ids=["move", "retune", "hold"],
)
def test_a_command_whose_task_leaves_the_fleet_meanwhile_is_answered(change: MoveOwner | Retune | SetHold) -> None:
    agreement = make()
    assert told(agreed(agreement.propose, "merge", change, 100.0)) is None
    result = told(under(agreement, replace(FLEET, tasks=FLEET.tasks[1:]), 100.1))
    assert result == CommandResult(outcome=CommandOutcome.INVALID, detail="merge has left the fleet")


@pytest.mark.parametrize(
    "change", [MoveOwner(base_revision=0, owner="edge1", reason="voted"), SetLeased(base_revision=0, leased=True)]
)
def test_nobody_waits_for_the_end_of_a_change_that_nobody_has_ordered(change: MoveOwner | SetLeased) -> None:
    agreement = make()
    agreed(agreement.propose, "merge", change, 100.0)
    assert told(under(agreement, replace(FLEET, tasks=FLEET.tasks[1:]), 100.1)) is None


def test_answers_of_strangers_are_counted_and_complete_no_majority() -> None:
    agreement = make()
    (asked,) = of(agreed(agreement.propose, *command(), 100.0), do.SendPrepare)
    for name in ("edge1", "ghost", "ghost2"):
        promise = Promise(elector=name, task="merge", ballot=asked.prepare.ballot)
        assert agreed(agreement.on_answer, ev.ElectorAnswered(answer=promise), 100.0) == ToDo()
    assert agreement.counters == {"answer_foreign": 3}


def test_promises_of_another_task_s_value_are_counted_and_complete_no_majority() -> None:
    agreement = make()
    held = Acceptance(ballot=ballot_of(5, "robot3"), value=allocation_of(4, task="plan"))
    assert promises(agreement, agreed(agreement.propose, *command(), 100.0), held=held) == ToDo()
    assert agreement.counters == {"answer_unfit": 2}


# --- asking and telling ----------------------------------------------------------------------------------------------


def beat(node: str, revision: int, *, task: str = "merge") -> Beat:
    return beat_of(node, learnt=((task, revision, revision),))


def test_peer_that_knows_more_is_asked_at_most_every_so_often() -> None:
    agreement = make()
    assert [one.peer for one in of(agreed(agreement.compare, beat("robot2", 1), 100.0), do.AskLearnt)] == ["robot2"]
    assert agreed(agreement.compare, beat("robot2", 2), 100.0 + ASK_LEARNT_EVERY_S - 0.01) == ToDo()
    assert of(agreed(agreement.compare, beat("robot3", 2), 100.0), do.AskLearnt), "the limit is per peer"
    assert of(agreed(agreement.compare, beat("robot2", 2), 100.01 + ASK_LEARNT_EVERY_S), do.AskLearnt)


@pytest.mark.parametrize("heard", [beat("robot2", 3), beat("robot2", 2), beat("robot2", 9, task="other")])
def test_peer_that_knows_no_more_is_not_asked(heard: Beat) -> None:
    agreement = make(RegisterState(task="merge", learnt=allocation_of(3)))
    assert agreed(agreement.compare, heard, 100.0) == ToDo()


def test_only_learnt_values_are_told_never_accepted_ones() -> None:
    held = Acceptance(ballot=ballot_of(5, "robot2"), value=allocation_of(4))
    agreement = make(RegisterState(task="merge", promised=held.ballot, accepted=held, learnt=allocation_of(3)))
    assert agreement.learnt() == Learnt(node="robot1", values=(allocation_of(3),), has_voted=True)
    assert make().learnt().values == (), "the fleet file's tuning is not agreed"


def test_values_of_several_tasks_are_learnt_from_one_message() -> None:
    agreement = make()
    both = Learnt(
        node="robot2", values=(allocation_of(2), allocation_of(5, task="plan"), allocation_of(1, task="gone"))
    )
    effects = agreed(agreement.on_learnt, answer(both), 100.0)
    assert [one.task for one, _ in effects.learnt] == ["merge", "plan"]
    assert {reason for _, reason in effects.learnt} == {None}
    assert agreement.counters == {"learnt_foreign": 1}
    assert agreed(agreement.on_learnt, answer(replace(both, node="robot1")), 100.0) == ToDo(), "our own"
    assert agreed(agreement.on_learnt, answer(replace(both, node="stranger")), 100.0) == ToDo()
    assert agreement.counters == {"learnt_foreign": 2}
    assert agreed(agreement.on_learnt, answer(both), 100.0) == ToDo(), "the same again changes nothing"


def test_two_values_for_one_revision_are_a_problem_that_is_shown() -> None:
    agreement = make(RegisterState(task="merge", learnt=allocation_of(3)))
    assert (
        agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(3, "robot2"),))), 100.0).learnt
        == []
    )
    assert "two values for revision 3" in agreement.problems["register", "merge"]
    assert (
        agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(4, "robot2"),))), 100.1).learnt
        != []
    )
    assert agreement.problems == {}, "agreement goes on"


# --- strangers -------------------------------------------------------------------------------------------------------


def test_what_is_said_unasked_is_not_learnt_but_asked_about() -> None:
    """One put from anybody who can reach the network must not end a task."""
    agreement = make()
    said = Learnt(node="robot2", values=(allocation_of(3),))
    effects = agreed(agreement.on_learnt, ev.LearntReceived(learnt=said), 100.0)
    assert (effects.learnt, effects.must_persist) == ([], False)
    assert [one.peer for one in of(effects, do.AskLearnt)] == ["robot2"]
    assert agreed(agreement.on_learnt, ev.LearntReceived(learnt=said), 100.01) == ToDo(), "it has just been asked"
    assert of(agreed(agreement.on_learnt, ev.LearntReceived(learnt=said), 100.01 + ASK_AT_ONCE_S), do.AskLearnt) != []
    assert agreed(agreement.on_learnt, answer(said), 100.2).learnt != []
    assert agreed(agreement.on_learnt, ev.LearntReceived(learnt=said), 101.0) == ToDo(), "nothing new"


ABSURD = [
    allocation_of(2**52 - 1, "nobody"),
    allocation_of(3, "nobody"),
    allocation_of(3, "edge9"),
    allocation_of(MAX_AHEAD + 4),
    replace(allocation_of(3), epoch=4),
]


@pytest.mark.parametrize("absurd", ABSURD)
def test_an_absurd_answer_is_not_learnt_and_a_majority_is_asked_now_and_then(absurd: Allocation) -> None:
    agreement = make(RegisterState(task="merge", learnt=allocation_of(2)))
    effects = agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(absurd,))), 200.0)
    assert (effects.learnt, effects.must_persist) == ([], False)
    assert [one.prepare.task for one in of(effects, do.SendPrepare)] == ["merge"]
    for number in range(40):  # the identity round ends unanswered
        agreed(agreement.tick, 200.0 + number / 10)
    again = agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(absurd,))), 200.0 + READ_EVERY_S / 2)
    assert again.send == []
    assert agreement.registers["merge"].value == allocation_of(2)
    assert agreement.counters["learnt_unproven"] == 2


def test_an_owner_that_is_no_candidate_any_more_can_be_learnt_and_accepted() -> None:
    """Found by the simulator (seed 8008456): a node that could not learn it had no voice in moving the task away."""
    before = allocation_of(3, "robot3")
    agreement = make(RegisterState(task="merge", learnt=allocation_of(2)))
    effects = agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(before,))), 200.0)
    assert [one for one, _ in effects.learnt] == [before]
    elector = make(RegisterState(task="merge", learnt=allocation_of(2)))
    asked = Accept(
        task="merge",
        acceptance=Acceptance(ballot=ballot_of(5, "robot2"), value=before),
        electorate="e",
    )
    agreed(elector.acceptor.on_accept, ev.AcceptAsked(request=1, asker="robot2", accept=asked), 200.0)
    accepted = elector.registers["merge"].state.accepted
    assert accepted is not None
    assert accepted.value == before


def test_what_no_single_answer_proves_is_learnt_from_a_majority() -> None:
    """A candidate left the fleet file here and owns the task: the electors' own word is enough."""
    held = Acceptance(ballot=ballot_of(5, "robot2"), value=allocation_of(4, "edge9"))
    agreement = make()
    asked = agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(held.value,))), 100.0)
    effects = accepts(agreement, promises(agreement, asked, held=held))
    assert [one for one, _ in effects.learnt] == [held.value]


def test_an_elector_that_learns_by_its_own_round_that_a_task_is_leased_grants_it_as_all_others_do() -> None:
    """Its answer to itself waits for a write, so it learns the value before it has accepted it."""
    before = allocation_of(3, "robot2")
    agreement = make(RegisterState(task="merge", accepted=Acceptance(ballot=ballot_of(), value=before), learnt=before))
    leased = replace(before, revision=4, leased=True)
    (asked,) = of(agreed(agreement.propose, *command(base=3), 101.0), do.SendPrepare)
    ballot, held = asked.prepare.ballot, Acceptance(ballot=ballot_of(3, "robot2"), value=leased)
    for name in ROBOTS[1:]:
        promise = Promise(elector=name, task="merge", ballot=ballot, accepted=held)
        effects = agreed(agreement.on_answer, ev.ElectorAnswered(answer=promise), 101.0)
    (own,) = of(effects, do.SendAccept)
    for name in ROBOTS[1:]:
        yes = Accepted(elector=name, task="merge", ballot=ballot)
        agreed(agreement.on_answer, ev.ElectorAnswered(answer=yes), 101.0)
    assert agreement.values()["merge"] == leased
    accept = ev.AcceptAsked(request=1, asker="robot1", accept=own.accept)
    agreed(agreement.acceptor.on_accept, accept, 101.0)
    heard = beat_of("robot2", 9, learnt=(("merge", 4, 3),))
    agreement.leases.on_beat(heard, agreement.accepted(), 101.1)
    (echo,) = agreement.leases.on_sent(1, 101.1).echoes
    assert (echo.task, echo.owner, echo.number) == ("merge", "robot2", 9)


def test_only_an_elector_s_answer_is_believed_or_one_about_what_was_accepted_here() -> None:
    """edge1 is no elector; if it had committed something, electors would have accepted it."""
    agreement = make()
    said = answer(Learnt(node="edge1", values=(allocation_of(3),)))
    assert agreed(agreement.on_learnt, said, 100.0).learnt == []
    held = Acceptance(ballot=ballot_of(5, "edge1"), value=allocation_of(3))
    agreement = make(RegisterState(task="merge", promised=held.ballot, accepted=held))
    assert [one for one, _ in agreed(agreement.on_learnt, said, 100.0).learnt] == [allocation_of(3)]


def test_a_node_without_a_state_goes_by_the_generation_of_whom_it_asked() -> None:
    agreement = make(has_state=False)
    start = 3 * GENERATION_STEP
    old = answer(Learnt(node="robot2", values=(allocation_of(start + 5),), generation=2))
    assert agreed(agreement.on_learnt, old, 100.0).learnt == []
    new = answer(Learnt(node="robot2", values=(allocation_of(start + 5),), generation=3))
    assert [one for one, _ in agreed(agreement.on_learnt, new, 110.0).learnt] == [allocation_of(start + 5)]


@pytest.mark.parametrize("absurd", ABSURD)
def test_an_absurd_value_is_not_accepted(absurd: Allocation) -> None:
    agreement = make(RegisterState(task="merge", learnt=allocation_of(2)))
    asked = Accept(
        task="merge",
        acceptance=Acceptance(ballot=ballot_of(5, "robot2"), value=absurd),
        electorate="e",
    )
    effects = agreed(agreement.acceptor.on_accept, ev.AcceptAsked(request=1, asker="robot2", accept=asked), 100.0)
    (said,) = of(effects, do.AnswerElection)
    assert isinstance(said.answer, Refused)
    assert said.answer.refusal is Refusal.VALUE
    assert agreement.counters["accept_unfit"] == 1
    assert not effects.must_persist


# --- settling at the start -------------------------------------------------------------------------------------------


def test_starting_elector_asks_what_was_accepted_once_per_task() -> None:
    agreement = make()
    assert agreement.next_deadline() == 100.0 + SETTLE_AFTER_START_S
    assert agreed(agreement.tick, 100.1) == ToDo()
    asked = of(agreed(agreement.tick, 100.0 + SETTLE_AFTER_START_S), do.SendPrepare)
    assert [one.prepare.task for one in asked] == ["merge", "plan"]
    assert agreed(agreement.tick, 100.0 + SETTLE_AFTER_START_S) == ToDo()


def test_starting_elector_learns_what_a_majority_had_accepted() -> None:
    held = Acceptance(ballot=ballot_of(5, "robot2"), value=allocation_of(4))
    agreement = make()
    asked = agreed(agreement.tick, 100.0 + SETTLE_AFTER_START_S)
    merge = ToDo(send=[one for one in of(asked, do.SendPrepare) if one.prepare.task == "merge"])
    effects = accepts(agreement, promises(agreement, merge, held=held))
    assert [one for one, _ in effects.learnt] == [allocation_of(4)]


@pytest.mark.parametrize(("me", "has_state"), [("edge1", True), ("robot1", False)])
def test_who_is_no_elector_does_not_ask_at_its_start(me: str, has_state: bool) -> None:
    agreement = make(me=me, has_state=has_state)
    assert not agreement.is_elector
    assert agreed(agreement.tick, 200.0) == ToDo()


# --- the disk --------------------------------------------------------------------------------------------------------


def test_registers_of_tasks_that_left_the_file_stay_on_disk() -> None:
    """The task may come back: its promises must not be forgotten."""
    gone = RegisterState(task="gone", promised=ballot_of(9, "robot2"), learnt=allocation_of(3))
    agreement = make(gone, RegisterState(task="merge", learnt=allocation_of(2)))
    agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(3),))), 100.0)
    state = agreement.to_persist(100.0)
    assert state is not None
    by_task = {one.task: one for one in state.registers}
    assert sorted(by_task) == ["gone", "merge", "plan"]
    assert by_task["gone"] == gone
    assert by_task["merge"].learnt == allocation_of(3)
    assert (state.incarnation, state.hardware, state.electorate) == (7, "h", "e")


def test_without_a_state_nothing_is_written() -> None:
    agreement = make(has_state=False)
    assert agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(1),))), 100.0).must_persist
    assert agreement.to_persist(100.0) is None


def test_refused_write_ends_the_electorship_and_the_writing() -> None:
    agreement = make()
    agreement.on_persist_failed("disk full")
    assert not agreement.is_elector
    assert agreement.to_persist(100.0) is None
    assert agreement.problems == {("state", ""): "disk full; this node is no elector until it is restarted"}
    ballot = ballot_of(node="robot2")
    effects = agreed(
        agreement.acceptor.on_prepare,
        ev.PrepareAsked(request=1, asker="robot2", prepare=replace(_prepare(agreement), ballot=ballot)),
        100.0,
    )
    assert [one.answer for one in of(effects, do.AnswerElection)] == [
        Refused(
            elector="robot1", task="merge", ballot=ballot, refusal=Refusal.NOT_ELECTOR, promised=NO_BALLOT, number=1
        )
    ]
    assert not effects.must_persist


def _prepare(agreement: Agreement) -> Prepare:
    (sent, *_) = of(
        agreed(agreement.propose, "merge", MoveOwner(base_revision=0, owner="edge1", reason=""), 100.0), do.SendPrepare
    )
    return sent.prepare


# --- moves -----------------------------------------------------------------------------------------------------------


def test_end_of_a_move_is_told_to_the_rounds_and_to_the_journal() -> None:
    agreement = make()
    move = MoveOwner(base_revision=0, owner="edge1", reason="edge1 leads")
    effects = accepts(agreement, promises(agreement, agreed(agreement.propose, "merge", move, 100.0)))
    assert [one.task for one in effects.ended] == ["merge"]
    assert effects.learnt == [(allocation_of(1), "edge1 leads")]
    (story,) = of(effects, do.RecordStory)
    assert story.text == "move to edge1 on revision 0: committed"
    assert told(effects) is None


def test_move_on_an_outdated_revision_ends_as_a_conflict_without_a_message() -> None:
    agreement = make(RegisterState(task="merge", learnt=allocation_of(3)))
    effects = agreed(agreement.propose, "merge", MoveOwner(base_revision=2, owner="edge1", reason=""), 100.0)
    assert [one.task for one in effects.ended] == ["merge"]
    assert (effects.send, [type(one) for one in effects.apply]) == ([], [do.RecordStory])


# --- identity --------------------------------------------------------------------------------------------------------


def test_prepares_of_one_peer_are_rate_limited_and_others_are_not() -> None:
    """Each promise costs an fsync: a broken proposer must not wear out the disk."""
    agreement = make()
    answers = []
    for number in range(60):
        prepare = Prepare(task="merge", ballot=ballot_of(number + 1, "robot2"), electorate="e")
        effects = agreed(
            agreement.acceptor.on_prepare, ev.PrepareAsked(request=number, asker="robot2", prepare=prepare), 100.0
        )
        answers += [i.answer for i in of(effects, do.AnswerElection)]
    refused = [answer for answer in answers if isinstance(answer, Refused)]
    assert len(answers) == 60
    assert len(refused) == agreement.counters["prepare_rate"] == 20
    assert {answer.refusal for answer in refused} == {Refusal.RATE}
    other = Prepare(task="merge", ballot=ballot_of(99, "robot3"), electorate="e")
    (answer,) = of(
        agreed(agreement.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot3", prepare=other), 100.0),
        do.AnswerElection,
    )
    assert isinstance(answer.answer, Promise)
    again = Prepare(task="merge", ballot=ballot_of(100, "robot2"), electorate="e")
    (soon,) = of(
        agreed(agreement.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=again), 100.04),
        do.AnswerElection,
    )
    assert isinstance(soon.answer, Refused), "one is saved in a twentieth of a second"
    (later,) = of(
        agreed(agreement.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=again), 101.0),
        do.AnswerElection,
    )
    assert isinstance(later.answer, Promise)


def test_a_broken_proposer_costs_an_elector_twenty_promises_a_second_and_an_honest_one_waits_for_nothing() -> None:
    """Ten seconds: one asks a hundred times a second, the other nineteen times, far more than back-off ever lets it."""
    for per_s, promised in ((100, range(235, 246)), (19, range(190, 191))):
        agreement, count = make(), 0
        for number in range(10 * per_s):
            ballot = ballot_of(number + 1, "robot2")
            asked = ev.PrepareAsked(
                request=number, asker="robot2", prepare=Prepare(task="merge", ballot=ballot, electorate="e")
            )
            (said,) = of(agreed(agreement.acceptor.on_prepare, asked, 100.0 + number / per_s), do.AnswerElection)
            count += isinstance(said.answer, Promise)
        assert count in promised, per_s


def test_who_has_voted_is_remembered_on_disk_once() -> None:
    agreement = make()
    heard = replace(beat("robot2", 0), has_voted=True)
    assert of(agreed(agreement.compare, heard, 100.0), do.AskLearnt) == [do.AskLearnt(peer="robot2", deadline_s=0.3)]
    assert not agreement.to_persist(100.0).voted, "nothing durable on the word of a beat"  # type: ignore[union-attr]
    said = Learnt(node="robot2", values=(), has_voted=True)
    assert agreed(agreement.on_learnt, answer(said), 100.1).must_persist
    assert not agreed(agreement.on_learnt, answer(said), 100.2).must_persist
    assert agreed(agreement.compare, heard, 200.0) == ToDo(), "nothing to ask"
    assert not agreed(agreement.on_learnt, answer(replace(said, node="edge1")), 100.3).must_persist, "no elector"
    state = agreement.to_persist(100.0)
    assert state is not None
    assert state.voted == ("robot2",)


def test_disputed_name_is_no_elector_in_this_life_and_the_next() -> None:
    agreement = make()
    todo = ToDo()
    agreement.dispute("another daemon calls itself 'robot1'", todo)
    assert todo.must_persist
    assert not agreement.is_elector
    state = agreement.to_persist(100.0)
    assert state is not None
    assert "another daemon" in state.disputed
    again = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=state, incarnation=8, electorate="e", rng=Random(1), now=0.0
    )
    assert not again.is_elector
    assert "--settle" in again.problems["state", ""]


def test_a_state_that_was_brought_back_says_so_in_this_life_and_the_next() -> None:
    state = make().to_persist(100.0)
    assert state is not None
    lost = replace(state, lost="peers remember 9 votes, here are 3")
    again = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=lost, incarnation=8, electorate="e", rng=Random(1), now=0.0
    )
    assert not again.is_elector
    assert again.problems["state", ""].startswith(
        "peers remember 9 votes, here are 3: it was brought back from a backup"
    )
    assert "zsched fleet recover --help" in again.problems["state", ""]
    kept = again.to_persist(100.0)
    assert kept is not None
    assert kept.lost == lost.lost
    value = replace(founded(FLEET.name, 0, FLEET.electors), document="0d", revision=3)
    agreed = replace(lost, fleet_register=RegisterState(task=FLEET.name, learnt=value))
    other = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=agreed, incarnation=8, electorate="e", rng=Random(1), now=0.0
    )
    assert other.problems["state", ""].endswith("which `electorate: auto` does by itself once its old seat is given up")


def test_another_generation_teaches_nothing_and_is_shown_until_it_is_gone() -> None:
    agreement = make()
    told_by = Learnt(node="robot2", values=(allocation_of(2**32, None),), generation=1)
    assert agreed(agreement.on_learnt, answer(told_by), 100.0) == ToDo()
    assert agreement.registers["merge"].value.revision == 0
    assert "generation 1" in agreement.problems["generation", "robot2"]
    agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(3),))), 100.0)
    assert ("generation", "robot2") not in agreement.problems
    assert agreement.registers["merge"].value.revision == 3


def test_another_generation_is_shown_until_it_is_silent_or_out_of_the_file() -> None:
    agreement = make()
    other = answer(Learnt(node="edge1", values=(), generation=1))
    agreed(agreement.on_learnt, other, 100.0)
    agreement.forget(100.0 + SHOWN_S - 0.1)
    assert ("generation", "edge1") in agreement.problems
    agreement.forget(100.0 + SHOWN_S)
    assert agreement.problems == {}
    agreed(agreement.on_learnt, other, 200.0)
    assert ("generation", "edge1") in agreement.problems
    under(agreement, fleet_of(task_of("merge", ("robot2",)), of=ROBOTS, electors=ROBOTS), 200.1)
    assert agreement.problems == {}


def test_generations_refuse_each_others_ballots() -> None:
    agreement = make()
    stranger = Prepare(task="merge", ballot=ballot_of(node="robot2"), electorate="e/1")
    (said,) = of(
        agreed(agreement.acceptor.on_prepare, ev.PrepareAsked(request=1, asker="robot2", prepare=stranger), 0.0),
        do.AnswerElection,
    )
    assert isinstance(said.answer, Refused)
    assert said.answer.refusal is Refusal.ELECTORATE


def test_node_without_state_believes_whatever_generation_it_is_told() -> None:
    agreement = make(has_state=False)
    agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(2**32 + 1),), generation=1)), 100.0)
    assert agreement.registers["merge"].value.revision == 2**32 + 1


@pytest.mark.parametrize(
    ("said", "follows"),
    [
        (Learnt(node="robot2", values=(), generation=3, incarnation=5), True),
        (Learnt(node="robot2", values=(), generation=3, incarnation=1), True),
        (Learnt(node="robot2", values=(), generation=3, has_voted=True), True),
        (Learnt(node="robot2", values=(), generation=3), False),  # it keeps no state and goes by what it heard itself
        (Learnt(node="edge1", values=(), generation=3, incarnation=5, has_voted=True), False),
        (Learnt(node="robot2", values=(), generation=MAX_GENERATION, incarnation=5), True),
        (Learnt(node="robot2", values=(), generation=MAX_GENERATION + 1, incarnation=5), False),
    ],
)
def test_a_node_without_a_state_follows_an_elector_that_keeps_one(said: Learnt, *, follows: bool) -> None:
    agreement = make(me="edge2", has_state=False)
    agreed(agreement.on_learnt, answer(said), 100.0)
    assert agreement.generation == (said.generation if follows else None)
    unasked = make(me="edge2", has_state=False)
    agreed(unasked.on_learnt, ev.LearntReceived(learnt=said), 100.0)
    assert unasked.generation is None, "whatever is said unasked is no answer"


def test_a_node_without_a_state_goes_to_a_newer_generation_only_and_forgets_what_it_saw_of_the_older() -> None:
    agreement = make(me="edge2", has_state=False)

    def hear(generation: int, votes: int) -> tuple[int | None, dict[str, tuple[int, int]]]:
        said = Learnt(node="robot2", values=(), generation=generation, incarnation=5, votes=votes)
        agreed(agreement.on_learnt, answer(said), 100.0)
        return agreement.generation, {name: seen for name, seen in agreement.witness.seen.items() if seen != (0, 0)}

    assert hear(3, 8) == (3, {"robot2": (5, 8)})
    assert hear(3, 7) == (3, {"robot2": (5, 8)}), "nothing is forgotten within one"
    assert hear(2, 9) == (3, {"robot2": (5, 8)})
    assert hear(4, 2) == (4, {"robot2": (5, 2)})


def test_a_node_with_a_state_follows_nobody() -> None:
    agreement = make()
    agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(), generation=3, incarnation=5)), 100.0)
    assert agreement.generation == 0
    assert "generation 3" in agreement.problems["generation", "robot2"]


def test_revision_that_nothing_could_follow_is_refused_and_shown() -> None:
    agreement = make()
    agreed(agreement.on_learnt, answer(Learnt(node="robot2", values=(allocation_of(2**53 - 1),))), 100.0)
    assert agreement.registers["merge"].value.revision == 0
    assert agreement.counters["learnt_unproven"] == 1
