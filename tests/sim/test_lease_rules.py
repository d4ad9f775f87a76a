"""The lease's rules one by one: each clause of the design that a schedule may take long to find broken."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from support.todos import done, todo_of
from zsched.core.executor.handover import Executor
from zsched.core.executor.tenure import Tenure
from zsched.core.values import instructions as do
from zsched.core.values.beat import Beat, Grant
from zsched.core.values.fleet import Fleet, WorkerSpec, lease_terms
from zsched.core.values.in_force import InForce
from zsched.core.values.instructions import SetRole
from zsched.core.values.lease import RHO, hold_s
from zsched.core.values.plan import WorkerRole
from zsched.core.vote.lease import LIVES_KEPT, SENT_KEPT, Granter, Holder, Leases

LEASE_S, HOLD_S = 1.0, hold_s(1.0)
ELECTORS = ("r1", "r2", "r3")


def beat(node: str = "e1", number: int = 5, *, epoch: int = 3, life: int = 1, released: tuple[Grant, ...] = ()) -> Beat:
    return beat_of(node, number, incarnation=life, learnt=(("guard", 7, epoch),), released=released)


def grant(number: int, *, owner: str = "e1", epoch: int = 3, life: int = 1) -> Grant:
    return Grant(task="guard", owner=owner, incarnation=life, epoch=epoch, number=number)


def granter(standing: str | None = "e1", started_at: float = 0.0) -> Granter:
    return Granter(task="guard", lease_s=LEASE_S, until=started_at + HOLD_S, standing=standing)


def holder(first_number: int = 5) -> Holder:
    return Holder(
        task="guard", epoch=3, me="e1", incarnation=1, electors=ELECTORS, lease_s=LEASE_S, first_number=first_number
    )


# --- electors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("accepted", "is_echoed"),
    [(("e1", 3), True), (("e1", 4), False), (("e1", 2), False), (("e2", 3), False), (None, False)],
)
def test_only_the_accepted_owner_of_the_accepted_epoch_is_echoed(
    accepted: tuple[str, int] | None, is_echoed: bool
) -> None:
    elector = granter()
    elector.on_beat(beat(), accepted, 10.0)
    assert (elector.echo(10.0) is not None) == is_echoed


def test_another_owner_is_refused_until_the_hold_after_the_last_grant_is_over() -> None:
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat(number=6), ("e1", 3), 10.5)
    assert elector.may_accept("e1", 10.6)
    assert not elector.may_accept("e2", 10.5 + HOLD_S - 0.001)
    assert elector.may_accept("e2", 10.5 + HOLD_S)


def test_what_an_owner_s_last_lives_have_released_is_known_and_no_more() -> None:
    """An elector kept a number for each life of its owner, as long as it ran."""
    elector = granter()
    for life in range(1, 4 * LIVES_KEPT):
        elector.on_beat(beat(number=9, life=life, released=(grant(9, life=life),)), None, 10.0)
        elector.on_beat(beat("e2", released=(grant(5, owner="e2"),)), None, 10.0)
    assert len(elector._released) == LIVES_KEPT + 1
    for life in (3 * LIVES_KEPT, 4 * LIVES_KEPT - 1):
        elector.on_beat(beat(number=9, life=life), ("e1", 3), 20.0)
        assert elector.echo(20.0) is None, "a released number is never granted again"


def test_the_hold_covers_a_whole_lease_on_the_slowest_clock() -> None:
    """The owner's clock may be slow by rho and ours fast by rho: the lease ends before the hold does."""
    assert HOLD_S / (1 + RHO) >= LEASE_S / (1 - RHO) - 1e-12


def test_a_restarted_elector_refuses_all_but_its_standing_owner_for_a_whole_hold() -> None:
    elector = granter(standing="e1", started_at=100.0)
    assert elector.may_accept("e1", 100.0)
    assert not elector.may_accept("e2", 100.0 + HOLD_S - 0.001)
    assert elector.may_accept("e2", 100.0 + HOLD_S)


def test_a_restarted_elector_echoes_nobody_for_a_whole_hold() -> None:
    """Found by the simulator (seed 74): it had granted to the owner's life before, and to the next one at once."""
    elector = granter(standing="e1", started_at=100.0)
    elector.on_beat(beat(number=5), ("e1", 3), 100.0 + HOLD_S - 0.001)
    assert elector.echo(100.0 + HOLD_S - 0.001) is None
    elector.on_beat(beat(number=6), ("e1", 3), 100.0 + HOLD_S)
    assert elector.echo(100.0 + HOLD_S) == grant(6)


def test_another_owner_is_granted_only_after_the_hold_though_it_was_learnt_and_not_accepted() -> None:
    """An elector that learns of a move has refused nobody: without this two leases overlap by its grant."""
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat("e2", 8, epoch=4), ("e2", 4), 10.0 + HOLD_S - 0.001)
    assert elector.echo(10.9) == grant(5)
    elector.on_beat(beat("e2", 9, epoch=4), ("e2", 4), 10.0 + HOLD_S)
    assert elector.echo(10.0 + HOLD_S) == grant(9, owner="e2", epoch=4)


def test_refusing_silences_the_present_owner_and_asks_it_to_leave_for_twice_the_hold() -> None:
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    assert not elector.may_accept("e2", 10.1)
    assert elector.echo(10.1) is None
    assert elector.asked_to_leave(10.1) == ("guard", "e1", 3)
    elector.on_beat(beat(number=6), ("e1", 3), 10.2)
    assert elector.echo(10.2) is None, "no new grant meanwhile either"
    assert elector.asked_to_leave(10.1 + 2 * HOLD_S) is None
    elector.on_beat(beat(number=7), ("e1", 3), 10.1 + 2 * HOLD_S)
    assert elector.echo(10.1 + 2 * HOLD_S) == grant(7)


def test_a_release_frees_the_elector_and_its_numbers_are_never_granted_again() -> None:
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat(number=8, released=(grant(8),)), ("e1", 3), 10.1)
    assert elector.may_accept("e2", 10.1)
    elector.on_beat(beat(number=7), ("e1", 3), 10.2)  # overtaken on its way
    assert elector.echo(10.2) is None
    assert elector.may_accept("e2", 10.2)


@pytest.mark.parametrize("other", [grant(9, life=2), grant(4), grant(9, owner="e9")])
def test_a_release_of_another_life_number_or_owner_frees_nothing(other: Grant) -> None:
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat(number=0, life=2, released=(other,)), ("e1", 3), 10.1)
    assert not elector.may_accept("e2", 10.2)


@pytest.mark.parametrize("number", [5, 6])
def test_nobody_gives_back_numbers_that_it_has_not_sent_yet(number: int) -> None:
    """One forged beat, a late one, too: the owner got no lease any more as long as its daemon lived."""
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat(number=number, released=(grant(2**50),)), ("e1", 3), 10.1, is_newest=number > 5)
    assert not elector.may_accept("e2", 10.1 + HOLD_S / 2)
    elector = granter()
    elector.on_beat(beat(number=number, released=(grant(2**50),)), ("e1", 3), 10.1)
    elector.on_beat(beat(number=7), ("e1", 3), 10.2)
    assert elector.echo(10.2) == grant(7)


def test_the_owner_s_next_life_is_granted_only_when_its_former_one_cannot_work_any_more() -> None:
    elector = granter()
    elector.on_beat(beat(number=5, life=1), ("e1", 3), 10.0)
    elector.on_beat(beat(number=1, life=2), ("e1", 3), 10.5)
    assert elector.echo(10.5) == grant(5)
    elector.on_beat(beat(number=2, life=2), ("e1", 3), 10.0 + HOLD_S)
    assert elector.echo(10.0 + HOLD_S) == grant(2, life=2)


def test_an_old_beat_prolongs_nothing() -> None:
    elector = granter()
    elector.on_beat(beat(number=5), ("e1", 3), 10.0)
    elector.on_beat(beat(number=4), ("e1", 3), 10.9, is_newest=False)
    assert elector.may_accept("e2", 10.0 + HOLD_S)


def test_true_numbers_behind_a_forged_one_are_granted_again() -> None:
    """Found by the simulator (seed 9003597): a beat of 2^52 in the owner's name, and an elector granted no more."""
    elector = granter()
    elector.on_beat(beat(number=2**52), ("e1", 3), 10.0)
    elector.on_beat(beat(number=9), ("e1", 3), 10.1, is_newest=False)
    assert elector.echo(10.1) == grant(2**52), "of what is not believed, nothing follows"
    elector.on_beat(beat(number=10), ("e1", 3), 10.2)
    assert elector.echo(10.2) == grant(10)
    assert not elector.may_accept("e2", 10.1 + HOLD_S), "it is held for as long as after any grant"
    elector.on_beat(beat(number=11, released=(grant(11),)), ("e1", 3), 10.3)
    assert elector.may_accept("e2", 10.3), "what the owner gives back is all of it"


# --- owners ----------------------------------------------------------------------------------------------------------


def test_numbers_sent_before_the_epoch_was_learnt_count_nothing() -> None:
    owner = holder(first_number=5)
    owner.on_sent(4, 10.0)
    for elector in ELECTORS:
        owner.on_echo(elector, grant(4))
    assert owner.lease_until() == -math.inf


def test_the_lease_runs_from_the_sending_of_the_number_that_a_majority_has_reached() -> None:
    owner = holder()
    for number in range(5, 9):
        owner.on_sent(number, 10.0 + 0.2 * (number - 5))
    owner.on_echo("r1", grant(8))
    assert owner.lease_until() == -math.inf, "one elector of three is no majority"
    owner.on_echo("r2", grant(6))
    assert owner.lease_until() == pytest.approx(10.2 + LEASE_S)
    owner.on_echo("r3", grant(7))
    assert owner.lease_until() == pytest.approx(10.4 + LEASE_S)


@pytest.mark.parametrize("echo", [grant(5, life=2), grant(5, epoch=2), grant(5, owner="e2")])
def test_an_echo_of_another_life_epoch_or_owner_counts_nothing(echo: Grant) -> None:
    owner = holder()
    owner.on_sent(5, 10.0)
    for elector in ELECTORS:
        owner.on_echo(elector, echo)
    assert owner.lease_until() == -math.inf


def test_a_stranger_s_echo_counts_nothing_and_an_elector_s_only_once() -> None:
    owner = holder()
    owner.on_sent(5, 10.0)
    for elector in ("r1", "r1", "e2", "ghost"):
        owner.on_echo(elector, grant(5))
    assert owner.lease_until() == -math.inf


def test_an_echo_of_what_was_not_sent_yet_never_counts() -> None:
    """Found by the simulator (seed 8004705): beats in the owner's name, of numbers to come, made electors hold less."""
    owner = holder()
    owner.on_sent(5, 10.0)
    for number in (9, 7):
        for elector in ELECTORS[:2]:
            owner.on_echo(elector, grant(number))
    for number in range(6, 10):
        owner.on_sent(number, 10.0 + 0.1 * (number - 5))
        for elector in ELECTORS[:2]:
            for echoed in (9, 7):
                owner.on_echo(elector, grant(echoed))
    assert owner.lease_until() == -math.inf
    for elector in ELECTORS[:2]:
        owner.on_echo(elector, grant(8))
    assert owner.lease_until() == pytest.approx(10.3 + LEASE_S), "that one it has from us"


def test_however_many_numbers_somebody_makes_an_elector_echo_the_next_ones_are_known() -> None:
    owner = holder()
    owner.on_sent(5, 10.0)
    for number in range(5 + 2 * SENT_KEPT, 5, -1):
        owner.on_echo("r1", grant(number))
        owner.on_echo("r2", grant(number))
    for number in range(6, 6 + SENT_KEPT):
        owner.on_sent(number, 10.1)
        owner.on_echo("r1", grant(number))
        owner.on_echo("r2", grant(number))
        assert owner.lease_until() == -math.inf


def test_what_was_given_back_holds_no_lease_any_more() -> None:
    owner = holder()
    owner.on_sent(5, 10.0)
    for elector in ELECTORS:
        owner.on_echo(elector, grant(5))
    assert owner.release(6) == grant(6)
    assert owner.lease_until() == -math.inf
    owner.on_echo("r1", grant(6))
    assert owner.lease_until() == -math.inf


GUARD = task_of(
    "guard", ELECTORS, tuning=tuning_of(cpu=1.0, memory=0.0), worker=WorkerSpec(command=("true",)), exclusive=True
)
FLEET = fleet_of(GUARD, of=ELECTORS, electors=ELECTORS)


def leases() -> Leases:
    held = Leases(in_force=InForce(FLEET), me="r1", incarnation=1, standing={}, now=10.0)
    held.begin("guard", 3, 5)
    held.on_sent(5, 10.0)
    return held


def ask(*, epoch: int = 3) -> Beat:
    return replace(beat("r2", 9), asked_to_leave=(("guard", "r1", epoch),))


def echo(elector: str, number: int) -> Beat:
    return replace(beat(elector, 9), echoes=(grant(number, owner="r1"),), lease_terms=lease_terms(FLEET))


def test_an_owner_is_asked_to_leave_whatever_it_has_heard_of_its_grants() -> None:
    """An elector that granted and was told of the next owner before its beat left never echoes that grant."""
    held = leases()
    held.on_beat(ask(), {}, 10.1)
    assert held.leaving() == ("guard",)
    assert held.on_stopped("guard", 3, 5)
    held.on_beat(ask(), {}, 10.2)
    assert held.leaving() == (), "nothing was sent since"
    held.on_sent(6, 10.3)
    held.on_beat(ask(), {}, 10.3)
    assert held.leaving() == ("guard",), "this one may have been granted"


@pytest.mark.parametrize(
    "other",
    [
        replace(FLEET, electors=("r1", "r2")),
        replace(FLEET, timing=replace(FLEET.timing, lease_s=2 * FLEET.timing.lease_s)),
        None,
    ],
    ids=["other electors", "another length", "none told"],
)
def test_an_echo_counts_only_under_the_owner_s_own_electors_and_length(other: Fleet | None) -> None:
    """The majority of other electors need not meet the one that granted to this node's earlier life."""
    held = leases()
    terms = "" if other is None else lease_terms(other)
    for elector in ELECTORS:
        held.on_beat(replace(echo(elector, 5), lease_terms=terms), {}, 10.1)
    assert held.until("guard") == -math.inf
    assert set(held.unfit()) == set(ELECTORS)
    for elector in ELECTORS:
        held.on_beat(echo(elector, 5), {}, 10.1)
    assert held.until("guard") == 10.0 + FLEET.timing.lease_s
    assert held.unfit() == {}


def test_giving_back_what_was_never_used_is_worth_a_beat_only_now_and_then() -> None:
    """Two owners that ask each other to leave would answer every beat with a beat (seed 1031212)."""
    held = leases()
    held.on_beat(ask(), {}, 10.1)
    assert held.on_run_out("guard", 5, 10.1)
    assert held.on_sent(6, 10.1).released == (grant(5, owner="r1"),)
    held.on_beat(ask(), {}, 10.11)
    assert not held.on_run_out("guard", 6, 10.11)
    assert held.on_sent(7, 10.2).released == (grant(6, owner="r1"),), "it is given back all the same"
    held.on_given("guard", 11.2)
    held.on_beat(ask(), {}, 10.21)
    assert held.on_run_out("guard", 7, 10.21), "a worker has been at work: who waits should know at once"


def test_a_worker_that_never_says_that_it_has_stopped_is_waited_for_once() -> None:
    """Its silence made every giving back urgent, and two owners that ask each other to leave storm again (1073981)."""
    held = leases()
    held.on_given("guard", 10.9)
    held.on_told_to_stop("guard")
    held.on_beat(ask(), {}, 10.1)
    assert held.on_run_out("guard", 5, 11.0)
    assert held.on_sent(6, 11.0).released == (grant(5, owner="r1"),)
    held.on_beat(ask(), {}, 11.01)
    held.on_run_out("guard", 6, 11.01)
    held.on_sent(7, 11.02)
    held.on_beat(ask(), {}, 11.02)
    assert held.leaving() == ("guard",)
    assert not held.on_run_out("guard", 7, 11.02)
    held.on_sent(8, 11.03)
    held.on_beat(ask(), {}, 11.03)
    assert held.leaving() == ("guard",)
    assert not held.on_stopped("guard", 3, 8), "when it comes, it is of a stop that is over"


def test_an_owner_is_not_asked_to_leave_for_another_epoch_s_sake() -> None:
    held = leases()
    held.on_beat(ask(epoch=2), {}, 10.1)
    assert held.leaving() == ()


def test_what_the_worker_was_told_ends_with_its_stop_and_not_with_the_echoes() -> None:
    held = leases()
    held.on_given("guard", 11.0)
    held.on_beat(ask(), {}, 10.1)
    assert held.given_until("guard") == 11.0
    held.on_told_to_stop("guard")
    assert held.on_stopped("guard", 3, 5)
    assert held.given_until("guard") == -math.inf


def worked(tenure: Tenure, number: int, now: float) -> None:
    """A majority echoes the beat ``number`` that has just left: the worker works (again)."""
    tenure.leases.on_sent(number, now)
    for elector in ("r1", "r2"):
        tenure.leases.on_beat(echo(elector, number), {}, now)
    roles, _ = tended(tenure, number, now)
    assert [one.role.role for one in roles if isinstance(one, SetRole)] == [WorkerRole.ACTIVE]


def asked(tenure: Tenure, number: int, now: float) -> None:
    """An elector asks the owner to leave, and its worker is told to stop."""
    tenure.leases.on_beat(ask(), {}, now)
    roles, has_released = tended(tenure, number, now)
    assert [one.role.role for one in roles if isinstance(one, SetRole)] == [WorkerRole.IDLE]
    assert not has_released


def tended(tenure: Tenure, number: int, now: float) -> tuple[list[do.Instruction], bool]:
    """(what to do, whether something was given back)."""
    todo = todo_of(tenure.tend_leases, number, now)
    return todo.apply + todo.send, todo.must_beat


def tenured() -> Tenure:
    executor = Executor(spec=GUARD, me="r1", has_streams=True)
    done(executor.execute, allocation_of(7, "r1", task="guard", epoch=3, tuning=GUARD.tuning), 10.0)
    return Tenure(in_force=InForce(FLEET), me="r1", leases=leases(), executors={"guard": executor})


def test_the_late_word_of_an_earlier_stop_does_not_give_back_the_lease_that_came_after_it() -> None:
    """A slow worker outlasts its lease, is given another one in its epoch, and only then its first stop is told."""
    tenure = tenured()
    worked(tenure, 6, 10.0)
    asked(tenure, 6, 10.1)
    assert tended(tenure, 6, 11.0) == ([], True), "the lease is over, whatever the worker says"
    worked(tenure, 7, 12.0)
    asked(tenure, 7, 12.1)
    assert not tenure.leases.on_stopped("guard", 3, 7), "this may be the first stop's word"
    assert tenure.leases.given_until("guard") == 13.0
    assert tended(tenure, 7, 12.99) == ([], False)
    assert tended(tenure, 7, 13.0) == ([], True)


def test_the_word_of_a_stop_before_the_first_lease_is_not_taken_for_a_later_one_s() -> None:
    tenure = tenured()
    tenure.leases.on_beat(ask(), {}, 10.1)
    assert tended(tenure, 5, 10.1)[1], "nothing was given yet"
    worked(tenure, 6, 12.0)
    asked(tenure, 6, 12.1)
    assert not tenure.leases.on_stopped("guard", 3, 6)


def test_the_word_of_a_process_that_is_dead_does_not_speak_for_the_next_one() -> None:
    tenure = tenured()
    worked(tenure, 6, 10.0)
    tenure.leases.on_worker_lost("guard")
    asked(tenure, 6, 10.3)
    assert not tenure.leases.on_stopped("guard", 3, 6)
    assert tended(tenure, 6, 11.0) == ([], True)


def test_stops_that_are_told_in_time_are_believed_again_and_again() -> None:
    tenure = tenured()
    for number, now in ((6, 10.0), (7, 12.0), (8, 14.0)):
        worked(tenure, number, now)
        asked(tenure, number, now + 0.1)
        assert tenure.leases.on_stopped("guard", 3, number)


def test_an_owner_that_is_asked_again_gives_back_at_once_when_its_worker_has_stopped_already() -> None:
    """Found by the simulator (seed 60191): it waited for a second stop, and echoes prolonged the wait for ever."""
    held = leases()
    executor = Executor(spec=GUARD, me="r1", has_streams=True)
    done(executor.execute, allocation_of(7, "r1", task="guard", epoch=3, tuning=GUARD.tuning), 10.0)
    tenure = Tenure(in_force=InForce(FLEET), me="r1", leases=held, executors={"guard": executor})
    for elector in ("r1", "r2"):
        held.on_beat(echo(elector, 5), {}, 10.01)
    roles, _ = tended(tenure, 5, 10.01)
    assert [one.role.role for one in roles if isinstance(one, SetRole)] == [WorkerRole.ACTIVE]
    held.on_beat(ask(), {}, 10.02)
    _, has_released = tended(tenure, 5, 10.02)
    assert not has_released, "the worker is still at it"
    assert held.on_stopped("guard", 3, 5)
    held.on_sent(6, 10.03)
    for elector in ("r1", "r2"):
        held.on_beat(echo(elector, 6), {}, 10.04)
    held.on_beat(ask(), {}, 10.04)
    roles, has_released = tended(tenure, 6, 10.04)
    assert has_released
    assert roles == []
