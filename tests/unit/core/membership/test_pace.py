"""When a node beats at the slow pace, and what brings the next beat forward."""

from __future__ import annotations

from dataclasses import replace

import pytest

from support.beats import beat_of
from support.fleets import fleet_of
from zsched.config.timing import PROFILES, WIFI
from zsched.core.membership.pace import FULL_S, Pace
from zsched.core.values.beat import Beat
from zsched.core.values.fleet import Timing
from zsched.core.values.in_force import InForce

HERE = InForce(replace(fleet_of(), timing=WIFI))


def sent(pace: Pace, number: int, now: float, *, is_restless: bool = False, suspects: tuple[str, ...] = ()) -> Beat:
    return pace.marked(beat_of("me", number, suspects=suspects), now, is_restless=is_restless)


def calm() -> Pace:
    """Of a node that has sent a calm beat at time 100, with calm peers."""
    pace = Pace(in_force=HERE)
    sent(pace, 1, 100.0 - FULL_S)
    assert pace.next_at(sent(pace, 2, 100.0), are_all_calm=True) == pytest.approx(100.4)
    return pace


@pytest.mark.parametrize("timing", PROFILES.values(), ids=lambda one: one.name)
def test_three_slow_beats_fit_into_the_silence_that_makes_a_peer_suspect(timing: Timing) -> None:
    assert timing.beat_s < timing.rest_beat_s <= min(2 * timing.beat_s, timing.suspect_s / 3)


def test_a_node_is_calm_once_its_beats_have_said_the_same_for_long_enough() -> None:
    pace = Pace(in_force=HERE)
    assert not sent(pace, 1, 100.0).calm
    assert not sent(pace, 2, 100.0 + FULL_S - 0.1).calm
    assert sent(pace, 3, 100.0 + FULL_S).calm
    assert not sent(pace, 4, 100.4 + FULL_S, suspects=("a",)).calm, "any news"
    assert not sent(pace, 5, 100.8 + FULL_S).calm, "its end is news, too"


def test_whoever_is_restless_for_another_reason_is_not_calm() -> None:
    pace = calm()
    assert not sent(pace, 3, 100.4, is_restless=True).calm
    assert not sent(pace, 4, 100.4 + FULL_S - 0.1).calm
    assert sent(pace, 5, 100.4 + FULL_S).calm


def test_a_calm_node_beats_at_full_pace_beside_one_that_is_not() -> None:
    pace = calm()
    beat = sent(pace, 3, 100.4)
    assert beat.calm, "it says so all the same: otherwise two would wait for each other for ever"
    assert pace.next_at(beat, are_all_calm=False) == pytest.approx(100.6)


@pytest.mark.parametrize(("at", "due"), [(100.05, 100.2), (100.3, 100.3)])
def test_what_happens_brings_the_next_beat_to_where_full_pace_would_have_it(at: float, due: float) -> None:
    pace = calm()
    assert pace.hasten(100.4, at) == pytest.approx(due)
    assert not sent(pace, 3, due).calm
