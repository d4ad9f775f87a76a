"""The proposing side of `zsched.core.register.register`: rounds, conflicts, unknown outcomes, one case at a time."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.registers import (
    BALLOT_S,
    BLANK,
    ELECTORS,
    FIRST,
    INITIAL,
    TUNING,
    Step,
    accept,
    accept_all,
    accepted,
    allocation,
    ballot,
    commit,
    did,
    last,
    make,
    prepare,
    promise_all,
    promised,
)
from zsched.config.timing import PROFILES
from zsched.core.register.register import MAX_QUEUED, MAX_REVISION
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import MoveOwner, Retune, RoundOutcome
from zsched.core.values.electorate import Elector, Electorate
from zsched.core.values.fleet import Timing
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import Acceptance, Allocation

# --- proposer --------------------------------------------------------------------------------------------------------


def test_minority_does_not_commit() -> None:
    electors = tuple(f"r{i}" for i in range(1, 6))
    registers = [make(name, electors=electors) for name in electors]
    asked = promise_all(registers[0], did(registers[0].propose, FIRST, 0.0), registers[:3])
    assert accept_all(registers[0], asked, registers[:2]) == Step()
    assert registers[0].value == INITIAL


def test_one_elector_counts_once_and_a_stranger_never() -> None:
    proposer, other = make("r1"), make("r2")
    asked = did(proposer.propose, FIRST, 0.0).prepare
    assert asked is not None
    _, promise = promised(other, asked)
    assert did(proposer.on_answer, promise, 0.0) == Step()
    assert did(proposer.on_answer, promise, 0.0) == Step()
    stranger = Promise(elector="e1", task="merge", ballot=asked.ballot)
    assert did(proposer.on_answer, stranger, 0.0) == Step()
    for name in ("e1", "e2"):
        no = Refused(elector=name, task="merge", ballot=asked.ballot, refusal=Refusal.NUMBER, promised=asked.ballot)
        did(proposer.on_answer, no, 0.0)
    assert did(proposer.on_answer, promised(make("r3"), asked)[1], 0.0).accept is not None, "nor did their noes"


@pytest.mark.parametrize(
    "value",
    [allocation_of(1, task="plan"), allocation(MAX_REVISION + 1), allocation_of(1, epoch=MAX_REVISION + 1)],
    ids=["another task's", "no later revision", "no later epoch"],
)
def test_a_promise_of_what_no_elector_accepts_leaves_the_round_as_it_was(value: Allocation) -> None:
    """A question about such a value, or the next one after it, cannot even be made."""
    proposer, other = make("r1"), make("r2")
    step = did(proposer.propose, FIRST, 0.0)
    assert step.prepare is not None
    for name in ("r2", "r3"):
        held = Acceptance(ballot=ballot(1), value=value)
        forged = Promise(elector=name, task="merge", ballot=step.prepare.ballot, accepted=held)
        assert did(proposer.on_answer, forged, 0.0) == Step()
    assert commit(proposer, step, [proposer, other]).finished == (FIRST, RoundOutcome.COMMITTED)


def test_a_promise_of_the_last_revision_that_can_be_counts() -> None:
    proposer = make("r1")
    asked = did(proposer.settle, 0.0).prepare
    assert asked is not None
    held = Acceptance(ballot=ballot(1), value=allocation(MAX_REVISION))
    answers = [Promise(elector=name, task="merge", ballot=asked.ballot, accepted=held) for name in ("r2", "r3")]
    read = last(did(proposer.on_answer, one, 0.0) for one in answers)
    assert read.accept is not None
    assert read.accept.acceptance.value == held.value


def test_answers_to_an_older_ballot_change_nothing() -> None:
    proposer, others = make("r1"), (make("r2"), make("r3"))
    old = did(proposer.propose, FIRST, 0.0).prepare
    assert old is not None
    late = [promised(other, old)[1] for other in others]
    overtake(proposer, others, old)
    again = did(proposer.tick, proposer.next_deadline()).prepare
    assert again is not None
    assert again.ballot > old.ballot
    assert [did(proposer.on_answer, one, 1.0) for one in late] == [Step(), Step()]


def test_a_proposer_that_waits_for_slow_disks_keeps_its_ballot() -> None:
    """Who wrote its answer too late for the first question has it when the same one comes again."""
    proposer, others = make("r1"), (make("r2"), make("r3"))
    asked = did(proposer.propose, FIRST, 0.0)
    assert asked.prepare is not None
    for other in others:
        promised(other, asked.prepare)  # heard by nobody
    again = did(proposer.tick, BALLOT_S)
    assert again.prepare == asked.prepare
    answers = [promised(other, again.prepare) for other in others]
    assert not any(step.is_dirty for step, _ in answers)
    assert last(did(proposer.on_answer, answer, BALLOT_S) for _, answer in answers).accept is not None


def test_one_elector_that_has_promised_more_is_asked_above_that_although_another_is_dead() -> None:
    proposer, other = make("r1"), make("r2")
    promised(other, prepare(9))
    asked = did(proposer.propose, FIRST, 0.0)
    assert asked.prepare is not None
    promised(proposer, asked.prepare)
    did(proposer.on_answer, promised(other, asked.prepare)[1], 0.0)
    did(proposer.tick, BALLOT_S)
    again = did(proposer.tick, proposer.next_deadline())
    assert again.prepare is not None
    assert again.prepare.ballot.counter > 9


def test_what_a_proposer_s_own_loop_stands_still_is_not_taken_from_its_change() -> None:
    proposer = make("r1")
    did(proposer.propose, FIRST, 0.0)
    assert did(proposer.tick, 20 * BALLOT_S).prepare is not None
    end = 20 * BALLOT_S
    while did(proposer.tick, proposer.next_deadline()).finished is None:
        end = proposer.next_deadline()
    assert end > 24 * BALLOT_S


def test_move_raises_epoch_and_revision_retune_only_the_revision() -> None:
    moved = FIRST.apply(INITIAL)
    assert moved == replace(INITIAL, revision=1, epoch=1, owner="e1")
    tuning = replace(TUNING, bonus=0.3)
    assert Retune(base_revision=1, tuning=tuning).apply(moved) == replace(moved, revision=2, tuning=tuning)


@pytest.mark.parametrize(("newer", "older"), [(1, 5), (5, 1)], ids=["lower revision", "higher revision"])
@pytest.mark.parametrize("first", ["r2", "r3"])
def test_newer_among_accepted_means_the_higher_ballot_whatever_the_revisions(
    newer: int, older: int, first: str
) -> None:
    proposer = make("r1")
    asked = did(proposer.settle, 0.0).prepare
    assert asked is not None
    held_by = {
        "r2": Acceptance(ballot=ballot(9), value=allocation(newer)),
        "r3": Acceptance(ballot=ballot(2), value=allocation(older)),
    }
    accepted = dict(sorted(held_by.items(), reverse=first == "r3"))
    step = last(
        did(proposer.on_answer, Promise(elector=name, task="merge", ballot=asked.ballot, accepted=held), 0.0)
        for name, held in accepted.items()
    )
    assert step.accept is not None
    assert step.accept.acceptance == Acceptance(ballot=asked.ballot, value=allocation(newer))


def test_unlearnt_value_is_settled_first_and_our_outdated_change_ends_as_conflict() -> None:
    electors = [make(name) for name in ELECTORS]
    accepted(electors[2], accept(1, allocation(1, "e2"), "r0"), 0.0)
    asked = promise_all(electors[0], did(electors[0].propose, FIRST, 0.0), electors[1:])
    assert asked.accept is not None
    assert asked.accept.acceptance.value == allocation(1, "e2")  # a ballot carries exactly one value: not ours
    step = accept_all(electors[0], asked, electors[1:])
    assert step.learnt == allocation(1, "e2")
    assert step.finished == (FIRST, RoundOutcome.CONFLICT)


def test_change_on_a_base_that_we_have_not_learnt_follows_under_a_higher_ballot() -> None:
    """The operator saw revision 1 at another node; here it is accepted but not learnt."""
    electors = [make(name) for name in ELECTORS]
    for elector in electors[1:]:
        accepted(elector, accept(1, allocation(1), "r0"), 0.0)
    change = Retune(base_revision=1, tuning=replace(TUNING, bonus=0.4))
    first = commit(electors[0], did(electors[0].propose, change, 0.0), electors[1:])
    assert (first.learnt, first.finished) == (allocation(1), None)
    assert first.prepare is not None
    second = commit(electors[0], first, electors[1:])
    assert second.finished == (change, RoundOutcome.COMMITTED)
    assert electors[0].value == change.apply(allocation(1))


def test_change_on_a_base_that_nobody_has_ends_as_conflict() -> None:
    electors = [make(name) for name in ELECTORS]
    change = replace(FIRST, base_revision=4)
    step = promise_all(electors[0], did(electors[0].propose, change, 0.0), electors)
    assert step.finished == (change, RoundOutcome.CONFLICT)


def test_every_queued_change_reports_its_own_end() -> None:
    """The second and third change, outdated by the first, must not swallow its end."""
    electors = [make(name) for name in ELECTORS]
    changes = [replace(FIRST, owner=owner) for owner in ("e1", "e2", "e3")]
    asked = did(electors[0].propose, changes[0], 0.0)
    assert did(electors[0].propose, changes[1], 0.0) == Step()
    assert did(electors[0].propose, changes[2], 0.0) == Step()
    assert commit(electors[0], asked, electors).ends == (
        (changes[0], RoundOutcome.COMMITTED),
        (changes[1], RoundOutcome.CONFLICT),
        (changes[2], RoundOutcome.CONFLICT),
    )
    assert not electors[0].is_busy


def test_however_many_outdated_changes_wait_all_end_and_the_next_one_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each begins the next one as it ends: a thousand of them must not be calls within calls."""
    monkeypatch.setattr("zsched.core.register.register.MAX_QUEUED", 1001)
    register, current = make(), replace(FIRST, base_revision=1)
    did(register.propose, FIRST, 0.0)
    waiting = [did(register.propose, change, 0.0) for change in (*[FIRST] * 1000, current)]
    assert waiting == [Step()] * 1001
    step = did(register.learn, allocation(1, "e2"), 0.1)
    assert step.ends == ((FIRST, RoundOutcome.CONFLICT),) * 1001
    assert step.prepare is not None
    assert register.wanted == (current,)


def test_a_change_that_finds_too_many_before_it_ends_at_once() -> None:
    register = make()
    did(register.propose, FIRST, 0.0)
    steps = [did(register.propose, FIRST, 0.0) for _ in range(MAX_QUEUED + 2)]
    assert steps == [*[Step()] * MAX_QUEUED, *[Step(ends=((FIRST, RoundOutcome.CONFLICT),))] * 2]
    assert len(register.wanted) == 1 + MAX_QUEUED


def test_learning_a_newer_value_ends_a_change_that_has_not_been_sent() -> None:
    register = make()
    did(register.propose, FIRST, 0.0)
    step = did(register.learn, allocation(1, "e2"), 0.1)
    assert step.finished == (FIRST, RoundOutcome.CONFLICT)
    assert step.reason is None, "ours is not why"


def test_no_majority_gives_up_as_no_quorum() -> None:
    register = make()
    step, ends = did(register.propose, FIRST, 0.0), []
    while register.next_deadline() < math.inf:
        assert register.next_deadline() < 7 * BALLOT_S
        step = did(register.tick, register.next_deadline())
        ends.append(step.finished)
    assert ends[-1] == (FIRST, RoundOutcome.NO_QUORUM)
    assert ends[:-1] == [None] * (len(ends) - 1)


@pytest.mark.parametrize("timing", PROFILES.values(), ids=list(PROFILES))
def test_two_changes_without_a_majority_end_while_an_operator_still_waits(timing: Timing) -> None:
    """The second one waits for the first, and its operator is told 'no quorum', and not that a loop hangs."""
    register, second = make(clocks=timing), replace(FIRST, owner="e2")
    did(register.propose, FIRST, 0.0)
    did(register.propose, second, 0.0)
    ends: list[object] = []
    now = 0.0
    while register.is_busy:
        now = register.next_deadline()
        ends += did(register.tick, now).ends
    assert ends == [(FIRST, RoundOutcome.NO_QUORUM), (second, RoundOutcome.NO_QUORUM)]
    assert now < timing.order_s


def test_refused_by_a_majority_tries_above_the_promised_counter() -> None:
    proposer, others = make("r1"), [make("r2"), make("r3")]
    for other in others:
        promised(other, prepare(40))
    promise_all(proposer, did(proposer.propose, FIRST, 0.0), others)
    assert proposer.next_deadline() < BALLOT_S  # it need not wait for the deadline
    again = did(proposer.tick, proposer.next_deadline())
    assert again.prepare is not None
    assert again.prepare.ballot.counter == 41
    assert commit(proposer, again, others).finished == (FIRST, RoundOutcome.COMMITTED)


def test_duplicated_prepare_does_not_count_as_refusal() -> None:
    proposer = make("r1")
    asked = did(proposer.propose, FIRST, 0.0)
    assert asked.prepare is not None
    mine = asked.prepare.ballot
    for other in ("r2", "r3"):  # as an older program echoes what it has promised already
        echo = Refused(elector=other, task="merge", ballot=mine, refusal=Refusal.BALLOT, promised=mine)
        did(proposer.on_answer, echo, 0.0)
    assert proposer.next_deadline() == BALLOT_S  # still the same attempt


# --- unknown outcomes ------------------------------------------------------------------------------------------------


def overtake(proposer: TaskRegister, acceptors: Iterable[TaskRegister], asked: Prepare | Accept) -> None:
    """A rival's ballot is promised, and the proposer hears so when it asks again."""
    for acceptor in acceptors:
        promised(acceptor, prepare(9))
        answer = promised(acceptor, asked) if isinstance(asked, Prepare) else accepted(acceptor, asked, 0.0)
        assert did(proposer.on_answer, answer[1], BALLOT_S) == Step()


def sent_and_unanswered(acceptors: list[TaskRegister]) -> TaskRegister:
    """r1 heard nothing of its accept at ``acceptors``, and a rival has overtaken it; it waits for its next attempt."""
    proposer = make("r1")
    asked = promise_all(proposer, did(proposer.propose, FIRST, 0.0), acceptors)
    assert asked.accept is not None
    for acceptor in acceptors:
        accepted(acceptor, asked.accept, 0.0)
    overtake(proposer, acceptors, asked.accept)
    return proposer


def test_unknown_outcome_is_found_out_by_an_identity_round_not_applied_again() -> None:
    others = [make("r2"), make("r3")]
    proposer = sent_and_unanswered(others)
    step = commit(proposer, did(proposer.tick, proposer.next_deadline()), others)
    assert step.finished == (FIRST, RoundOutcome.COMMITTED)
    assert step.learnt == allocation(1)  # revision 1, not 2: applied once


def test_unknown_outcome_that_nobody_can_tell_ends_as_unknown() -> None:
    proposer = sent_and_unanswered([make("r2"), make("r3")])
    end = None
    while proposer.next_deadline() < math.inf:
        end = did(proposer.tick, proposer.next_deadline()).finished or end
    assert end == (FIRST, RoundOutcome.UNKNOWN)


def test_a_lost_accept_is_sent_again_under_its_ballot() -> None:
    others = [make("r2"), make("r3")]
    proposer = make("r1")
    asked = promise_all(proposer, did(proposer.propose, FIRST, 0.0), others)
    again = did(proposer.tick, BALLOT_S)
    assert again.accept == asked.accept
    assert accept_all(proposer, again, others).finished == (FIRST, RoundOutcome.COMMITTED)


def test_an_accept_that_is_overtaken_is_not_sent_again() -> None:
    """Nobody has our value: the identity round carries what it reads, and the change does not stand."""
    others = [make("r2"), make("r3")]
    for other in others:
        accepted(other, accept(1, allocation(1), "r0"), 0.0)
    proposer = make("r1", state=replace(BLANK, learnt=allocation(1)))
    change = replace(FIRST, base_revision=1, owner="e5")
    lost = promise_all(proposer, did(proposer.propose, change, 0.0), others).accept
    assert lost is not None
    overtake(proposer, others, lost)
    asked = promise_all(proposer, did(proposer.tick, proposer.next_deadline()), others)
    assert asked.accept is not None
    assert asked.accept.acceptance.value == allocation(1)
    step = accept_all(proposer, asked, others)
    assert step.finished == (change, RoundOutcome.CONFLICT)
    assert proposer.value == allocation(1)


@pytest.mark.parametrize(
    ("learnt", "outcome"),
    [
        (allocation(1), RoundOutcome.COMMITTED),
        (allocation(1, "e2"), RoundOutcome.CONFLICT),
        (allocation(2, "e2"), RoundOutcome.UNKNOWN),  # ours may be the revision under it
    ],
)
def test_what_a_peer_learnt_ends_a_round_whose_outcome_was_unknown(learnt: Allocation, outcome: RoundOutcome) -> None:
    proposer = sent_and_unanswered([make("r2"), make("r3")])
    assert did(proposer.learn, learnt, 1.0).finished == (FIRST, outcome)


def test_an_elector_that_nobody_answers_asks_more_and_more_seldom_what_became_of_an_acceptance() -> None:
    register = make("r1")
    accepted(register, accept(1, allocation(1)), 0.0)
    now = 0.0
    asked_at: list[float] = []
    while now < 80.0:
        if did(register.tick, now).prepare is not None:
            asked_at.append(now)
        now = max(register.next_deadline(), now + 0.001)
    early, late = (sum(start <= at < start + 10.0 for at in asked_at) for start in (0.0, 70.0))
    assert early > 2 * late > 0, (early, late)


# --- a value that too many electors refuse for good ------------------------------------------------------------------


def stuck(change: MoveOwner | Retune | None) -> tuple[TaskRegister, list[TaskRegister], Step]:
    """r1 alone has accepted a value of owner "gone", which the others refuse; (proposer r2, all, its first accept)."""
    electors = [make(name) for name in ELECTORS]
    proposer = electors[1]
    assert accepted(electors[0], accept(1, GONE, "r0"), 0.0)[0].is_dirty
    asked = did(proposer.settle, 0.0) if change is None else did(proposer.propose, change, 0.0)
    return proposer, electors, promise_all(proposer, asked, electors)


def refuse_value(proposer: TaskRegister, electors: list[TaskRegister], asked: Step) -> Step:
    """The elector that has it accepts it once more, the other two say that it can be no true one."""
    assert asked.accept is not None
    carried = asked.accept.acceptance
    answers: list[Accepted | Refused] = [accepted(electors[0], asked.accept, 0.0)[1]]
    answers += [one.refuse(carried.ballot, Refusal.VALUE) for one in electors[1:]]
    return last(did(proposer.on_answer, answer, 0.0) for answer in answers)


GONE = allocation(1, "gone")
SECOND = replace(FIRST, owner="e2")


def test_a_move_is_applied_at_once_to_a_value_that_no_majority_takes() -> None:
    proposer, electors, asked = stuck(SECOND)
    assert asked.accept is not None
    assert asked.accept.acceptance.value == GONE, "it may have been chosen: first it is tried"
    assert refuse_value(proposer, electors, asked) == Step()
    again = did(proposer.tick, proposer.next_deadline())
    step = commit(proposer, again, electors)
    assert step.finished == (SECOND, RoundOutcome.COMMITTED)
    assert step.learnt == allocation(2, "e2")


@pytest.mark.parametrize(
    "change",
    [None, Retune(base_revision=0, tuning=replace(TUNING, bonus=0.3)), replace(FIRST, owner="gone")],
    ids=["identity round", "retune", "move to it"],
)
def test_nothing_but_a_move_away_goes_on_from_it(change: MoveOwner | Retune | None) -> None:
    proposer, electors, asked = stuck(change)
    refuse_value(proposer, electors, asked)
    asked = promise_all(proposer, did(proposer.tick, proposer.next_deadline()), electors)
    assert asked.accept is not None
    assert asked.accept.acceptance.value == GONE


def test_a_value_that_is_refused_for_a_higher_ballot_is_tried_again() -> None:
    proposer, electors, asked = stuck(SECOND)
    for one in electors:
        promised(one, prepare(9))
    assert accept_all(proposer, asked, electors) == Step()
    asked = promise_all(proposer, did(proposer.tick, proposer.next_deadline()), electors)
    assert asked.accept is not None
    assert asked.accept.acceptance.value == GONE


# --- an exclusive task's lease ---------------------------------------------------------------------------------------


def asked(others: tuple[TaskRegister, ...]) -> tuple[TaskRegister, Acceptance]:
    """A proposer whose accept is on its way to r2 and r3."""
    proposer = make("r1", is_elector=False)
    carried = promise_all(proposer, did(proposer.propose, FIRST, 0.0), others).accept
    assert carried is not None
    return proposer, carried.acceptance


def refused(proposer: TaskRegister, others: tuple[TaskRegister, ...], held: Acceptance, *whys: Refusal) -> Step:
    answers = [one.refuse(held.ballot, why) for one, why in zip(others, whys, strict=False)]
    return last(did(proposer.on_answer, answer, 0.25) for answer in answers)


def test_an_accept_that_only_leases_forbid_is_sent_once_more_under_its_ballot() -> None:
    """A higher ballot would only find out that nobody has accepted ours, and end the move for whose sake one leaves."""
    others = (make("r2"), make("r3"))
    proposer, held = asked(others)
    assert refused(proposer, others, held, Refusal.LEASE, Refusal.LEASE) == Step()
    assert did(proposer.tick, BALLOT_S - 0.001) == Step()
    again = did(proposer.tick, BALLOT_S)
    assert (again.accept and again.accept.acceptance, again.prepare) == (held, None)
    assert accept_all(proposer, again, others, BALLOT_S).finished == (FIRST, RoundOutcome.COMMITTED)


def test_who_has_accepted_before_the_others_were_free_counts() -> None:
    others = (make("r2"), make("r3"))
    proposer, held = asked(others)
    yes = Accepted(elector="r2", task="merge", ballot=held.ballot)
    assert did(proposer.on_answer, yes, 0.1) == Step()
    did(proposer.on_answer, others[1].refuse(held.ballot, Refusal.LEASE), 0.25)
    again = did(proposer.tick, BALLOT_S)
    assert accept_all(proposer, again, others[1:], BALLOT_S).finished == (FIRST, RoundOutcome.COMMITTED)


def test_a_lease_that_does_not_end_is_waited_for_as_long_as_any_other_answer() -> None:
    others = (make("r2"), make("r3"))
    proposer, held = asked(others)
    for _ in range(100):
        refused(proposer, others, held, Refusal.LEASE, Refusal.LEASE)
        at = proposer.next_deadline()
        step = did(proposer.tick, at)
        if step.finished is not None:
            break
    assert (step.finished, step.accept) == ((FIRST, RoundOutcome.UNKNOWN), None)
    assert at == pytest.approx(6 * BALLOT_S)


@pytest.mark.parametrize("why", [Refusal.BALLOT, Refusal.YOUNG, Refusal.NOT_ELECTOR])
def test_a_no_for_any_other_reason_than_a_lease_takes_a_higher_ballot(why: Refusal) -> None:
    others = (make("r2"), make("r3"))
    proposer, held = asked(others)
    for other in others:
        promised(other, prepare(9))
    assert refused(proposer, others, held, Refusal.LEASE, why) == Step()
    again = did(proposer.tick, proposer.next_deadline())
    assert (again.accept, again.prepare is None) == (None, False)


def overtaken() -> tuple[TaskRegister, float]:
    """A proposer that a higher ballot has overtaken, and when it would try again."""
    others = (make("r2"), make("r3"))
    proposer, held = asked(others)
    for other in others:
        promised(other, prepare(9))
    refused(proposer, others, held, Refusal.BALLOT, Refusal.BALLOT)
    at = proposer.next_deadline()
    assert at < 0.25 + BALLOT_S
    return proposer, at


def test_who_is_overtaken_lets_the_accept_end_that_waits_for_the_owner_to_leave() -> None:
    proposer, at = overtaken()
    proposer.expect_release(0.2, 1.2)
    proposer.expect_release(0.26, 1.26)
    assert (did(proposer.tick, at), proposer.next_deadline()) == (Step(), 1.2)
    proposer.expect_release(1.0, 2.0)
    assert did(proposer.tick, 1.2).prepare is not None, "no later than the first question said"


def test_who_is_overtaken_waits_no_longer_than_its_change_may_take_and_for_nobody_s_owner_but_this_one() -> None:
    proposer, at = overtaken()
    proposer.expect_release(0.2, 99.0)
    assert (did(proposer.tick, at), proposer.next_deadline()) == (Step(), 6 * BALLOT_S)
    assert did(proposer.tick, 6 * BALLOT_S).prepare is not None

    proposer, at = overtaken()
    assert did(proposer.tick, at).prepare is not None, "nobody was asked to leave"

    proposer = make("r1", is_elector=False)
    proposer.expect_release(0.0, 99.0)
    did(proposer.learn, allocation(1), 0.0)
    others = (make("r2"), make("r3"))
    did(proposer.propose, MoveOwner(base_revision=1, owner="e2", reason="test"), 0.0)
    for other in others:
        promised(other, prepare(9))
    did(proposer.tick, BALLOT_S)
    assert did(proposer.tick, proposer.next_deadline()).prepare is not None, "who was asked to leave has left"


# --- promises ahead --------------------------------------------------------------------------------------------------


def ahead() -> list[TaskRegister]:
    """Three electors; the first has asked all of them ahead, and a majority has promised."""
    electors = [make(name) for name in ELECTORS]
    assert promise_all(electors[0], did(electors[0].prepare_ahead, 0.0), electors[:2]) == Step()
    assert not electors[0].is_busy
    return electors


def test_a_change_that_was_asked_for_ahead_needs_one_phase_only() -> None:
    electors = ahead()
    asked = did(electors[0].propose_prepared, FIRST, 1.0)
    assert asked.prepare is None
    assert accept_all(electors[0], asked, electors[1:]).finished == (FIRST, RoundOutcome.COMMITTED)
    assert electors[0].value == allocation(1)


def test_a_change_that_comes_before_the_promises_goes_on_with_them() -> None:
    electors = [make(name) for name in ELECTORS]
    asked = did(electors[0].prepare_ahead, 0.0)
    assert did(electors[0].propose_prepared, FIRST, 0.01) == Step()
    assert commit(electors[0], asked, electors[:2]).finished == (FIRST, RoundOutcome.COMMITTED)


def test_a_ballot_that_was_overtaken_since_it_was_promised_carries_nothing() -> None:
    """Another proposer has come between: what it has chosen stands."""
    electors = ahead()
    commit(electors[2], did(electors[2].propose, replace(FIRST, owner="e2"), 0.5), electors[1:])
    asked = did(electors[0].propose_prepared, FIRST, 1.0)
    assert asked.accept is not None
    answers = [accepted(one, asked.accept, 1.0)[1] for one in electors[1:]]
    assert [isinstance(one, Refused) and one.refusal is Refusal.BALLOT for one in answers] == [True, True]
    assert electors[2].value.owner == "e2"


def test_what_was_learnt_meanwhile_ends_a_change_that_is_based_on_the_value_before() -> None:
    electors = ahead()
    did(electors[0].learn, allocation(1), 0.5)
    assert did(electors[0].propose_prepared, FIRST, 1.0).finished == (FIRST, RoundOutcome.CONFLICT)
    assert electors[0].next_deadline() == math.inf


def test_what_a_majority_has_accepted_is_settled_before_a_change_that_was_asked_for_ahead() -> None:
    electors = [make(name) for name in ELECTORS]
    accepted(electors[1], accept(1, allocation(1), "a"), 0.0)
    asked = promise_all(electors[0], did(electors[0].prepare_ahead, 0.0), electors[1:])
    assert asked.accept is not None, "an identity round"
    assert accept_all(electors[0], asked, electors[1:]).learnt == allocation(1)
    assert electors[0].next_deadline() == math.inf


def test_promises_for_which_no_change_comes_are_forgotten() -> None:
    proposer = ahead()[0]
    did(proposer.tick, proposer.next_deadline())
    assert proposer.next_deadline() == math.inf
    assert did(proposer.propose_prepared, FIRST, 10.0).prepare is not None


def test_a_change_that_was_asked_for_ahead_has_a_time_of_its_own() -> None:
    """The first questions are lost: it is tried again, as any change."""
    proposer = make(ELECTORS[0])
    did(proposer.prepare_ahead, 0.0)
    did(proposer.propose_prepared, FIRST, 0.9 * BALLOT_S)
    did(proposer.tick, BALLOT_S)
    assert did(proposer.tick, proposer.next_deadline()).prepare is not None
    assert proposer.wanted == (FIRST,)


def test_promises_of_a_number_are_none_of_the_next_one() -> None:
    proposer = ahead()[0]
    count = Electorate(number=3, generation_id="ab", electors=tuple(Elector(name=name) for name in ELECTORS))
    proposer.count_with(count, is_elector=True, is_blank=False, now=1.0)
    assert proposer.next_deadline() == math.inf
    asked = did(proposer.propose_prepared, FIRST, 1.0)
    assert asked.prepare is not None
    assert asked.prepare.number == 3


def test_another_change_begins_with_promises_of_its_own() -> None:
    """An operator's: with a ballot that was overtaken its end would be unknown."""
    electors = ahead()
    asked = did(electors[0].propose, FIRST, 1.0)
    assert asked.prepare is not None
    assert commit(electors[0], asked, electors[1:], 1.0).finished == (FIRST, RoundOutcome.COMMITTED)
