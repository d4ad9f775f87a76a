"""Streams while the network or an application fails, on real daemons in namespaces: how long each robot goes without.

The fleet of the chaos tests, with an application on every robot. ``ZSCHED_CUTS=60`` plays the one-way cut sixty times.
"""

from __future__ import annotations

import os
import signal
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import Final

import pytest

from support.waiting import within
from zsched.core.hop.books import given_up
from zsched.core.values.fleet import Timing
from zsched.core.values.model import NodeId
from zsched.core.values.plan import StreamCount
from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.chaos import ChaosBed
from zsched_lab.fleet.netbed import Netbed, Probe, descendants_running
from zsched_lab.fleet.testbed import TASK, TestbedError, echo_fleet

CUTS: Final = int(os.environ.get("ZSCHED_CUTS", "3"))
LONGEST_S: Final = 4.0
"""The longest time that a robot may go without answers after a one-way cut."""
GIVE_UP_S: Final = 30.0
FROZEN_S: Final = 4.0
"""Longer than the lease of the links."""
BUSY_HZ: Final = 800.0
"""In that time more than a relay keeps to send again (2048), and less than the queue of a slot holds."""
STOP_S: Final = 2.0
"""A daemon's time to stop its workers, by default."""

pytestmark = [pytest.mark.timeout(120 + 60 * CUTS), pytest.mark.root]


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ChaosBed]:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    with ChaosBed(tmp_path_factory.mktemp("streams")) as made:
        made.up()
        made.probes["robot3"] = made.probe("robot3", put="robot3/in", watch=["robot3/out"])
        yield made


@pytest.fixture(autouse=True)
def books(bed: ChaosBed) -> Iterator[None]:
    """After every test each sample is in one counter of a robot's relay."""
    yield
    assert bed.unaccounted() == []


def is_back(probe: Probe, moment: float) -> bool:
    """Whether something came back that was sent after ``moment``."""
    return probe.first_after(moment) is not None


def pause_s(probe: Probe, since: float) -> float:
    """The longest time without an answer from ``since`` to the newest one."""
    times = [one.at for one in tuple(probe.received) if one.at >= since and one.epoch is None]
    return max((later - earlier for earlier, later in pairwise([since, *times])), default=GIVE_UP_S)


def test_no_robot_stands_still_when_the_owner_is_deaf(bed: ChaosBed) -> None:
    """Its links end while something is still to be sent; closing them took the only thread that opens others."""
    pauses: list[dict[NodeId, float]] = []
    for number in range(CUTS):
        owner = bed.calm()
        bed.network.deafen(owner)
        cut = monotonic_s()
        bed.wait(lambda: bed.moved_from(owner), GIVE_UP_S, "another owner")  # noqa: B023 - called at once
        moved = monotonic_s()
        bed.wait(
            lambda: all(is_back(probe, moved) for probe in bed.probes.values()),  # noqa: B023 - called at once
            GIVE_UP_S,
            "answers at every robot",
        )
        pauses.append({robot: round(pause_s(probe, cut), 2) for robot, probe in bed.probes.items()})
        print(f"cut {number}: {owner} deaf, pauses {pauses[-1]}", flush=True)
    within(max(one for found in pauses for one in found.values()), LONGEST_S, f"without an answer: {pauses}")


def test_a_frozen_application_holds_up_no_other_of_its_robot(bed: ChaosBed) -> None:
    """Two more receive what robot1's application does; one of them takes nothing for six seconds."""
    bed.calm()
    patient = Timing(zenoh_lease_s=20.0)  # the end of its lease helps nobody
    frozen = bed.probe("robot1", watch=["robot1/out"], timing=patient)
    awake = bed.probe("robot1", put="robot1/in", hz=100, size=30_000, watch=["robot1/out"])
    others = (frozen, awake)
    bed.wait(lambda: all(one.received for one in others), 60, "answers at all three")
    frozen.send(signal.SIGSTOP)
    try:
        began = monotonic_s()
        bed.wait(lambda: monotonic_s() > began + 6, 60, "six seconds")
        for probe in (bed.probes["robot1"], awake):
            bed.wait(probe.is_flowing, 60, "answers")
            within(pause_s(probe, began), 2.0, "without an answer")
    finally:
        frozen.send(signal.SIGCONT)
    bed.wait(lambda: is_back(frozen, began + 6), 60, "answers at the one that woke up")
    for probe in others:
        probe.close()


def test_a_wait_ends_at_once_when_an_application_has_ended(bed: ChaosBed) -> None:
    probe = bed.probe("robot1", watch=["robot1/out"])
    bed.wait(lambda: probe.received, 60, "an answer")
    probe.send(signal.SIGKILL)
    with pytest.raises(TestbedError, match=r"waited for godot, but processes have ended: probe-robot1 with"):
        bed.wait(lambda: False, 60, "godot")
    probe.close()
    assert bed.wait(lambda: True, 60, "what nobody is missed for any more")


def test_what_was_seen_breaks_no_rule(bed: ChaosBed) -> None:
    bed.calm()
    assert bed.violations() == []


@contextmanager
def reliable_bed(folder: Path, on_crash: str, hz: float) -> Iterator[tuple[Netbed, Probe]]:
    """A robot, two edges, one ``reliable`` stream through them that flows; its books balance at the end."""
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=1, edges=2, timing="wired", stream_class="reliable")
    tree["tasks"][TASK]["inputs"][0] |= {"on_crash": on_crash, "depth": 8000}
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    with Netbed(folder, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        burst = max(1, round(hz / 100))
        probe = bed.probe("robot1", put="robot1/in", watch=["robot1/out"], hz=hz, burst=burst, blocks=True)
        bed.wait(probe.is_flowing, 60, "answers")
        yield bed, probe


def counted(bed: Netbed) -> StreamCount:
    """What robot1's relay has counted of its input."""
    return next(one for one in bed.counts("robot1") if one.stream == f"{TASK}/in/0")


def lost_and_told(bed: Netbed, probe: Probe) -> tuple[int, int]:
    """Of all numbers up to the newest that came back: how many did not, and how many the robot's counters tell of."""
    back = {one.number for one in tuple(probe.received)}
    counts = [count for count in bed.counts("robot1") if count.stream in {f"{TASK}/in/0", f"{TASK}/out/0"}]
    told = sum(map(given_up, counts))
    return max(back) + 1 - len(back), told


def test_a_new_owner_frozen_at_the_move_loses_nothing_silently(tmp_path: Path) -> None:
    """Its worker stands still from just before it is chosen until long after its link has ended."""
    with reliable_bed(tmp_path, "report", BUSY_HZ) as (bed, probe):
        owner = bed.wait_settled()
        other = "edge2" if owner == "edge1" else "edge1"
        (worker,) = descendants_running(bed.pid(other), "zsched.tasks.echo")
        os.kill(worker, signal.SIGSTOP)
        frozen = monotonic_s()
        try:
            bed.send(owner, signal.SIGTERM)  # it drains: a planned move
            bed.wait(lambda: bed.task("robot1")["owner"] == other, GIVE_UP_S, "the move")
            within(monotonic_s() - frozen, FROZEN_S)
            assert probe.first_after(frozen, but_of=owner) is None, "it stands still"
            bed.wait(lambda: monotonic_s() > frozen + FROZEN_S, 60, "the time that it stands still for")
        finally:
            with suppress(ProcessLookupError):  # ended at its start-up deadline: too slow
                os.kill(worker, signal.SIGCONT)
        awake = monotonic_s()
        bed.wait(lambda: bed.has_ended(owner), 60, "the end of the old owner's daemon")
        bed.wait(lambda: probe.first_after(awake, but_of=owner), 60, "an answer to what was sent since it is awake")
        bed.wait(lambda: lost_and_told(bed, probe)[0] <= lost_and_told(bed, probe)[1], 20, "a word of every loss")
        lost, told = lost_and_told(bed, probe)
        print(f"frozen at the move: lost {lost}, told of {told}", flush=True)
        # What came while it stood still has waited for it: of that nothing is lost. On a busy machine the old owner's
        # worker still has work in hand when its daemon's time to stop is over: that is lost, and told.
        assert lost < STOP_S * BUSY_HZ
        numbers = [one.number for one in tuple(probe.received)]
        assert numbers == sorted(set(numbers))


def test_a_power_cut_loses_nothing_where_the_rule_says_replay(tmp_path: Path) -> None:
    """From the fleet file by way of the daemon to the relay: what the dead owner had not done is done by the next."""
    with reliable_bed(tmp_path, "replay", 100.0) as (bed, probe):
        owner = bed.wait_settled()
        bed.wait(lambda: len(probe.received) > 50, 60, "some answers")
        bed.power_off(owner)
        cut = monotonic_s()
        bed.wait(lambda: probe.first_after(cut, but_of=owner), 60, "an answer of the next owner")
        settled = monotonic_s()
        bed.wait(lambda: is_back(probe, settled), 60, "answers to what was sent since")
        newest = probe.received[-1].number
        bed.wait(lambda: counted(bed).messages > newest, 20, "the counts of all that")
        lost, told = lost_and_told(bed, probe)
        times = Counter(one.number for one in tuple(probe.received))
        doubled = sum(count > 1 for count in times.values())
        replayed = counted(bed).replayed
        print(f"power cut: lost {lost}, told of {told}, replayed {replayed}, done twice {doubled}", flush=True)
        assert (lost, told) == (0, 0)
        assert replayed > 0, "the dead owner has left something, or this shows nothing"
        assert max(times.values()) <= 2, "by the dead owner, and once more by the next"
        first_ones = list(dict.fromkeys(one.number for one in tuple(probe.received)))
        assert first_ones == sorted(first_ones), "in order"
