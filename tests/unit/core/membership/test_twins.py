"""Beats in our own name: whose wait is whose, when several others have used it."""

from __future__ import annotations

from dataclasses import replace

from support.beats import beat_of
from support.fleets import fleet_of
from zsched.core.membership.identity import (
    ASK_TWINS_S,
    QUIET_S,
    STAYS_S,
    TOLD_FOR_S,
    TOLD_YOUNG_S,
    YOUNG_S,
    Identity,
    Verdict,
)
from zsched.core.values.beat import Beat
from zsched.core.values.in_force import InForce

BEAT_S = 0.5
HERE = InForce(replace(fleet_of(), timing=replace(fleet_of().timing, beat_s=BEAT_S)))
STAYS = int(STAYS_S / BEAT_S)
"""So many beats are as long."""


def beat(incarnation: int, sequence: int) -> Beat:
    return beat_of("robot1", sequence, incarnation=incarnation)


def old() -> Identity:
    """A daemon that has run for a long time; two others of its name are there."""
    identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=0.0)
    for incarnation in (8, 9):
        identity.on_token(incarnation, is_present=True)
    return identity


def test_the_next_twin_s_wait_begins_with_its_own_first_beat() -> None:
    identity = old()
    assert identity.on_own_name(beat(8, 10), 5000, 100.0) is Verdict.TWIN
    after = 100.0 + STAYS_S + 1.0
    assert identity.on_own_name(beat(9, 50), 5000, after) is Verdict.TWIN
    assert identity.on_own_name(beat(9, 51), 5000, after + 0.1) is Verdict.TWIN
    assert identity.on_own_name(beat(9, 60), 5000, after + STAYS_S) is Verdict.DISPUTE


def test_a_twin_that_stays_disputes_the_name_at_the_very_end_of_its_time() -> None:
    identity = old()
    assert identity.on_own_name(beat(8, 10), 5000, 100.0) is Verdict.TWIN
    assert identity.on_own_name(beat(8, 11), 5000, 100.0 + STAYS_S - 0.01) is Verdict.TWIN
    assert identity.on_own_name(beat(8, 10), 5000, 100.0 + STAYS_S) is Verdict.TWIN, "it has not risen"
    assert identity.on_own_name(beat(8, 10 + STAYS), 5000, 100.0 + STAYS_S) is Verdict.DISPUTE


def test_a_node_that_stood_still_while_a_twin_came_and_left_disputes_nothing() -> None:
    """It handles the last beat of the twin's few long after the first one, and before the end of its token."""
    identity = old()
    assert identity.on_own_name(beat(8, 10), 5000, 100.0) is Verdict.TWIN
    assert identity.on_own_name(beat(8, 10 + STAYS - 1), 5000, 100.0 + 2 * STAYS_S) is Verdict.TWIN
    assert identity.on_own_name(beat(8, 10 + STAYS), 5000, 100.0 + 2 * STAYS_S) is Verdict.DISPUTE


def test_beats_in_our_name_are_shown_until_they_have_stopped_for_long_enough() -> None:
    identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=0.0)
    assert identity.complaint(100.0) is None
    identity.on_own_name(beat(8, 10), 5000, 100.0)
    assert "no daemon of that name is seen" in (identity.complaint(100.0 + QUIET_S - 0.001) or "")
    assert identity.complaint(100.0 + QUIET_S) is None


def test_of_two_that_meet_the_one_that_has_beaten_less_leaves_while_it_is_young() -> None:
    for mine, theirs, verdict in ((5, 11, Verdict.LEAVE), (20, 11, Verdict.TWIN)):
        identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=100.0)
        identity.on_token(8, is_present=True)
        assert identity.on_own_name(beat(8, theirs - 1), mine, 100.5) is Verdict.TWIN
        assert identity.on_own_name(beat(8, theirs), mine, 100.0 + YOUNG_S - 0.01) is verdict
    identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=100.0)
    identity.on_token(8, is_present=True)
    identity.on_own_name(beat(8, 10), 5, 100.5)
    assert identity.on_own_name(beat(8, 11), 5, 100.0 + YOUNG_S) is Verdict.TWIN, "not young any more"


# --- twins that do not hear each other: a peer's answers -------------------------------------------------------------


def test_a_twin_that_is_told_so_for_long_enough_leaves_if_it_came_later() -> None:
    for mine, verdict in ((20, Verdict.LEAVE), (1000, Verdict.TWIN)):
        identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=100.0)
        assert identity.on_told("robot2", {7: mine, 6: 500}, mine, 102.0) is Verdict.TWIN, "one answer is one frame"
        assert identity.on_told("robot2", {7: mine, 6: 500}, mine, 102.2) is Verdict.TWIN, "it has not risen"
        assert identity.on_told("robot3", {7: mine, 6: 501}, mine, 102.0 + TOLD_FOR_S - 0.01) is Verdict.TWIN
        assert identity.on_told("robot2", {7: mine, 6: 500}, mine, 102.0 + TOLD_FOR_S) is Verdict.TWIN, "no rise"
        assert identity.on_told("robot2", {7: mine, 6: 502}, mine, 102.0 + TOLD_FOR_S) is verdict
        told = identity.complaint(103.0) or ""
        assert told.startswith(
            "another daemon calls itself 'robot1': robot2 hears it; stop it, or give this machine a "
        )
        assert "`zsched status --node robot2` shows the addresses of both" in told


def test_who_is_told_late_disputes_the_name_when_the_other_stays() -> None:
    identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=100.0)
    assert identity.on_told("robot2", {7: 20, 6: 500}, 20, 100.0 + TOLD_YOUNG_S) is Verdict.TWIN
    at = 100.0 + TOLD_YOUNG_S
    assert identity.on_told("robot2", {7: 20, 6: 501}, 21, at + 1.0) is Verdict.TWIN
    assert identity.on_told("robot2", {7: 20, 6: 500 + STAYS}, 30, at + STAYS_S - 0.01) is Verdict.TWIN
    assert identity.on_told("robot3", {7: 20, 6: 500 + STAYS}, 30, at + STAYS_S) is Verdict.DISPUTE


def test_what_a_peer_knows_of_earlier_lives_is_nothing_to_this_one() -> None:
    identity = Identity(me="robot1", incarnation=7, in_force=HERE, started_at=100.0)
    for lives in ({5: 10, 6: 500}, {7: 20}, {}):
        assert identity.on_told("robot2", lives, 20, 102.0) is Verdict.OURS
    assert identity.complaint(102.0) is None


def test_a_peer_that_says_so_is_asked_now_and_then() -> None:
    identity = old()
    assert identity.must_ask("robot2", 100.0)
    assert not identity.must_ask("robot2", 100.0 + ASK_TWINS_S - 0.01)
    assert identity.must_ask("robot3", 100.1)
    assert identity.must_ask("robot2", 100.0 + ASK_TWINS_S)
