"""A fleet of real daemons in network namespaces, broken in every way: who notices what, who serves, and what never is.

One fleet for the whole module, mended before each test. At the end one checker goes over everything that was seen:
one value per revision, one owner per epoch, epochs that never fall, no two guards at work, no stranger admitted.
"""

from __future__ import annotations

import contextlib
import os
import random
import signal
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from zsched.core.values.model import PeerState
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.chaos import GUARD, ChaosBed
from zsched_lab.fleet.groups import LimitedGroup
from zsched_lab.fleet.netbed import DATA_PORT, descendants, stop_group
from zsched_lab.fleet.testbed import TASK

pytestmark = pytest.mark.root

STORM_S = float(os.environ.get("ZSCHED_STORM_S", "8"))
"""Length of the restart storm; the long form: 20 and more."""
SLOW_GROUP = "zsched-test-slow-"
WEDGEABLE = Path(__file__).with_name("wedgeable_daemon.py")


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ChaosBed]:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    with ChaosBed(tmp_path_factory.mktemp("fleet"), wrapper=WEDGEABLE) as bed:
        bed.up()
        yield bed


@pytest.fixture
def bed(fleet: ChaosBed) -> Iterator[ChaosBed]:
    fleet.calm()
    yield fleet
    assert fleet.violations() == []


def others(bed: ChaosBed, *nodes: str) -> tuple[str, ...]:
    return tuple(name for name in bed.names if name not in nodes)


def gone(bed: ChaosBed, since: float) -> set[tuple[str, str]]:
    """(observer, node): who has held whom for gone."""
    return {(one.observer, one.node) for one in bed.changes(since=since) if one.after is PeerState.GONE}


def learns(bed: ChaosBed, node: str) -> bool:
    """Whether a node knows the same value as robot1."""
    return bed.owner_of(TASK, "robot1", node) is not None


# --- before anything has failed ---------------------------------------------------------------------------------------


def test_partial_cut_makes_nobody_gone_and_an_ordinary_vote_decides(bed: ChaosBed) -> None:
    """robot1 and the owner do not hear each other, all others hear both.

    The first test of this fleet: later its edges have failed so often that the owner, heard by two robots of three,
    may well be the best of them (tests/sim/test_vote_rules.py has what robots remember).
    """
    owner, start = bed.calm(), monotonic_s()
    bed.network.separate(["robot1"], [owner])
    bed.wait(lambda: bed.peer("robot1", owner) == "suspect", 60, "robot1 to suspect the owner")
    bed.wait(lambda: bed.moved_from(owner, *others(bed)), 60, "a move to where all reach")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes at robot1")
    assert gone(bed, start) == set()
    reasons = [bed.task(robot)["history"][-1]["reason"] for robot in ("robot1", "robot2", "robot3")]
    assert not any("gone" in reason for reason in reasons), reasons


def test_owner_whose_data_no_robot_reaches_is_left_and_gets_nothing_until_one_does(bed: ChaosBed) -> None:
    """A firewall lets control pass and not the streams: the node lives, its worker is ready, and nothing flows."""
    owner, start = bed.calm(), monotonic_s()
    bed.network.shut(owner, DATA_PORT)
    bed.wait(lambda: bed.moved_from(owner, "robot1", "robot2", "robot3"), 60, "a move to where the streams reach")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes at robot1")
    assert gone(bed, start) == set()
    assert "reached by" in bed.task("robot1")["history"][-1]["reason"]
    told = f"the worker on {owner} is ready, and our relay does not see its token"
    bed.wait(lambda: any(told in one for one in bed.task("robot1")["problems"]), 30, "status to say why")
    bed.network.heal(owner)
    bed.wait(lambda: not bed.task("robot1")["problems"], 60, "the streams to reach it again")


# --- processes and machines ------------------------------------------------------------------------------------------


def test_frozen_machine_loses_its_task_and_wakes_as_a_stranger(bed: ChaosBed) -> None:
    owner, start = bed.calm(), monotonic_s()
    relays = bed.status(owner)["counters"].get("relay_exits", 0)
    stop_group(bed.pid(owner), signal.SIGSTOP)
    bed.wait(lambda: bed.moved_from(owner), 60, "another owner")
    bed.wait(lambda: bed.moved_from(owner, "robot1", "robot2", "robot3", task=GUARD), 60, "another guard")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes")
    assert {node for _, node in gone(bed, start)} == {owner}
    stop_group(bed.pid(owner), signal.SIGCONT)
    bed.wait(lambda: learns(bed, owner), 60, "the sleeper to learn the newer epoch")
    bed.wait(bed.is_calm, 60, "everybody to be well")
    assert bed.status(owner)["counters"].get("relay_exits", 0) == relays, "its relay slept too, and was not wedged"


def test_wedged_owner_is_replaced_although_its_token_stays(bed: ChaosBed) -> None:
    owner, start = bed.calm(), monotonic_s()
    bed.send(owner, signal.SIGUSR1)
    bed.wait(lambda: bed.moved_from(owner), 60, "another owner")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes")
    found = [one for one in bed.changes(since=start) if one.node == owner and one.after is PeerState.SUSPECT]
    assert found
    assert all(one.reason.startswith("silent") for one in found), found
    bed.wait(lambda: learns(bed, owner), 60, "the wedged one to learn the newer epoch")


def test_power_loss_of_the_owner_is_silence_and_it_returns_with_its_state(bed: ChaosBed) -> None:
    owner, start = bed.calm(), monotonic_s()
    before = {entry["name"]: entry["incarnation"] for entry in bed.status("robot1")["nodes"]}
    bed.power_off(owner)
    bed.wait(lambda: bed.moved_from(owner), 60, "another owner")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes")
    reasons = [one.reason for one in bed.changes(since=start) if one.node == owner and one.after is PeerState.SUSPECT]
    assert reasons
    assert all(reason.startswith("silent") for reason in reasons)
    bed.calm()
    after = {entry["name"]: entry["incarnation"] for entry in bed.status("robot1")["nodes"]}
    assert after[owner] > before[owner]
    assert bed.status(owner)["quorum"]["this_node"] in {"elector", "no_elector"}


def test_slow_node_accuses_nobody_to_death(bed: ChaosBed) -> None:
    """A twentieth of a core for daemon, relay and workers: it may lose its task, the others may lose nobody else."""
    reason = LimitedGroup.why_not(memory=False)
    if reason is not None:
        pytest.skip(f"no cgroups here: {reason}")
    owner, start = bed.calm(), monotonic_s()
    group = LimitedGroup.create(f"{SLOW_GROUP}{os.getpid()}", cpu_cores=0.05)
    try:
        for pid in (bed.pid(owner), *descendants(bed.pid(owner))):
            group.add(pid)
        bed.wait(lambda: monotonic_s() > start + 4, 60, "four seconds of it")
        assert {node for observer, node in gone(bed, start) if observer != owner} <= {owner}
        bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes, however late: its owner rests for up to 0.1 s at a time")
    finally:
        for pid in group.pids():
            with contextlib.suppress(OSError):
                for folder in group.folders:
                    (folder.parent / "cgroup.procs").write_text(str(pid))
        group.remove()


def test_restart_storm_breaks_no_promise(bed: ChaosBed) -> None:
    rng, end = random.Random(7), time.monotonic() + STORM_S
    down: list[str] = []
    while time.monotonic() < end:
        if down and (len(down) > 2 or rng.random() < 0.5):
            bed.start(down.pop(rng.randrange(len(down))))
        else:
            victim = rng.choice(bed.running())
            bed.kill(victim)
            down.append(victim)
        time.sleep(rng.uniform(0.05, 0.7))
    bed.calm()


# --- the network -----------------------------------------------------------------------------------------------------


def test_cut_off_owner_is_replaced_and_learns_it_when_the_cut_heals(bed: ChaosBed) -> None:
    owner, start = bed.calm(), monotonic_s()
    bed.network.cut(owner)
    bed.wait(lambda: bed.moved_from(owner), 60, "another owner")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes")
    assert bed.owner_of(TASK, owner) == owner, "it cannot know better"
    bed.network.heal()
    bed.wait(lambda: learns(bed, owner), 60, "the old owner to learn the newer epoch")
    assert {node for observer, node in gone(bed, start) if observer != owner} == {owner}


def test_cut_off_robot_moves_nothing_and_the_others_go_on(bed: ChaosBed) -> None:
    bed.calm()
    start = monotonic_s()
    bed.network.cut("robot2")
    bed.wait(lambda: not bed.status("robot2")["quorum"]["ok"], 60, "robot2 to miss the quorum")
    before = bed.task("robot2")
    assert any(text.startswith("no quorum") for text in bed.status("robot2")["problems"])
    bed.wait(lambda: ("robot1", "robot2") in gone(bed, start), 60, "robot2 gone")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "robot1's echoes")
    now = bed.task("robot2")
    assert (now["owner"], now["epoch"]) == (before["owner"], before["epoch"])
    bed.wait(lambda: not bed.probes["robot2"].is_flowing(), 60, "robot2's stream to stop")


@pytest.mark.parametrize("way", ["deaf", "mute"])
def test_owner_cut_off_one_way_is_replaced(bed: ChaosBed, way: str) -> None:
    owner = bed.calm()
    (bed.network.deafen if way == "deaf" else bed.network.mute)(owner)
    bed.wait(lambda: bed.moved_from(owner), 60, "another owner")
    bed.wait(lambda: bed.moved_from(owner, "robot1", "robot2", "robot3", task=GUARD), 60, "another guard")
    bed.wait(bed.probes["robot1"].is_flowing, 60, "echoes")


def test_even_split_moves_nothing_on_either_side(bed: ChaosBed) -> None:
    """Two electors of four on each side; two robots of three, without the owner, on one."""
    owner = bed.calm()
    epoch = bed.task("robot1")["epoch"]
    theirs = {"robot3", "edge1", owner}
    ours = others(bed, *theirs)
    bed.network.separate(ours, theirs)
    bed.wait(lambda: bed.peer("robot1", owner) == "gone", 60, "the owner gone for robot1")
    start = monotonic_s()
    bed.wait(lambda: monotonic_s() > start + 1.5, 60, "time for three rounds")
    for robot in ("robot1", "robot3"):
        status = bed.status(robot)
        assert not status["quorum"]["ok"], robot
        assert status["tasks"][0]["epoch"] == epoch
    bed.network.heal()
    bed.wait(lambda: bed.owner_of(TASK), 60, "one agreed value")


def test_saturated_uplink_takes_nobody_for_dead(bed: ChaosBed) -> None:
    """24 Mbit/s offered to an uplink of 4: beats go past the data, for they have a connection of their own."""
    bed.calm()
    start = monotonic_s()
    bed.network.narrow("robot3", 4)
    probe = bed.probe("robot3", put="robot3/in", size=60_000, watch=["robot3/out"])
    bed.wait(lambda: probe.is_open, 60, "the application")
    began = monotonic_s()
    bed.wait(lambda: monotonic_s() > began + 3, 60, "three seconds of it")
    probe.close()
    assert gone(bed, start) == set()


def test_what_was_seen_is_enough_to_judge(bed: ChaosBed) -> None:
    """The checker of every test here is only as good as its records."""
    bed.kill(bed.calm())
    bed.calm()
    bed.wait(lambda: Counter(type(record).__name__ for record in bed.seen().records)["Admitted"] > 100, 60, "messages")
    kinds = Counter(type(record).__name__ for record in bed.seen().records)
    assert kinds["Learnt"] > 2 * len(bed.names), kinds
    assert kinds["Admitted"] > 100, kinds
    assert kinds["Worked"] > 1, kinds
    assert kinds["Started"] >= len(bed.names), kinds
