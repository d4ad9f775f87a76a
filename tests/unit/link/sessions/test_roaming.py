"""Another address of this machine: it must have been there for a while, and no address is no other place."""

from __future__ import annotations

import pytest

from zsched.link.sessions.roaming import ANY_HOST, MOST_HOSTS, STAY_S, Roaming, addresses_towards, places_of

HOME, AWAY = ("198.18.0.1",), ("198.18.0.5",)


@pytest.mark.parametrize(
    ("hosts", "places"),
    [
        ([], ()),
        (["", "localhost", "127.0.0.1", "::1", "[::1]"], ()),
        (["198.18.0.3", "198.18.0.3", "198.18.0.4"], ("198.18.0.3", "198.18.0.4")),
        (["edge1.local", "edge2.local"], (ANY_HOST,)),
        (["fd00::3"], ("fd00::3",)),
        ([f"198.18.0.{number}" for number in range(1, 9)], tuple(f"198.18.0.{number}" for number in range(1, 5))),
    ],
)
def test_it_looks_towards_numeric_addresses_and_for_names_along_the_default_route(
    hosts: list[str], places: tuple[str, ...]
) -> None:
    assert places_of(hosts) == places
    assert len(places) <= MOST_HOSTS


def test_an_own_address_is_the_one_that_a_packet_would_have() -> None:
    assert addresses_towards(["127.0.0.1"]) == ("127.0.0.1",)
    assert addresses_towards([]) == ()


def test_a_place_that_is_no_address_or_that_no_way_leads_to_has_none() -> None:
    assert addresses_towards(["edge1.local", "0000:", "fe80::1%nowhere"]) == ()


def test_another_address_counts_once_it_has_been_there_for_a_while() -> None:
    roaming = Roaming(began_at=HOME)
    assert not roaming.is_elsewhere(HOME, 0.0)
    assert not roaming.is_elsewhere(AWAY, 10.0)
    assert not roaming.is_elsewhere(AWAY, 10.0 + STAY_S / 2)
    assert roaming.is_elsewhere(AWAY, 10.0 + STAY_S)


def test_who_is_back_in_time_or_has_no_network_stays_as_it_is() -> None:
    roaming = Roaming(began_at=HOME)
    assert not roaming.is_elsewhere(AWAY, 0.0)
    assert not roaming.is_elsewhere(HOME, 1.0)
    assert not roaming.is_elsewhere((), 2.0)
    assert not roaming.is_elsewhere((), 60.0)
    assert not roaming.is_elsewhere(AWAY, 61.0), "the wait begins from the start"
    assert roaming.is_elsewhere(AWAY, 61.0 + STAY_S)


def test_who_began_without_a_network_begins_again_once_it_has_one() -> None:
    roaming = Roaming(began_at=())
    assert not roaming.is_elsewhere(HOME, 0.0)
    assert roaming.is_elsewhere(HOME, STAY_S)
