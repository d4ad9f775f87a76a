"""Who sends too much is held back alone, and what was dropped is counted to the last frame."""

from __future__ import annotations

import json
import threading

import zenoh

from support.fleets import fleet_of
from zsched.config.timing import PROFILES
from zsched.core.values.fleet import Timing
from zsched.link.bus.limits import BURST_S, MAX_NAMES, Buckets, Drops, Limit, Names, in_turn_hz, limit_for
from zsched.link.sessions.config import control_config

LIMIT = Limit(hz=10, burst=20)


def test_a_flood_gets_its_burst_and_then_its_rate() -> None:
    buckets = Buckets(LIMIT, ["robot1"])
    assert sum(buckets.take("robot1", 0.0) for _ in range(1000)) == 20
    assert sum(buckets.take("robot1", 1.0) for _ in range(1000)) == 10
    assert sum(buckets.take("robot1", 100.0) for _ in range(1000)) == 20


def test_one_peer_s_flood_takes_nothing_from_another() -> None:
    buckets = Buckets(LIMIT, ["robot1", "robot2"])
    for _ in range(1000):
        buckets.take("robot1", 0.0)
    assert buckets.take("robot2", 0.0)


def test_invented_names_share_one_bucket_and_take_no_memory() -> None:
    buckets = Buckets(LIMIT, ["robot1"])
    assert sum(buckets.take(f"x{number}", 0.0) for number in range(1000)) == 20
    assert len(buckets._left) == 2
    assert buckets.take("robot1", 0.0)


def test_a_name_that_is_new_in_the_file_gets_a_bucket_and_old_ones_keep_theirs() -> None:
    buckets = Buckets(LIMIT, ["robot1"])
    for name in ("robot1", "robot2"):
        for _ in range(20):
            buckets.take(name, 0.0)
    buckets.know(["robot1", "robot2"])
    assert buckets.take("robot2", 0.0)
    assert not buckets.take("robot1", 0.0)


def test_another_limit_counts_at_once_and_gives_nobody_more_than_it_says() -> None:
    buckets = Buckets(LIMIT, ["robot1", "robot2"])
    for _ in range(20):
        buckets.take("robot1", 0.0)
    buckets.know([], Limit(hz=30, burst=60))
    assert sum(buckets.take("robot2", 0.0) for _ in range(1000)) == 60, "who was silent has all of it"
    assert sum(buckets.take("robot1", 0.0) for _ in range(1000)) == 40, "who had sent its part has what came on top"
    assert sum(buckets.take("robot1", 1.0) for _ in range(1000)) == 30
    buckets.know([], LIMIT)
    assert sum(buckets.take("robot1", 100.0) for _ in range(1000)) == 20


def test_a_clock_that_stands_still_or_is_behind_gives_nothing() -> None:
    buckets = Buckets(LIMIT, ["robot1"])
    for _ in range(20):
        buckets.take("robot1", 5.0)
    assert not buckets.take("robot1", 4.0)


def test_every_profile_leaves_room_for_a_vote_about_every_task_at_once() -> None:
    for timing in (Timing(), *PROFILES.values()):
        for tasks in (1, 10, 100):
            limit = limit_for(timing, tasks)
            assert limit.hz >= 10 * (1 / timing.beat_s + 1 / timing.publish_s)
            assert limit.burst >= 2 * BURST_S * tasks, "a prepare and an accept, each asked twice"


def test_each_node_s_periodic_frames_are_thinned_far_above_their_rate() -> None:
    fleet = fleet_of(name="yard", of=("robot1", "robot2"), tasks=())
    rates = in_turn_hz(fleet)
    assert set(rates) == {
        f"@zsched/yard/{kind}/{name}/in/turn" for kind in ("beat", "profile") for name in ("robot1", "robot2")
    }
    assert rates["@zsched/yard/beat/robot1/in/turn"] * fleet.timing.beat_s >= 10
    theirs = '{downsampling: [{messages: ["put"], flows: ["egress"], rules: [{key_expr: "a", freq: 2}]}]}'
    for operator, count in (("", 1), (theirs, 2)):
        text = control_config(listen=(), connect=(), at_most_hz=rates, operator_json5=operator)
        found = json.loads(zenoh.Config.from_json5(text).get_json("downsampling"))
        assert len(found) == count, "the operator's own stay"
        assert {rule["key_expr"] for rule in found[0]["rules"]} == set(rates)


def test_names_are_told_once_and_no_flood_of_them_is_kept() -> None:
    names = Names()
    for number in range(100):
        names.add(f"robot{number % 3}")
    assert names.take() == ("robot0", "robot1", "robot2")
    assert names.take() == ()
    for number in range(100):
        names.add(f"robot{number}")
    assert len(names.take()) == MAX_NAMES


def test_drops_of_several_threads_are_all_counted() -> None:
    drops = Drops()

    def drop() -> None:
        for _ in range(1000):
            drops.add("beat", "rate")

    threads = [threading.Thread(target=drop) for _ in range(4)]
    for thread in threads:
        thread.start()
    taken = list(drops.take())
    for thread in threads:
        thread.join()
    taken += drops.take()
    assert sum(count for _, _, count in taken) == 4000
    assert drops.take() == ()
