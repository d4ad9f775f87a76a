"""Decides which sets of protocol clocks are safe together, and holds the three that come with zsched.

Knows: the relations between the fields of `Timing`, each with its reason. Does not know: YAML, and who uses a clock.

`wifi` is `Timing`'s own defaults; the others are written as differences from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Final

from zsched.core.values.fleet import Timing
from zsched.core.values.struct import Struct, replace

WIFI: Final = Timing()
WIRED: Final = replace(WIFI, name="wired", beat_s=0.1, suspect_s=0.45, confirm_s=0.15, zenoh_lease_s=1.0, lease_s=0.4)
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
    stagger_s=0.6,  # over 150 ms each way the first proposer has committed by then; two that meet need seconds
    lease_s=3.0,
)
PROFILES: Final[Mapping[str, Timing]] = {profile.name: profile for profile in (WIRED, WIFI, WAN)}


class _Relation(Struct, frozen=True):
    """``field`` must stand to ``bound`` as ``sign`` says; ``formula`` is the bound in words."""

    field: str
    sign: str
    formula: str
    bound: Callable[[Timing], float]
    why: str


_RELATIONS: Final = (
    _Relation(
        "suspect_s", ">=", "3 x beat_s", lambda t: 3 * t.beat_s, "two lost beats in a row are ordinary on a radio"
    ),
    _Relation(
        "confirm_s", ">=", "beat_s", lambda t: t.beat_s, "a suspect refutes, and an observer confirms, by a beat"
    ),
    _Relation("zenoh_lease_s", ">=", "1 s", lambda _: 1.0, "below it zenoh closes links that are only busy"),
    _Relation(
        "zenoh_lease_s",
        "<",
        "suspect_s + confirm_s + 1 s",
        lambda t: t.suspect_s + t.confirm_s + 1.0,
        "a peer that is gone must not hold its sessions, and our puts, much longer",
    ),
    _Relation("publish_s", ">=", "sample_s", lambda t: t.sample_s, "there is nothing new to publish between samples"),
    _Relation("smoothing_s", ">=", "sample_s", lambda t: t.sample_s, "a shorter time constant smooths nothing"),
    _Relation(
        "profile_ttl_s",
        ">=",
        "2 x publish_s",
        lambda t: 2 * t.publish_s,
        "one lost profile must not take a node out of the race",
    ),
    _Relation("gather_s", "<=", "decide_s", lambda t: t.decide_s, "a round must end before the next one begins"),
    _Relation(
        "ballot_s",
        ">=",
        "gather_s",
        lambda t: t.gather_s,
        "an elector writes to disk before it answers, a utility needs no disk",
    ),
    _Relation(
        "stagger_s", "<=", "ballot_s", lambda t: t.ballot_s, "the next proposer must step in before the round is lost"
    ),
    _Relation(
        "lease_s", ">=", "3 x beat_s", lambda t: 3 * t.beat_s, "an exclusive owner must live through two lost beats"
    ),
    _Relation(
        "lease_s",
        "<=",
        "suspect_s",
        lambda t: t.suspect_s,
        "a silent owner's lease must not outlast the time in which it is found to be silent",
    ),
    _Relation(
        "lease_s",
        "<=",
        "0.75 x zenoh_lease_s",
        lambda t: 0.75 * t.zenoh_lease_s,
        "a frozen worker's token goes after that; what it might still send must be past its lease by then",
    ),
)


def timing_faults(timing: Timing) -> tuple[tuple[str, str], ...]:
    """(field, what is wrong and why) for every relation that ``timing`` breaks; empty when it is safe.

    ``field`` is the one to change first. All values in seconds; the ranges of the single fields are the reader's.
    """
    faults: list[tuple[str, str]] = []
    for relation in _RELATIONS:
        value, bound = getattr(timing, relation.field), relation.bound(timing)
        if not _holds(value, relation.sign, bound):
            must = f"it must be {relation.sign} {bound:g} s ({relation.formula})"
            faults.append((relation.field, f"{relation.field} is {value:g} s, {must}: {relation.why}"))
    return tuple(faults)


def _holds(value: float, sign: str, bound: float) -> bool:
    tolerance = 1e-9  # 3 * 0.15 is not 0.45
    if sign == ">=":
        return value >= bound - tolerance
    if sign == "<=":
        return value <= bound + tolerance
    return value < bound
