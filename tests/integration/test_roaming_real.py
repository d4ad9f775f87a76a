"""A robot without an address in the fleet file gets another one: it roams, and its stream flows again by itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from zsched.host.clock import monotonic_s
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import OnboardBed, Probe
from zsched_lab.fleet.testbed import TASK, echo_fleet

pytestmark = [pytest.mark.long, pytest.mark.root, pytest.mark.timeout(240)]

ROBOT, LOCAL = "robot1", "tcp/127.0.0.1:7470"


def missing(probe: Probe) -> int:
    """Numbers without an answer below the newest that has one."""
    numbers = {one.number for one in probe.received}
    return max(numbers) + 1 - len(numbers)


@pytest.mark.parametrize("has_local_side", [True, False], ids=["local side", "data session"])
def test_a_robot_that_roams_is_served_again_and_its_lost_samples_are_counted(
    tmp_path: Path, *, has_local_side: bool
) -> None:
    """With a local side the relay stays: only what was under way may be lost, and the counters tell of it."""
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=2, edges=2, stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"
    if has_local_side:
        tree["nodes"][ROBOT]["local"] = {"mode": "peer", "listen": [LOCAL]}
    with OnboardBed(tmp_path, tree, hidden=(ROBOT,)) as bed:
        bed.init()
        bed.start()
        bed.wait_whole()
        probe = bed.probe(ROBOT, put=f"{ROBOT}/in", hz=50, watch=[f"{ROBOT}/out"], blocks=True)
        bed.wait(lambda: len(probe.received) > 50, 30, "answers")
        daemon, relay, life = bed.pid(ROBOT), bed.relay_pid(ROBOT), bed.status(ROBOT)["incarnation"]

        bed.network.renumber(ROBOT)
        moved_at = monotonic_s()
        bed.wait(lambda: probe.first_after(moved_at) is not None and probe.is_flowing(), 60, "answers again")
        bed.wait_whole()
        assert bed.pid(ROBOT) == daemon, "it begins again in its process"
        assert bed.status(ROBOT)["incarnation"] > life
        assert (bed.relay_pid(ROBOT) == relay) is has_local_side
        if has_local_side:
            bed.wait(lambda: missing(probe) <= bed.told_lost(ROBOT), 30, "the counters to tell of what was lost")
            assert len({one.number for one in probe.received}) == len(probe.received), "none came twice"


def test_a_node_that_the_others_dial_where_it_is_no_more_says_so_and_no_longer_when_it_is_back(tmp_path: Path) -> None:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    with OnboardBed(tmp_path, echo_fleet(robots=2, edges=1)) as bed:
        bed.init()
        bed.start()
        bed.wait_whole()
        home = bed.network.address(ROBOT)
        bed.network.renumber(ROBOT)

        def says() -> bool:
            return any(f"dial this machine at {home}, which is none" in one for one in bed.status(ROBOT)["problems"])

        bed.wait(says, 30, "the problem")
        bed.network.renumber(ROBOT, home)
        bed.wait(lambda: not says(), 30, "the problem to go")
        bed.wait_whole()
