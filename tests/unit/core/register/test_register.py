"""Each rule of `zsched.core.register.register`, one situation at a time.

The proposing side is in test_register_proposer.py, random schedules in test_register_schedules.py.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from random import Random

import pytest

from support.registers import (
    BALLOT_S,
    BLANK,
    ELECTORS,
    FIRST,
    INITIAL,
    STAGGER_S,
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
from zsched.core.register.register import BACKOFF_CAP_S, MAX_JUMP, MAX_REVISION
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import RoundOutcome
from zsched.core.values.messages import Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import MAX_COUNTER, Acceptance
from zsched.core.values.todo import ToDo

# --- acceptor --------------------------------------------------------------------------------------------------------


def test_prepare_higher_ballot_is_promised_and_persisted_first() -> None:
    register = make()
    step, answer = promised(register, prepare(1))
    assert step.is_dirty
    assert register.state.promised == ballot(1)
    assert answer == Promise(elector="r1", task="merge", ballot=ballot(1))


def test_prepare_below_the_promise_is_refused() -> None:
    register = make()
    promised(register, prepare(5))
    step, answer = promised(register, prepare(4))
    assert isinstance(answer, Refused)
    assert (answer.refusal, answer.promised) == (Refusal.BALLOT, ballot(5))
    assert not step.is_dirty


def test_promise_brings_what_was_accepted() -> None:
    register = make()
    accepted(register, accept(1, allocation(1)), 0.0)
    _, answer = promised(register, prepare(2))
    assert isinstance(answer, Promise)
    assert answer.accepted == Acceptance(ballot=ballot(1), value=allocation(1))


def test_accept_of_the_promised_ballot_is_persisted_first() -> None:
    register = make()
    promised(register, prepare(3))
    step, answer = accepted(register, accept(3, allocation(1)), 0.0)
    assert step.is_dirty
    assert register.state.accepted == Acceptance(ballot=ballot(3), value=allocation(1))
    assert answer == Accepted(elector="r1", task="merge", ballot=ballot(3))


def test_a_prepare_or_accept_that_is_said_again_changes_nothing() -> None:
    register = make()
    old = prepare(2), accept(2, allocation(1))
    promised(register, old[0])
    accepted(register, old[1], 0.0)
    before = register.state
    step, answer = promised(register, old[0])
    assert answer == Promise(elector="r1", task="merge", ballot=ballot(2), accepted=old[1].acceptance)
    assert not step.is_dirty
    step, again = accepted(register, old[1], 9.0)
    assert again == Accepted(elector="r1", task="merge", ballot=ballot(2))
    assert not step.is_dirty
    assert register.state == before
    promised(register, prepare(3))
    accepted(register, accept(3, allocation(2)), 9.0)
    newer = register.state
    assert isinstance(promised(register, old[0])[1], Refused)
    assert isinstance(accepted(register, old[1], 9.0)[1], Refused)
    assert register.state == newer


@pytest.mark.parametrize("held", [1, None], ids=["accepted", "not accepted"])
def test_what_is_learnt_is_written_before_anything_follows(held: int | None) -> None:
    register = make()
    if held is not None:
        accepted(register, accept(1, allocation(held)), 0.0)
    todo = ToDo()
    register.learn(allocation(1), todo, 0.0)
    assert todo.must_persist


def test_accept_under_a_higher_ballot_than_promised_raises_the_promise() -> None:
    register = make()
    accepted(register, accept(4, allocation(1)), 0.0)
    assert register.state.promised == ballot(4)


def test_accept_below_the_promise_is_refused() -> None:
    register = make()
    promised(register, prepare(3))
    step, answer = accepted(register, accept(2, allocation(1)), 0.0)
    assert isinstance(answer, Refused)
    assert answer.refusal is Refusal.BALLOT
    assert not step.is_dirty
    assert register.state.accepted is None


@pytest.mark.parametrize("register", [make("edge"), make(is_elector=False)])
def test_no_elector_answers_neither_prepare_nor_accept(register: TaskRegister) -> None:
    for step, answer in (promised(register, prepare(1)), accepted(register, accept(1, allocation(1)), 0.0)):
        assert isinstance(answer, Refused)
        assert answer.refusal is Refusal.NOT_ELECTOR
        assert not step.is_dirty
    assert register.state == BLANK


def test_stop_electing_ends_an_electors_answers() -> None:
    register = make()
    register.stop_electing()
    _, answer = promised(register, prepare(1))
    assert isinstance(answer, Refused)
    assert answer.refusal is Refusal.NOT_ELECTOR


def test_another_electorate_is_refused() -> None:
    register = make()
    for step, answer in (
        promised(register, prepare(1, electorate="xyz")),
        accepted(register, accept(1, allocation(1), electorate="xyz"), 0.0),
    ):
        assert isinstance(answer, Refused)
        assert answer.refusal is Refusal.ELECTORATE
        assert not step.is_dirty
    assert register.state == BLANK


def test_two_electorates_never_commit_together() -> None:
    proposer = make("r1", electorate="xyz")
    others = [make("r2"), make("r3")]
    step = promise_all(proposer, did(proposer.propose, FIRST, 0.0), [proposer, *others])
    assert step.accept is None


# --- the crash that random schedules hardly ever hit -----------------------------------------------------------------


class ForgetsPromises(TaskRegister):
    """Planted bug: answers before the promise is on disk."""

    def on_prepare(self, prepare: Prepare, _todo: ToDo) -> Promise | Refused:
        return super().on_prepare(prepare, ToDo())


def duel_with_a_crash(kind: type[TaskRegister]) -> set[str | None]:
    """r2 promises the higher ballot, crashes, and then the lower ballot's accept arrives; {owner learnt}."""
    first, second, witness = make("r1"), make("r3"), make("r2", kind=kind)
    low = promise_all(first, did(first.propose, FIRST, 0.0), [first, witness])
    disk = witness.state
    promised(second, prepare(7))  # so that its own ballot is the higher one
    asked = did(second.propose, replace(FIRST, owner="e2"), 0.0)
    assert asked.prepare is not None
    step, answer = promised(witness, asked.prepare)
    disk = witness.state if step.is_dirty else disk
    high = last(
        [did(second.on_answer, answer, 0.0), did(second.on_answer, promised(second, asked.prepare)[1], 0.0)],
    )
    restarted = make("r2", state=disk, incarnation=2)
    ends = [accept_all(first, low, [first, restarted]), accept_all(second, high, [second, restarted])]
    return {end.learnt.owner for end in ends if end.learnt is not None}


def test_crash_between_promise_and_acceptance_cannot_commit_two_values() -> None:
    assert duel_with_a_crash(TaskRegister) == {"e2"}
    assert duel_with_a_crash(ForgetsPromises) == {"e1", "e2"}  # the test does see the bug


# --- learner and identity rounds -------------------------------------------------------------------------------------


def test_two_values_for_one_revision_are_reported_and_the_first_stays() -> None:
    register = make()
    did(register.learn, allocation(2), 0.0)
    step = did(register.learn, allocation(2, "e2"), 0.0)
    assert "two values for revision 2" in step.problem
    assert register.value == allocation(2)


def test_elector_asks_what_became_of_an_acceptance_it_has_not_learnt() -> None:
    electors = [make(name) for name in ELECTORS]
    for elector in electors[:2]:
        accepted(elector, accept(1, allocation(1)), 5.0)
    assert 5.0 < electors[0].next_deadline() <= 5.0 + 2 * BALLOT_S + 2 * STAGGER_S
    now = electors[0].next_deadline()
    step = commit(electors[0], did(electors[0].tick, now), electors, now)
    assert step.learnt == allocation(1)
    assert electors[0].next_deadline() == math.inf


def test_elector_that_learns_in_time_asks_nobody() -> None:
    register = make()
    accepted(register, accept(1, allocation(1)), 0.0)
    did(register.learn, allocation(1), 0.1)
    assert register.next_deadline() == math.inf


def test_identity_rounds_of_a_lonely_elector_back_off_to_the_cap_for_ever() -> None:
    """Two hours alone with an unlearnt acceptance: some 1300 tries, never more than cap + round apart, no overflow."""
    register = make()
    accepted(register, accept(1, allocation(1)), 0.0)
    now, asked = 0.0, []
    while now < 7200.0:
        now = register.next_deadline()
        if did(register.tick, now).prepare is not None:
            asked.append(now)
    gaps = [right - left for left, right in itertools.pairwise(asked)]
    assert max(gaps) <= 1.5 * BACKOFF_CAP_S + 2 * BALLOT_S + 3 * BALLOT_S
    assert len(asked) > 1024


def test_starting_elector_that_reaches_nobody_asks_again_when_it_holds_an_unlearnt_acceptance() -> None:
    state = replace(BLANK, accepted=Acceptance(ballot=ballot(1), value=allocation(1)), promised=ballot(1))
    register, other = make("r1", state=state, incarnation=2), make("r2", state=state, incarnation=2)
    did(register.settle, 0.0)
    asked = Step()
    for _ in range(20):
        asked = did(register.tick, register.next_deadline())
    while asked.prepare is None:
        asked = did(register.tick, register.next_deadline())
    assert commit(register, asked, [register, other], 60.0).learnt == allocation(1)


def test_identity_round_of_a_blank_fleet_writes_nothing() -> None:
    electors = [make(name) for name in ELECTORS]
    step = promise_all(electors[0], did(electors[0].settle, 0.0), electors)
    assert (step.accept, step.finished, step.learnt) == (None, None, None)
    assert electors[0].next_deadline() == math.inf


def test_a_value_that_nothing_could_follow_is_not_learnt() -> None:
    register = make("r1")
    for beyond in (replace(allocation(1), revision=MAX_REVISION + 1), replace(allocation(1), epoch=MAX_REVISION + 1)):
        assert "cannot be" in did(register.learn, beyond, 0.0).problem
        assert register.value == INITIAL
    last_one = allocation(MAX_REVISION)
    assert did(register.learn, last_one, 0.0).problem == ""
    assert register.value == last_one


def test_a_value_of_the_task_before_is_not_learnt() -> None:
    """A task that was removed and added again begins with a later revision; peers that were away tell the old ones."""
    register = make("r1")
    register.begin_with(allocation(4))
    assert not did(register.learn, allocation(3), 0.0).is_dirty
    assert register.state.learnt is None
    assert did(register.learn, allocation(4), 0.0).is_dirty


def test_an_acceptance_is_asked_about_only_once_its_proposer_has_had_its_time() -> None:
    for _ in range(5):
        register = make("r1")
        accepted(register, accept(1, allocation(1)), 10.0)
        assert register.next_deadline() > 10.0 + 2 * BALLOT_S


def test_who_hears_of_a_later_generation_forgets_what_another_fleet_has_learnt() -> None:
    register = make("r1", state=replace(BLANK, learnt=allocation(3)), is_elector=False)
    register.follow("def", allocation(3), 0)
    assert register.state.learnt == allocation(3), "it may be this one's"
    register.follow("def", allocation(4), 0)
    assert register.state == BLANK
    assert register.value == allocation(4)


def test_settle_leaves_a_round_under_way_alone() -> None:
    register = make()
    did(register.propose, FIRST, 0.0)
    assert did(register.settle, 0.1) == Step()


def test_promises_that_were_overtaken_are_no_sign_of_lost_state() -> None:
    """Revision 1 was chosen and learnt while our identity round's promises were on their way."""
    proposer, others = make("r1"), [make("r2"), make("r3")]
    asked = did(proposer.settle, 0.0).prepare
    assert asked is not None
    late = [promised(other, asked)[1] for other in others]
    did(proposer.learn, allocation(1), 0.1)
    steps = [did(proposer.on_answer, answer, 0.2) for answer in late]
    assert [step.problem for step in steps] == ["", ""]
    assert steps[-1].accept is None  # and it does not write the older value again


def test_majority_that_has_forgotten_a_learnt_value_is_reported_and_nothing_moves() -> None:
    proposer = make("r1", state=replace(BLANK, learnt=allocation(3)))
    step = promise_all(proposer, did(proposer.propose, replace(FIRST, base_revision=3), 0.0), [make("r2"), make("r3")])
    assert "forgotten revision 3" in step.problem
    assert step.finished == (replace(FIRST, base_revision=3), RoundOutcome.NO_QUORUM)


# --- time and hostile peers ------------------------------------------------------------------------------------------


def test_duelling_proposers_part() -> None:
    for seed in range(20):
        electors = [make(name) for name in ELECTORS]
        duellers = electors[:2]
        for number, dueller in enumerate(duellers):
            dueller._rng = Random(seed * 2 + number)
        ended: dict[int, RoundOutcome] = {}
        steps = {i: did(dueller.propose, replace(FIRST, owner=f"e{i}"), 0.0) for i, dueller in enumerate(duellers)}
        now = 0.0
        for _ in range(200):
            prepared = {i: promise_all(duellers[i], s, electors, now) for i, s in steps.items() if s.prepare}
            done = {i: accept_all(duellers[i], s, electors, now) for i, s in prepared.items() if s.accept}
            ended |= {i: step.finished[1] for i, step in done.items() if step.finished}
            if ended:
                break
            now = min(dueller.next_deadline() for dueller in duellers)
            steps = {i: did(d.tick, now) for i, d in enumerate(duellers) if d.next_deadline() <= now}
        assert RoundOutcome.COMMITTED in ended.values()
        assert now < 6 * BALLOT_S


def test_one_hostile_ballot_does_not_use_up_the_counters() -> None:
    register = make()
    _, answer = promised(register, prepare(MAX_COUNTER))
    assert isinstance(answer, Refused)
    _, no = accepted(register, accept(MAX_COUNTER, allocation(1)), 0.0)
    assert isinstance(no, Refused)
    assert register.state == BLANK
    assert isinstance(promised(register, prepare(MAX_JUMP))[1], Promise)


def test_hostile_refusals_do_not_use_up_the_counters() -> None:
    proposer = make("r1")
    asked = did(proposer.propose, FIRST, 0.0).prepare
    assert asked is not None
    for name in ("r2", "r3"):
        refused = Refused(
            elector=name, task="merge", ballot=asked.ballot, refusal=Refusal.BALLOT, promised=ballot(MAX_COUNTER)
        )
        did(proposer.on_answer, refused, 0.0)
    again = did(proposer.tick, proposer.next_deadline()).prepare
    assert again is not None
    assert again.ballot.counter == 2


def test_restart_keeps_promises_and_its_ballots_are_new() -> None:
    before = make("r1")
    old = did(before.propose, FIRST, 0.0).prepare
    assert old is not None
    promised(before, old)
    after = make("r1", state=before.state, incarnation=2)
    new = did(after.propose, FIRST, 0.0).prepare
    assert new is not None
    assert new.ballot > old.ballot
