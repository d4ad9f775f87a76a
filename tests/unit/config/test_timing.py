"""The three timing profiles are safe, and each relation can be broken."""

from dataclasses import asdict, fields, replace

import pytest

from zsched.config.timing import PROFILES, WAN, WIFI, WIRED, timing_faults
from zsched.core.membership.peers import LOSS_FACTOR
from zsched.core.values.fleet import Timing


def changed(field: str, value: float) -> Timing:
    return Timing(**{**asdict(WIFI), field: value})


@pytest.mark.parametrize("name", ["wired", "wifi", "wan"])
def test_profiles_are_safe_and_named(name: str) -> None:
    assert timing_faults(PROFILES[name]) == ()
    assert PROFILES[name].name == name


@pytest.mark.parametrize(
    ("field", "value", "blamed"),
    [
        ("beat_s", 0.41, "suspect_s"),
        ("suspect_s", 0.5, "suspect_s"),
        ("confirm_s", 0.1, "confirm_s"),
        ("zenoh_lease_s", 0.9, "zenoh_lease_s"),
        ("zenoh_lease_s", 2.5, "zenoh_lease_s"),
        ("publish_s", 0.1, "publish_s"),
        ("smoothing_s", 0.1, "smoothing_s"),
        ("profile_ttl_s", 1.9, "profile_ttl_s"),
        ("decide_s", 0.1, "gather_s"),
        ("ballot_s", 0.1, "ballot_s"),
        ("stagger_s", 0.4, "stagger_s"),
    ],
)
def test_a_broken_relation_is_named_with_its_bound(field: str, value: float, blamed: str) -> None:
    faults = timing_faults(changed(field, value))
    assert blamed in [name for name, _ in faults]
    message = next(text for name, text in faults if name == blamed)
    assert "it must be" in message
    assert ": " in message


def test_every_clock_stands_in_some_relation() -> None:
    """Setting one clock absurdly, up or down, must not pass unnoticed."""
    for field in fields(Timing):
        if field.name != "name":
            absurd = [changed(field.name, value) for value in (0.01, 3000.0)]
            assert any(timing_faults(timing) for timing in absurd), field.name


def test_a_link_that_is_held_up_outlives_what_makes_its_node_suspect() -> None:
    """zenoh ends it after three quarters of its lease; in `wan` the lease is meant to be the first to tell."""
    for timing in (WIFI, WIRED):
        assert 0.75 * timing.control_lease_s >= LOSS_FACTOR * timing.suspect_s
    assert WAN.control_lease_s == WAN.zenoh_lease_s < WAN.suspect_s


@pytest.mark.parametrize(
    ("timing", "signs"),
    [(WIRED, 3), (WIFI, 3), (WAN, 4), (replace(WIFI, lease_s=1.01), 4), (replace(WIFI, zenoh_lease_s=1.6), 3)],
)
def test_a_frozen_workers_link_outlives_its_lease(timing: Timing, signs: int) -> None:
    """zenoh may end it one period of the signs of life before its own lease is over."""
    assert timing_faults(timing) == ()
    assert timing.data_signs == signs
    assert timing.zenoh_lease_s * (1 - 1 / timing.data_signs) >= timing.lease_s
