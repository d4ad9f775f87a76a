"""Rules of a round that schedules find broken only now and then: who counts, how often, and for which ballot."""

from __future__ import annotations

from dataclasses import replace
from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.fleets import fleet_of, task_of, tuning_of
from support.registers import Step, did
from support.states import state_of
from support.todos import agreed
from zsched.core.register.task_register import TaskRegister
from zsched.core.values.change import MoveOwner
from zsched.core.values.events import AcceptAsked, PrepareAsked
from zsched.core.values.fleet import Timing, WorkerSpec, electorate_hash
from zsched.core.values.in_force import InForce
from zsched.core.values.messages import Accept, Accepted, Prepare, Promise, Refusal, Refused
from zsched.core.values.model import (
    Acceptance,
    Ballot,
    RegisterState,
)
from zsched.core.vote.agreement import Agreement

ELECTORS = ("r1", "r2", "r3")
INITIAL = allocation_of(0, None, tuning=tuning_of(cpu=1.0, memory=0.0))


def proposer(incarnation: int = 4) -> TaskRegister:
    return TaskRegister(
        me="r1",
        incarnation=incarnation,
        electors=ELECTORS,
        electorate="e",
        is_elector=True,
        initial=INITIAL,
        state=RegisterState(task="merge"),
        clocks=lambda: Timing(ballot_s=0.3, stagger_s=0.03),
        rng=Random(1),
    )


def proposed(register: TaskRegister, now: float = 0.0) -> Ballot:
    step = did(register.propose, MoveOwner(base_revision=0, owner="e1", reason="test"), now)
    assert step.prepare is not None
    return step.prepare.ballot


def promise(elector: str, ballot: Ballot, accepted: Acceptance | None = None) -> Promise:
    return Promise(elector=elector, task="merge", ballot=ballot, accepted=accepted)


def test_an_elector_s_promise_and_acceptance_count_once_however_often_they_come() -> None:
    register = proposer()
    ballot = proposed(register)
    assert did(register.on_answer, promise("r1", ballot), 0.01) == Step()
    assert did(register.on_answer, promise("r1", ballot), 0.02) == Step()
    assert did(register.on_answer, promise("r2", ballot), 0.03).accept is not None
    yes = Accepted(elector="r1", task="merge", ballot=ballot)
    assert did(register.on_answer, yes, 0.04) == Step()
    assert did(register.on_answer, yes, 0.05) == Step()
    assert did(register.on_answer, Accepted(elector="r2", task="merge", ballot=ballot), 0.06).learnt is not None


def test_promises_and_acceptances_of_an_earlier_attempt_count_nothing() -> None:
    register = proposer()
    first = proposed(register)
    rival = ballot_of(first.counter + 1, "r3")
    for elector in ("r2", "r3"):
        no = Refused(elector=elector, task="merge", ballot=first, refusal=Refusal.BALLOT, promised=rival)
        did(register.on_answer, no, 0.01)
    now = register.next_deadline()
    asked = did(register.tick, now).prepare
    assert asked is not None
    second = asked.ballot
    assert second > first
    for elector in ELECTORS:
        assert did(register.on_answer, promise(elector, first), now) == Step()
    for elector in ELECTORS[:2]:
        step = did(register.on_answer, promise(elector, second), now)
    assert step.accept is not None
    for elector in ELECTORS:
        assert did(register.on_answer, Accepted(elector=elector, task="merge", ballot=first), now) == Step()
    assert register.value == INITIAL


def test_two_lives_of_a_node_never_use_the_same_ballot() -> None:
    assert proposed(proposer(incarnation=4)) != proposed(proposer(incarnation=5))


def test_newer_among_accepted_values_is_the_higher_ballot_not_the_higher_revision() -> None:
    register = proposer()
    ballot = proposed(register)
    older = Acceptance(
        ballot=ballot_of(node="r2"),
        value=allocation_of(2, "e2", tuning=INITIAL.tuning),
    )
    newer = Acceptance(
        ballot=ballot_of(node="r3"),
        value=allocation_of(owner="e3", tuning=INITIAL.tuning),
    )
    did(register.on_answer, promise("r2", ballot, older), 0.01)
    step = did(register.on_answer, promise("r3", ballot, newer), 0.02)
    assert step.accept is not None
    assert step.accept.acceptance.value == newer.value


@pytest.mark.parametrize(("node", "asker"), [("r3", "r2"), ("ghost", "ghost"), ("r2x", "r2")])
def test_a_ballot_that_is_not_its_asker_s_or_a_stranger_s_gets_no_answer(node: str, asker: str) -> None:
    spec = task_of(candidates=ELECTORS, tuning=INITIAL.tuning, worker=WorkerSpec(command=("true",)))
    fleet = fleet_of(spec, of=ELECTORS, electors=ELECTORS)
    electorate = electorate_hash(fleet)
    state = state_of("r1", incarnation=1, electorate=electorate)
    elector = Agreement(
        in_force=InForce(fleet), me="r1", durable=state, incarnation=1, electorate=electorate, rng=Random(1), now=0.0
    )
    ballot = ballot_of(node=node)
    prepare = Prepare(task="merge", ballot=ballot, electorate=electorate)
    value = replace(INITIAL, revision=1, epoch=1, owner="r2")
    accept = Accept(task="merge", acceptance=Acceptance(ballot=ballot, value=value), electorate=electorate)
    assert not agreed(elector.acceptor.on_prepare, PrepareAsked(request=1, asker=asker, prepare=prepare), 1.0).send
    assert not agreed(elector.acceptor.on_accept, AcceptAsked(request=2, asker=asker, accept=accept), 1.0).send
    assert elector.counters == {"prepare_foreign": 1, "accept_foreign": 1}
    own = replace(prepare, ballot=replace(ballot, node="r2"))
    assert agreed(elector.acceptor.on_prepare, PrepareAsked(request=3, asker="r2", prepare=own), 1.0).send, (
        "its own one does"
    )
