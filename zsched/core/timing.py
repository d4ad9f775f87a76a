"""Decides which sets of protocol clocks are safe together, and holds the three that come with zsched.

Knows: the relations between the fields of `Timing`, each with its reason. Does not know: YAML, and who uses a clock.

`wifi` is `Timing`'s own defaults; the others are written as differences from it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from zsched.core.fleet import Timing

WIFI: Final = Timing()
WIRED: Final = replace(WIFI, name="wired", beat_s=0.1, suspect_s=0.45, confirm_s=0.15, zenoh_lease_s=1.0)
WAN: Final = replace(
    WIFI,
    name="wan",
    beat_s=0.5,
    suspect_s=5.0,
    confirm_s=1.0,
    zenoh_lease_s=4.0,  # a link that zenoh closes makes its node suspect at once: below suspect_s, but not far below
    profile_ttl_s=5.0,
    decide_s=1.0,
    gather_s=0.5,
    ballot_s=1.0,
    stagger_s=0.05,
)
PROFILES: Final[Mapping[str, Timing]] = {profile.name: profile for profile in (WIRED, WIFI, WAN)}


def timing_faults(timing: Timing) -> tuple[tuple[str, str], ...]:
    """(field, what is wrong and why) for every relation that ``timing`` breaks; empty when it is safe.

    ``field`` is the one to change first. All values in seconds; the ranges of the single fields are the reader's.
    """
    t = timing
    relations = (
        ("suspect_s", t.suspect_s, ">=", 3 * t.beat_s, "3 x beat_s", "two lost beats in a row are ordinary on a radio"),
        ("zenoh_lease_s", t.zenoh_lease_s, ">=", 1.0, "1 s", "below it zenoh closes links that are only busy"),
        (
            "zenoh_lease_s",
            t.zenoh_lease_s,
            "<",
            t.suspect_s + t.confirm_s + 1.0,
            "suspect_s + confirm_s + 1 s",
            "a peer that is gone must not hold its sessions, and our puts, much longer",
        ),
        ("confirm_s", t.confirm_s, ">=", t.beat_s, "beat_s", "a suspect refutes, and an observer confirms, by a beat"),
        ("publish_s", t.publish_s, ">=", t.sample_s, "sample_s", "there is nothing new to publish between samples"),
        ("smoothing_s", t.smoothing_s, ">=", t.sample_s, "sample_s", "a shorter time constant smooths nothing"),
        (
            "profile_ttl_s",
            t.profile_ttl_s,
            ">=",
            2 * t.publish_s,
            "2 x publish_s",
            "one lost profile must not take a node out of the race",
        ),
        ("gather_s", t.gather_s, "<=", t.decide_s, "decide_s", "a round must end before the next one begins"),
        (
            "ballot_s",
            t.ballot_s,
            ">=",
            t.gather_s,
            "gather_s",
            "an elector writes to disk before it answers; a utility needs no disk",
        ),
        ("stagger_s", t.stagger_s, "<=", t.ballot_s, "ballot_s", "the next proposer steps in before the round is lost"),
    )
    return tuple(
        (field, f"{field} is {value:g} s, it must be {sign} {bound:g} s ({formula}): {why}")
        for field, value, sign, bound, formula, why in relations
        if not _holds(value, sign, bound)
    )


def _holds(value: float, sign: str, bound: float) -> bool:
    tolerance = 1e-9  # 3 * 0.15 is not 0.45
    if sign == ">=":
        return value >= bound - tolerance
    if sign == "<=":
        return value <= bound + tolerance
    return value < bound
