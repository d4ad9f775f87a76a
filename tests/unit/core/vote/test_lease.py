"""Leases, what the schedules seldom show: who is watched, what is remembered, when somebody must look again."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from support.allocations import allocation_of
from support.beats import beat_of
from support.fleets import fleet_of, task_of, tuning_of
from zsched.core.values.beat import Beat, Grant
from zsched.core.values.fleet import Fleet, lease_terms
from zsched.core.values.in_force import InForce
from zsched.core.values.lease import hold_s
from zsched.core.values.model import Allocation
from zsched.core.vote.lease import HURRY_S, Granter, Leases

NAMES = ("r1", "r2", "r3")
TUNING = tuning_of(cpu=1.0, memory=0.0)
GUARD = task_of("guard", NAMES, tuning=TUNING, exclusive=True)
FLEET = fleet_of(GUARD, of=NAMES, electors=NAMES)
OPEN = replace(FLEET, tasks=(replace(GUARD, exclusive=False),))
L, HOLD_S = FLEET.timing.lease_s, hold_s(FLEET.timing.lease_s)
ACCEPTED = {"guard": ("r2", 3)}


def value(owner: str | None = "r2", *, leased: bool = True) -> Allocation:
    return allocation_of(7, owner, task="guard", epoch=3, tuning=TUNING, leased=leased)


def beat(node: str = "r2", number: int = 5, released: tuple[Grant, ...] = ()) -> Beat:
    return beat_of(node, number, learnt=(("guard", 7, 3),), released=released)


def grant(number: int, owner: str = "r2", epoch: int = 3) -> Grant:
    return Grant(task="guard", owner=owner, incarnation=1, epoch=epoch, number=number)


def elector(fleet: Fleet = FLEET, standing: Allocation | None = None, granted_s: float = 0.0) -> Leases:
    return Leases(
        in_force=InForce(fleet), me="r1", incarnation=1, standing={"guard": standing}, now=0.0, granted_s=granted_s
    )


def granter() -> Granter:
    """One that grants to r2 since 10 s."""
    one = Granter(task="guard", lease_s=L, until=-math.inf, standing=None)
    assert one.on_beat(beat(), ("r2", 3), 10.0)
    return one


def owner(*, echoed: int | None = 5) -> Leases:
    held = Leases(in_force=InForce(FLEET), me="r1", incarnation=1, standing={}, now=0.0)
    held.begin("guard", 3, 5)
    held.on_sent(5, 10.0)
    for name in NAMES[1:] if echoed is not None else ():
        echo = (grant(echoed or 0, "r1"),)
        held.on_beat(replace(beat(name, 9), echoes=echo, lease_terms=lease_terms(FLEET)), {}, 10.1)
    return held


def asked() -> Beat:
    return replace(beat(number=9), asked_to_leave=(("guard", "r1", 3),))


# --- electors --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("leased", "may"), [(True, False), (False, True)])
def test_a_task_that_is_leased_for_everybody_is_watched_whatever_the_elector_s_file_says(
    *, leased: bool, may: bool
) -> None:
    restarted = elector(OPEN, value(leased=leased))
    assert restarted.may_accept("guard", "r2", 0.1)
    assert restarted.may_accept("guard", "r3", 0.1) is may


def test_the_first_value_of_a_generation_waits_for_the_one_before_also_over_a_reload() -> None:
    """By the file the task is not exclusive any more; it may have been in the generation before."""
    first = Allocation(task="guard", revision=1 << 32, epoch=1 << 32, owner=None, tuning=tuning_of())
    one = elector(OPEN, first)
    assert not one.may_accept("guard", "r3", 0.1)
    one.in_force.take(OPEN)
    one.on_tasks({"guard": first}, 0.2)
    assert not one.may_accept("guard", "r3", 0.3)
    assert one.may_accept("guard", "r3", HOLD_S)


def test_once_a_generation_has_an_owner_no_clock_in_doubt_holds_up_a_task_that_is_not_exclusive() -> None:
    first = Allocation(task="guard", revision=1 << 32, epoch=1 << 32, owner=None, tuning=tuning_of())
    one = elector(OPEN, first)
    owned = value(leased=False)
    one.on_newer_value(owned)
    one.doubt({"guard": owned})
    assert one.may_accept("guard", "r3", 2 * HOLD_S)


@pytest.mark.parametrize("is_agreed", [True, False])
def test_a_generation_s_task_that_becomes_exclusive_before_its_first_owner_is_watched(*, is_agreed: bool) -> None:
    """Its file says so, or whoever has proposed the owner."""
    first = Allocation(task="guard", revision=1 << 32, epoch=1 << 32, owner=None, tuning=tuning_of())
    one = elector(OPEN, first)
    if is_agreed:
        one.on_newer_value(value())
    else:
        one.in_force.take(FLEET)
        one.on_tasks({"guard": first}, 0.2)
    owned = value(leased=is_agreed)
    one.on_newer_value(owned)
    one.doubt({"guard": owned})
    assert not one.may_accept("guard", "r3", 2 * HOLD_S)


def test_what_was_granted_under_a_generation_s_first_owner_is_remembered_when_it_needs_no_lease_any_more() -> None:
    one = elector(OPEN, Allocation(task="guard", revision=1 << 32, epoch=1 << 32, owner=None, tuning=tuning_of()))
    one.on_newer_value(value())
    assert one.on_beat(beat(), ACCEPTED, HOLD_S)
    one.on_newer_value(value(leased=False))
    assert not one.may_accept("guard", "r3", HOLD_S + 0.1)


def test_a_task_that_becomes_leased_is_granted_from_then_on_and_not_in_doubt() -> None:
    one = elector(OPEN)
    assert not one.on_beat(beat(), ACCEPTED, 10.0)
    one.on_newer_value(value(leased=False))
    assert not one.on_beat(beat(), ACCEPTED, 10.0)
    one.on_newer_value(value())
    assert one.on_beat(beat(), ACCEPTED, 10.0)
    assert one.on_sent(1, 10.0).echoes == (grant(5),)
    unsure = elector(OPEN)
    unsure.doubt({"guard": None})
    unsure.on_newer_value(value())
    assert not unsure.on_beat(beat(), ACCEPTED, 10.0)


def test_a_newer_value_ends_the_wait_for_which_the_owner_was_silenced() -> None:
    one = elector(standing=value())
    one.on_beat(beat(), ACCEPTED, 10.0)
    assert not one.may_accept("guard", "r3", 10.1)
    assert one.on_sent(1, 10.1).asked_to_leave == (("guard", "r2", 3),)
    one.on_newer_value(value())
    said = one.on_sent(2, 10.2)
    assert (said.asked_to_leave, said.echoes) == ((), (grant(5),))


def test_a_grant_is_echoed_as_long_as_the_lease_and_asked_back_for_twice_the_hold() -> None:
    one = granter()
    assert one.echo(10.0 + L - 0.001) == grant(5)
    assert one.echo(10.0 + L) is None
    assert not one.may_accept("r3", 10.1)
    assert one.asked_to_leave(10.1 + 2 * HOLD_S - 0.001) == ("guard", "r2", 3)


def test_only_a_grant_that_begins_is_worth_a_beat_at_once() -> None:
    one = granter()
    assert not one.on_beat(beat(number=6), ("r2", 3), 10.1)
    assert not one.on_beat(beat("r3"), ("r2", 3), 10.1)
    assert not one.on_beat(beat(), None, 10.1)
    assert one.echo(10.1) == grant(6)


@pytest.mark.parametrize(("number", "is_free"), [(4, False), (5, True), (6, True)])
def test_a_release_frees_what_it_covers(number: int, *, is_free: bool) -> None:
    one = granter()
    one.on_beat(beat("r2", 6, released=(grant(number),)), None, 10.1)
    assert (one.echo(10.1) is None) is is_free
    assert one.may_accept("r3", 10.1) is is_free


@pytest.mark.parametrize(
    ("by", "given_back"), [("r3", grant(5)), ("r2", replace(grant(5), task="other")), ("r2", grant(5, "r3"))]
)
def test_nobody_gives_back_another_one_s_grant_or_another_task_s(by: str, given_back: Grant) -> None:
    one = granter()
    one.on_beat(beat(by, 5, released=(given_back,)), None, 10.1)
    assert one.echo(10.1) == grant(5)
    assert not one.may_accept("r3", 10.1)


def test_a_life_gives_back_its_own_grants_only() -> None:
    """And what it says of others fills no memory."""
    one = Granter(task="guard", lease_s=L, until=-math.inf, standing=None)
    others = tuple(replace(grant(5), incarnation=life) for life in range(2, 152))
    one.on_beat(beat("r2", 5, released=others), None, 10.0)
    assert one._released == {}
    assert one.on_beat(replace(beat("r2", 5), incarnation=2), ("r2", 3), 10.1)


def test_a_beat_that_is_repeated_or_of_a_silenced_owner_prolongs_no_hold() -> None:
    one = granter()
    assert not one.on_beat(beat(), ("r2", 3), 10.5, is_newest=False)
    assert one.echo(10.0 + L) is None
    assert not one.may_accept("r3", 10.6)
    assert not one.on_beat(beat(number=6), ("r2", 3), 10.7)
    assert one.may_accept("r3", 10.0 + HOLD_S)


def test_silence_is_towards_the_owner_that_was_asked_only() -> None:
    one = granter()
    assert not one.may_accept("r3", 10.0 + HOLD_S - 0.1)
    assert one.on_beat(beat("r3"), ("r3", 3), 10.0 + HOLD_S)
    assert one.echo(10.0 + HOLD_S) == grant(5, "r3")


def test_the_epoch_that_counts_is_that_of_the_task() -> None:
    one = Granter(task="guard", lease_s=L, until=-math.inf, standing=None)
    told = replace(beat(), learnt=(("other", 9, 3), ("guard", 7, 2)))
    assert not one.on_beat(told, ("r2", 3), 10.0)
    assert one.on_beat(replace(told, learnt=(("other", 9, 2), ("guard", 7, 3))), ("r2", 3), 10.0)


def test_who_is_no_elector_grants_nothing() -> None:
    one = Leases(in_force=InForce(FLEET), me="r1", incarnation=1, standing={}, now=0.0)
    one.on_newer_value(value())
    assert not one.on_beat(beat(), ACCEPTED, 10.0)
    assert one.on_sent(1, 10.0).echoes == ()
    assert elector().on_sent(1, 10.0).echoes == (), "nor an elector before the first beat"


def test_any_number_is_granted_before_anything_was_given_back() -> None:
    one = Granter(task="guard", lease_s=L, until=-math.inf, standing=None)
    assert one.on_beat(beat(number=0), ("r2", 3), 10.0)


def test_a_release_before_any_grant_holds_too() -> None:
    one = Granter(task="guard", lease_s=L, until=-math.inf, standing=None)
    assert not one.on_beat(beat("r2", 5, released=(grant(5),)), ("r2", 3), 10.0)
    assert one.on_beat(beat("r2", 6), ("r2", 3), 10.0)


def test_what_may_be_granted_is_on_disk_before_it_is() -> None:
    assert elector().is_news(L / 2)
    assert not elector().is_news(L)
    assert not elector(OPEN).is_news(0.0), "nothing is granted here"


def test_a_longer_lease_of_the_life_before_is_remembered_until_it_is_over() -> None:
    long_s = 5 * L
    one = elector(granted_s=long_s)
    assert one.to_remember_s(hold_s(long_s) - 0.001) == long_s
    assert one.to_remember_s(hold_s(long_s)) == L
    assert elector(granted_s=L / 2).to_remember_s(0.0) == L
    assert one.over_at == hold_s(long_s)


def test_an_elector_looks_again_when_it_could_accept_another_owner() -> None:
    one = elector(standing=value())
    assert one.next_deadline(0.1) == HOLD_S
    assert one.next_deadline(HOLD_S) == math.inf
    one.on_beat(beat(), ACCEPTED, 10.0)
    assert one.next_deadline(10.1) == 10.0 + HOLD_S
    assert one.next_deadline(10.0 + HOLD_S) == math.inf


# --- owners ----------------------------------------------------------------------------------------------------------


def test_the_same_epoch_once_more_keeps_the_lease_and_another_one_begins_without() -> None:
    held = owner()
    held.begin("guard", 3, 9)
    assert held.until("guard") == 10.0 + L
    held.begin("guard", 4, 9)
    assert held.until("guard") == -math.inf


def test_a_leaving_owner_looks_again_when_what_its_worker_was_given_is_over() -> None:
    held = owner()
    held.on_given("guard", 11.0)
    assert held.next_deadline(10.2) == math.inf, "nobody asked it to leave"
    held.on_beat(asked(), {}, 10.2)
    assert held.next_deadline(10.2) == 11.0
    assert held.next_deadline(11.0) == math.inf


def test_a_worker_s_word_counts_only_when_it_was_asked_to_stop_and_ends_what_it_was_given() -> None:
    held = owner()
    held.on_given("guard", 11.0)
    assert not held.on_stopped("guard", 3, 5), "nobody asked"
    assert not held.on_stopped("other", 3, 5)
    assert not held.on_run_out("other", 5, 12.0)
    held.on_told_to_stop("other")  # it only drains there, for its clock is in doubt
    held.on_beat(asked(), {}, 10.2)
    assert not held.on_stopped("guard", 3, 5), "nobody has told it to stop yet: this is another stop's word"
    held.on_told_to_stop("guard")
    assert not held.on_stopped("guard", 2, 5)
    assert held.on_stopped("guard", 3, 5)
    assert held.given_until("guard") == -math.inf
    assert held.leaving() == ()
    assert held.on_sent(6, 10.3).released == (grant(5, "r1"),)
    assert not held.on_run_out("guard", 6, 12.0), "it has given everything back"
    held.begin("guard", 4, 7)
    assert held.on_sent(7, 12.0).released == (), "what another epoch gave back is over"


def test_a_word_that_has_come_is_not_waited_for_any_more() -> None:
    """Else the next beat would give back at once what nobody has used, and the next word would not be believed."""
    held = owner()
    held.on_beat(asked(), {}, 10.2)
    held.on_told_to_stop("guard")
    assert held.on_stopped("guard", 3, 5)
    held.on_sent(6, 10.3)
    held.on_beat(asked(), {}, 10.3)
    assert held.on_run_out("guard", 6, 10.3), "now and then it is worth a beat"
    held.on_sent(7, 10.31)
    held.on_beat(asked(), {}, 10.31)
    assert not held.on_run_out("guard", 7, 10.31)
    held.on_sent(8, 10.32)
    held.on_beat(asked(), {}, 10.32)
    assert held.on_stopped("guard", 3, 8)


def test_a_node_that_owns_nothing_has_no_lease_and_is_asked_for_none() -> None:
    held = Leases(in_force=InForce(FLEET), me="r1", incarnation=1, standing={}, now=0.0)
    assert not held.on_beat(asked(), {}, 10.2)
    assert (held.until("guard"), held.given_until("guard"), held.leaving()) == (-math.inf, -math.inf, ())


def test_what_was_given_is_worth_a_beat_when_it_has_run_out_and_nothing_only_now_and_then() -> None:
    held = owner()

    def run_out(number: int, now: float) -> bool:
        held.on_sent(number, now)
        held.on_beat(asked(), {}, now)
        return held.on_run_out("guard", number, now)

    held.on_given("guard", 11.0)
    assert [run_out(6, 11.0), run_out(7, 11.0), run_out(8, 11.0 + HURRY_S / 2)] == [True, True, False]
    assert run_out(9, 11.0 + 1.5 * HURRY_S)
    assert not run_out(10, 11.0 + 2 * HURRY_S)


LONG_S = 3.0
"""The length of leases before it was made shorter: `L`."""
LONG = replace(FLEET, timing=replace(FLEET.timing, lease_s=LONG_S))
WITHOUT = replace(FLEET, tasks=(replace(GUARD, name="other", exclusive=False),))
R2_HOLDS_UNTIL = 10.0 + LONG_S
"""r2 sent beat 5 at 10 s, and two of three electors have echoed it: its worker may work until then."""


def granting() -> Leases:
    """An elector that has echoed beat 5 of r2 at 10 s, under long leases."""
    one = Leases(in_force=InForce(LONG), me="r1", incarnation=1, standing={"guard": value()}, now=0.0)
    sent = replace(beat(), lease_terms=lease_terms(LONG))
    assert one.on_beat(sent, ACCEPTED, 10.0)
    return one


def test_what_was_granted_before_three_changes_within_a_lease_still_excludes_others() -> None:
    """The lease is made shorter, its task removed and created again: r3 is not accepted while r2 may be at work."""
    one = granting()
    one.count_with(NAMES, terms="t/2", number=2, lease_s=L, standing={"guard": None}, guard_lease_s=LONG_S)
    one.in_force.take(WITHOUT)
    one.on_tasks({"other": None}, 10.2)
    one.in_force.take(FLEET)
    one.on_tasks({"guard": None, "other": None}, 10.4)
    assert not one.may_accept("guard", "r3", R2_HOLDS_UNTIL - 0.01)
    assert one.may_accept("guard", "r3", 10.4 + hold_s(LONG_S))


def test_an_elector_that_never_knew_of_long_leases_waits_for_them_too() -> None:
    """The electors may be others by then: all of them go by what the fleet value says may still run."""
    one = Leases(in_force=InForce(WITHOUT), me="r1", incarnation=1, standing={"other": None}, now=0.0)
    one.count_with(NAMES, terms="t/4", number=4, lease_s=L, standing={"other": None}, guard_lease_s=LONG_S)
    one.in_force.take(FLEET)
    one.on_tasks({"guard": None, "other": None}, 10.4)
    assert not one.may_accept("guard", "r3", R2_HOLDS_UNTIL - 0.01)
    one.count_with(NAMES, terms="t/4", number=4, lease_s=L, standing={"guard": None}, guard_lease_s=L)
    one.in_force.take(WITHOUT)
    one.on_tasks({"other": None}, 20.0)
    one.in_force.take(FLEET)
    one.on_tasks({"guard": None, "other": None}, 20.0)
    assert one.may_accept("guard", "r3", 20.0 + HOLD_S), "a guard time was waited for meanwhile"


def test_the_release_of_a_task_that_has_gone_is_in_no_beat_any_more() -> None:
    """Else beats grow by one for each exclusive task that was ever removed."""
    held = owner()
    held.end("guard", 6)
    held.in_force.take(FLEET)
    held.on_tasks({"guard": value("r2")}, 10.2)
    assert [one.task for one in held.on_sent(7, 10.3).released] == ["guard"]
    held.in_force.take(WITHOUT)
    held.on_tasks({"other": None}, 10.4)
    assert held.on_sent(8, 10.5).released == ()


def test_a_task_that_stays_in_the_fleet_waits_for_no_lease_again() -> None:
    one = elector()
    assert one.may_accept("guard", "r3", 100.0)
    one.in_force.take(FLEET)
    one.on_tasks({"guard": None}, 100.0)
    assert one.may_accept("guard", "r3", 100.0)
