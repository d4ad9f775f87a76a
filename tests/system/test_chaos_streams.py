"""Streams while the network or an application fails, on real daemons in namespaces: how long each robot goes without.

The fleet of the chaos tests, with an application on every robot. ``ZSCHED_CUTS=60`` plays the one-way cut sixty times.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from itertools import pairwise
from typing import Final

import pytest

from support.waiting import within
from zsched.clock import monotonic_s
from zsched.core.fleet import Timing
from zsched.core.model import NodeId
from zsched.lab import netns
from zsched.lab.chaos import ChaosBed
from zsched.lab.netbed import Probe

CUTS: Final = int(os.environ.get("ZSCHED_CUTS", "3"))
LONGEST_S: Final = 4.0
"""The longest time that a robot may go without answers after a one-way cut."""
GIVE_UP_S: Final = 30.0

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


def test_what_was_seen_breaks_no_rule(bed: ChaosBed) -> None:
    bed.calm()
    assert bed.violations() == []
