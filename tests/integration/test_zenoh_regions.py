"""What zenoh 1.10 does with two gateways of one region, on real sessions in processes of their own (decision 0098).

These are facts about zenoh, and the reasons why zsched's cells do not hang on its regions. When one of these tests
fails after an update of zenoh, read the record again: what it refuses may have become possible.
"""

from __future__ import annotations

import time

import pytest

from support.regions import GATEWAYS, ROBOTS, Site, in_some_trial, kept_inside
from support.waiting import until

pytestmark = [pytest.mark.long, pytest.mark.timeout(240)]
ALL = sorted((*ROBOTS, *GATEWAYS))
MODES = ("peer", "router")
CARRIES, RESTS = "ga2", "ga1"
"""Of the gateways of cell a: the higher id carries what crosses."""
LEASE_MS = 2000
FROZEN_S = 5.0
LATEST_S = 10.0
"""A word that comes at all comes at once: a trial without it makes room for the next."""


def lost(numbers: list[int], count: int) -> int:
    """How many of the numbers from 0 never came."""
    return count - len(set(numbers))


def doubled(numbers: list[int]) -> int:
    """How many came more than once."""
    return len(numbers) - len(set(numbers))


@pytest.mark.parametrize("mode", MODES)
@in_some_trial
def test_with_two_gateways_a_sample_crosses_once_and_one_gateway_hears_its_own_region_twice(mode: str) -> None:
    with Site(mode=mode) as site:
        heard = site.put("a1")
        assert {name: heard[name] for name in ("a2", "b1", "b2", "gb1", "gb2", CARRIES)} == dict.fromkeys(
            ("a2", "b1", "b2", "gb1", "gb2", CARRIES), 10
        )
        assert heard[RESTS] == 20  # from the robot, and from the other gateway by the north
        assert site.answers("a1") == sorted([*ALL, RESTS])
        assert site.answers("b1") == sorted([*ALL, "gb1"])
        assert site.tokens("a1") == ALL
        assert site.tokens("b1") == ALL


@pytest.mark.parametrize("mode", MODES)
@in_some_trial
def test_when_the_gateway_that_rests_is_killed_nothing_is_lost(mode: str) -> None:
    with Site(mode=mode) as site:
        site.stream("a1", 400)
        time.sleep(1)
        site.sessions[RESTS].kill()
        time.sleep(4)
        heard = site.heard()
        assert [(lost(heard[name], 400), doubled(heard[name])) for name in ("a2", "b1", "b2")] == [(0, 0)] * 3


@pytest.mark.parametrize("mode", MODES)
@in_some_trial
def test_when_the_gateway_that_carries_is_killed_the_region_is_cut_off_for_good(mode: str) -> None:
    with Site(mode=mode) as site:
        site.stream("a1", 600)
        time.sleep(1)
        site.sessions[CARRIES].kill()
        time.sleep(5.5)
        heard = site.heard()
        assert lost(heard["a2"], 600) == 0
        assert lost(heard["b1"], 600) >= 450  # five seconds later there is still nothing
        assert site.answers("a1") == ["a1", "a2", RESTS]
        assert not {"a1", "a2"} & set(site.answers("b1"))
        assert not {"a1", "a2"} & set(site.tokens("b1"))


@pytest.mark.parametrize("mode", MODES)
@in_some_trial
def test_while_the_gateway_that_carries_is_frozen_nothing_crosses(mode: str) -> None:
    with Site(mode=mode, lease_ms=LEASE_MS) as site:
        site.stream("a1", 800)
        time.sleep(1)
        site.sessions[CARRIES].freeze()
        time.sleep(FROZEN_S)
        assert not {"a1", "a2"} & set(site.answers("b1"))
        site.sessions[CARRIES].thaw()
        site.wait_answers("b1", ALL)
        time.sleep(3)
        assert lost(site.heard()["b1"], 800) >= 300


@in_some_trial
def test_a_robots_own_token_goes_where_it_is_watched_in_its_own_region() -> None:
    with Site() as site:
        assert sorted(name for _, name in site.token_changes("a1")) == ALL
        site.sessions[RESTS].kill()
        time.sleep(1)
        until(lambda: ("gone", "a1") in site.token_changes("a1"), "its own token is said to be gone", LATEST_S)
        assert site.sessions["a1"].is_up


@in_some_trial
def test_a_gateway_that_comes_back_carries_again() -> None:
    with Site() as site:
        site.sessions[CARRIES].kill()
        time.sleep(1)
        site.reopen(CARRIES)
        site.wait_answers("b1", ALL)
        heard = site.put("a1")
        assert {name: heard[name] for name in ("a2", "b1", "b2")} == {"a2": 10, "b1": 10, "b2": 10}


@in_some_trial
def test_when_both_gateways_are_gone_the_peers_of_a_region_still_have_one_another() -> None:
    with Site() as site:
        for name in (CARRIES, RESTS):
            site.sessions[name].kill()
        time.sleep(1)
        heard = site.put("a1")
        assert heard["a2"] == 10
        assert (heard["b1"], heard["b2"]) == (0, 0)
        assert site.answers("a2") == ["a1", "a2"]


@in_some_trial
def test_clients_of_two_routers_hear_one_another_once_and_go_to_the_other_when_theirs_is_killed() -> None:
    with Site(mode="router", robots="client") as site:
        heard = site.put("a1")
        assert {name: heard[name] for name in ("a2", "b1", "b2")} == {"a2": 10, "b1": 10, "b2": 10}
        assert site.answers("a1") == ALL
        site.stream("a1", 600)
        time.sleep(1)
        (router,) = site.neighbours("a1")
        site.sessions[router].kill()
        time.sleep(5.5)
        assert site.neighbours("a1") == [{CARRIES: RESTS, RESTS: CARRIES}[router]]
        heard_after = site.heard()
        for name in ("a2", "b1", "b2"):
            assert lost(heard_after[name], 600) <= 400
            assert doubled(heard_after[name]) == 0
        site.wait_answers("b1", ROBOTS)


@in_some_trial
def test_a_client_of_a_frozen_router_has_nobody_until_the_router_goes_on() -> None:
    with Site(mode="router", robots="client", lease_ms=LEASE_MS) as site:
        site.stream("a1", 800)
        time.sleep(1)
        (router,) = site.neighbours("a1")
        site.sessions[router].freeze()
        time.sleep(FROZEN_S)
        site.sessions[router].thaw()
        time.sleep(2.5)
        heard = site.heard()
        assert all(lost(heard[name], 800) >= 400 for name in ("a2", "b1", "b2"))


@in_some_trial
def test_clients_of_two_routers_that_are_both_gone_have_nobody() -> None:
    with Site(mode="router", robots="client") as site:
        for name in (CARRIES, RESTS):
            site.sessions[name].kill()
        time.sleep(1)
        assert site.put("a1")["a2"] == 0


@pytest.mark.parametrize("mode", MODES)
@in_some_trial
def test_access_rules_of_the_gateways_keep_keys_inside_a_region(mode: str) -> None:
    with Site(mode=mode, more=kept_inside("x/**", "t/**")) as site:
        heard = site.put("a1")
        assert {name: heard[name] for name in ("a2", "b1", "b2", "gb1", "gb2")} == {
            **dict.fromkeys(("b1", "b2", "gb1", "gb2"), 0),
            "a2": 10,
        }
        assert site.tokens("b1") == ["b1", "b2", "gb1", "gb2"]
        assert set(site.answers("a1")) == set(ALL)  # nothing was said about these


@in_some_trial
def test_a_gateways_namespace_keeps_nothing_inside() -> None:
    with Site(more={"namespace": "cell"}, crossing=ROBOTS) as site:
        heard = site.put("a1")
        assert {name: heard[name] for name in ("a2", "b1", "b2")} == {"a2": 10, "b1": 10, "b2": 10}
        assert heard["ga1"] == 0  # its own declarations are under another name
