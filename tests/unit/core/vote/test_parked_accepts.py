"""An accept that an exclusive task's lease forbids waits; a newer one of the same asker takes its place."""

from __future__ import annotations

from random import Random

import pytest

from support.allocations import allocation_of
from support.ballots import ballot_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of
from support.states import state_of
from support.todos import agreed
from zsched.core.node.node import Node
from zsched.core.values import events as ev
from zsched.core.values import instructions as do
from zsched.core.values.change import MoveOwner
from zsched.core.values.durable import DurableState
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import hold_s
from zsched.core.values.messages import Accept, Accepted, Learnt, Refusal, Refused
from zsched.core.values.model import Acceptance, Allocation, RegisterState
from zsched.core.values.todo import ToDo
from zsched.core.vote.acceptor import PARK_SHARE
from zsched.core.vote.agreement import Agreement

ROBOTS = ("robot1", "robot2", "robot3")
FLEET = fleet_of(task_of("guard", ROBOTS, exclusive=True), of=ROBOTS, electors=ROBOTS)
HOLD_S = hold_s(FLEET.timing.lease_s)
PARKED_S = PARK_SHARE * FLEET.timing.ballot_s


def value(revision: int, owner: str) -> Allocation:
    return allocation_of(revision, owner, task="guard")


def disk() -> DurableState:
    """With robot2 as owner."""
    return state_of("robot1", RegisterState(task="guard", learnt=value(3, "robot2")))


def elector() -> Agreement:
    """An elector that has just started, with robot2 as owner on its disk: nobody else is accepted for a hold."""
    agreement = Agreement(
        in_force=InForce(FLEET), me="robot1", durable=disk(), incarnation=7, electorate="e", rng=Random(1), now=100.0
    )
    for name in ROBOTS[1:]:
        agreement.witness.on_answer(Learnt(node=name, values=()))  # they remember no later life of it
    return agreement


def elector_node() -> Node:
    """The same elector in its node."""
    node = Node(fleet=FLEET, me="robot1", durable=disk(), incarnation=7, electorate="e", rng=Random(1), now=100.0)
    node.start(100.0)
    for name in ROBOTS[1:]:
        node.agreement.witness.on_answer(Learnt(node=name, values=()))
    return node


def overtaken(agreement: Agreement) -> None:
    """A round of this elector's own in which a higher ballot has been promised by the others."""
    change = MoveOwner(base_revision=3, owner="robot3", reason="test")
    (sent,) = agreed(agreement.propose, "guard", change, 101.0).send
    assert isinstance(sent, do.SendPrepare)
    for name in ROBOTS[1:]:
        no = Refused(
            elector=name,
            task="guard",
            ballot=sent.prepare.ballot,
            refusal=Refusal.BALLOT,
            promised=ballot_of(9, "robot3"),
        )
        agreed(agreement.on_answer, ev.ElectorAnswered(answer=no), 101.0)


ASKS_TO_LEAVE = beat_of("robot2", 9, asked_to_leave=(("guard", "robot2", 3),))


def asks(agreement: Agreement, request: int, counter: int, now: float, asker: str = "robot3") -> ToDo:
    ballot = ballot_of(counter, asker)
    accept = Accept(task="guard", acceptance=Acceptance(ballot=ballot, value=value(4, "robot3")), electorate="e")
    return agreed(agreement.acceptor.on_accept, ev.AcceptAsked(request=request, asker=asker, accept=accept), now)


def answers(effects: ToDo) -> list[tuple[int, str]]:
    found = []
    for one in effects.send:
        assert isinstance(one, do.AnswerElection)
        assert isinstance(one.answer, Accepted | Refused)
        found.append((one.request, one.answer.refusal.value if isinstance(one.answer, Refused) else "accepted"))
    return found


def test_it_waits_for_the_lease_and_is_refused_when_its_ballot_is_nearly_over() -> None:
    agreement = elector()
    effects = asks(agreement, 1, 5, 100.1)
    assert (answers(effects), effects.must_beat, agreement.acceptor.has_parked) == ([], True, True)
    effects = agreed(agreement.acceptor.retry_parked, 100.1 + PARKED_S / 2)
    assert (answers(effects), effects.must_beat, agreement.acceptor.has_parked) == ([], False, True)
    assert agreement.next_deadline() <= 100.1 + PARKED_S
    assert answers(agreed(agreement.acceptor.retry_parked, 100.1 + PARKED_S)) == [(1, Refusal.LEASE)]
    assert not agreement.acceptor.has_parked


def test_it_is_accepted_as_soon_as_the_lease_is_over() -> None:
    agreement = elector()
    at = 100.0 + HOLD_S
    asks(agreement, 1, 5, at - PARKED_S / 2)
    effects = agreed(agreement.acceptor.retry_parked, at)
    assert (answers(effects), effects.must_persist, agreement.acceptor.has_parked) == ([(1, "accepted")], True, False)


@pytest.mark.parametrize(("waited", "expected"), [(0.7, "accepted"), (0.9, Refusal.LEASE)])
def test_it_waits_for_most_of_its_ballot_s_time_and_the_no_still_comes_before_the_end(
    waited: float, expected: str
) -> None:
    agreement = elector()
    at = 100.0 + HOLD_S
    asks(agreement, 1, 5, at - waited * FLEET.timing.ballot_s)
    early = answers(agreed(agreement.acceptor.retry_parked, at - 0.01))
    assert early + answers(agreed(agreement.acceptor.retry_parked, at)) == [(1, expected)]


def test_the_asker_s_next_ballot_ends_the_wait_of_the_one_before_and_an_echo_of_it_does_not() -> None:
    agreement = elector()
    asks(agreement, 1, 5, 100.1)
    effects = asks(agreement, 1, 5, 100.15)
    assert (answers(effects), effects.must_beat) == ([], False), "the same question once more"
    effects = asks(agreement, 2, 6, 100.2)
    assert (answers(effects), effects.must_beat) == ([(1, Refusal.LEASE)], False)
    assert agreement.acceptor.has_parked
    assert answers(agreed(agreement.acceptor.retry_parked, 100.2 + PARKED_S)) == [(2, Refusal.LEASE)]


def test_two_askers_wait_beside_each_other() -> None:
    agreement = elector()
    asks(agreement, 1, 5, 100.1)
    assert answers(asks(agreement, 2, 5, 100.1, "robot2")) == []
    assert sorted(answers(agreed(agreement.acceptor.retry_parked, 100.1 + PARKED_S))) == [
        (1, Refusal.LEASE),
        (2, Refusal.LEASE),
    ]


def test_a_question_that_would_be_refused_anyway_does_not_wait() -> None:
    agreement = elector()
    asks(agreement, 1, 5, 100.1)
    effects = agreed(
        agreement.acceptor.on_accept,
        ev.AcceptAsked(
            request=9,
            asker="robot3",
            accept=Accept(
                task="guard",
                acceptance=Acceptance(ballot=ballot_of(7, "robot3"), value=value(4, "robot3")),
                electorate="another",
            ),
        ),
        100.2,
    )
    assert answers(effects) == [(1, Refusal.LEASE), (9, Refusal.ELECTORATE)]


def test_a_question_that_waits_is_answered_though_no_task_is_exclusive_any_more() -> None:
    """The task may cease to be leased meanwhile. Its deadline must not lie behind us for ever: the loop would spin."""
    node = elector_node()
    ballot = ballot_of(5, "robot3")
    accept = Accept(task="guard", acceptance=Acceptance(ballot=ballot, value=value(4, "robot3")), electorate="e")
    node.handle(ev.AcceptAsked(request=1, asker="robot3", accept=accept), 100.1)
    assert node.agreement.acceptor.has_parked
    node.executors["guard"].is_leased = False
    now = 100.1 + PARKED_S
    told = [one for one in node.handle(ev.DeadlineReached(), now) if isinstance(one, do.AnswerElection)]
    assert [one.request for one in told] == [1]
    assert node.next_deadline() > now


@pytest.mark.parametrize(
    ("node", "epoch", "waits"),
    [("robot2", 3, True), ("robot1", 3, True), ("robot2", 2, False), ("edge1", 3, False)],
)
def test_who_is_overtaken_while_an_elector_asks_this_owner_to_leave_waits_for_a_hold(
    node: str, epoch: int, waits: bool
) -> None:
    """The overtaker's accept waits there, and a ballot of ours would end it."""
    agreement = elector()
    overtaken(agreement)
    asks_to_leave = (("guard", "robot2", epoch), ("stranger", "robot2", 3))
    agreement.note_asked(beat_of(node, 9, asked_to_leave=asks_to_leave), 101.0)
    at = agreement.registers["guard"].next_deadline()
    assert (agreed(agreement.tick, at).send == []) is waits
    if waits:
        assert agreement.registers["guard"].next_deadline() == pytest.approx(101.0 + HOLD_S)
        assert agreed(agreement.tick, 101.0 + HOLD_S).send != []


def test_an_identity_round_does_not_end_the_silence_towards_an_owner_that_is_asked_to_leave() -> None:
    """It is no newer revision, and the next owner may still wait: the present one must not work again before it."""
    agreement, now = elector(), 100.0 + 2 * HOLD_S
    beat = beat_of("robot2", 9, learnt=(("guard", 3, 3),))
    assert agreement.leases.on_beat(beat, {"guard": ("robot2", 3)}, now)
    asks(agreement, 1, 5, now)
    acceptance = Acceptance(ballot=ballot_of(6, "robot2"), value=value(3, "robot2"))
    identity = Accept(task="guard", acceptance=acceptance, electorate="e")
    effects = agreed(agreement.acceptor.on_accept, ev.AcceptAsked(request=2, asker="robot2", accept=identity), now)
    assert answers(effects) == [(2, "accepted")]
    said = agreement.leases.on_sent(1, now + 0.1)
    assert (said.asked_to_leave, said.echoes) == ((("guard", "robot2", 3),), ())


def test_a_node_heeds_a_beat_by_which_an_owner_is_asked_to_leave() -> None:
    node = elector_node()
    overtaken(node.agreement)
    node.handle(ev.BeatReceived(beat=ASKS_TO_LEAVE), 101.0)
    register = node.agreement.registers["guard"]
    assert agreed(node.agreement.tick, register.next_deadline()).send == []
    assert register.next_deadline() == pytest.approx(101.0 + HOLD_S)


def test_a_round_that_nobody_answers_waits_for_no_owner_s_leaving() -> None:
    """Only a ballot that would end another one's accept does."""
    agreement = elector()
    agreed(agreement.propose, "guard", MoveOwner(base_revision=3, owner="robot3", reason="test"), 101.0)
    agreement.note_asked(ASKS_TO_LEAVE, 101.0)
    register = agreement.registers["guard"]
    at = register.next_deadline()
    agreed(agreement.tick, at)
    assert at < register.next_deadline() < 101.0 + HOLD_S
