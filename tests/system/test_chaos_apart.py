"""Nodes that work apart and come together again, on real daemons in namespaces.

A robot that works alone while it is cut off, nodes that meet by gossip only, and one whose fleet file names other
electors than its state.

One fleet for the module: three robots and two edges; the edges and one robot give no address, so that these three can
only meet by gossip. Every robot keeps a standby of the task (`on_isolation: local`). Its streams are of two classes:
of ``latest`` both owners of a move may answer the newest value (docs/guide/streams.md), of ``reliable`` none.
"""

from __future__ import annotations

import json
import subprocess
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import pairwise
from pathlib import Path

import pytest

from zsched.core.values.model import NodeId
from zsched.host.clock import monotonic_s
from zsched.host.operator_client import ask
from zsched.host.paths import socket_path
from zsched.host.state_file import StateFile
from zsched_lab.fleet import netns
from zsched_lab.fleet.chaos import TWO_CLASSES
from zsched_lab.fleet.netbed import Netbed, Probe, Received
from zsched_lab.fleet.testbed import Json, echo_fleet

pytestmark = [pytest.mark.long, pytest.mark.root]

HIDDEN = ("edge1", "edge2", "robot3")
ROBOTS_TASK: Json = {"on_isolation": "local", **TWO_CLASSES}


class Bed(Netbed):
    """The fleet, and two applications on robot1: one with a stream of class ``latest``, one with ``reliable``."""

    __test__ = False
    app_on_robot1: Probe
    orders_of_robot1: Probe
    app_on_robot3: Probe

    def is_whole(self) -> bool:
        """Whether everybody is alive to everybody, and one owner serves."""
        states = {peer["state"] for node in self.names for peer in self.status(node)["nodes"]}
        return states == {"alive"} and self.owner() is not None and self._is_served()

    def _is_served(self) -> bool:
        return all(one.is_flowing() for one in (self.app_on_robot1, self.orders_of_robot1, self.app_on_robot3))

    def missed_by(self, node: NodeId) -> list[NodeId]:
        """Whom ``node`` does not hear."""
        return [peer["name"] for peer in self.status(node)["nodes"] if peer["state"] != "alive"]

    def served_by(self, node: NodeId) -> bool:
        """Whether ``node`` has answered both applications last, a moment ago."""
        newest = [one for probe in (self.app_on_robot1, self.orders_of_robot1) for one in tuple(probe.received[-1:])]
        return len(newest) == 2 and all(one.node == node and monotonic_s() - one.at < 0.3 for one in newest)


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bed]:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=3, edges=2, timing="wired", task=ROBOTS_TASK)
    with Bed(tmp_path_factory.mktemp("apart"), tree, hidden=HIDDEN) as bed:
        bed.init()
        bed.start()
        bed.app_on_robot1 = bed.probe("robot1", put="robot1/in", watch=["robot1/out"])
        bed.app_on_robot3 = bed.probe("robot3", put="robot3/in", watch=["robot3/out"])
        bed.orders_of_robot1 = bed.probe("robot1", put="robot1/order", watch=["robot1/done"])
        yield bed


@pytest.fixture
def bed(fleet: Bed) -> Iterator[Bed]:
    fleet.network.heal()
    fleet.wait(fleet.is_whole, 60, "everybody alive to everybody")
    yield fleet
    assert fleet.unaccounted() == []


def test_two_nodes_without_addresses_find_each_other_again_after_short_cuts(bed: Bed) -> None:
    """Cuts about as long as zenoh's lease: where both sides redialled, 3 links of 40 stayed alive and mute."""
    for length_s in (0.8, 1.0, 1.2):
        bed.network.cut("edge2")
        begin = monotonic_s()
        bed.wait(lambda: monotonic_s() > begin + length_s, 60, "the cut")  # noqa: B023 - called at once
        bed.network.heal()
        bed.wait(bed.is_whole, 60, f"everybody alive to everybody after {length_s} s")


def test_the_link_of_two_nodes_without_addresses_comes_back_when_it_alone_was_cut(bed: Bed) -> None:
    """Gossip tells of a peer only while a link is new, and the links of both to everybody else stay up."""
    owner = bed.owner()
    assert owner in HIDDEN
    bed.network.separate(["robot3"], [owner])
    bed.wait(lambda: not bed.app_on_robot3.is_flowing(), 60, "robot3 to lose its streams")
    bed.wait(lambda: "robot3" in bed.missed_by(owner), 60, "the end of the link")
    bed.network.heal()
    bed.wait(bed.is_whole, 60, "robot3's streams")


def test_a_robot_that_is_cut_off_is_served_by_its_own_standby_and_nothing_comes_twice(bed: Bed) -> None:
    owner, epoch = bed.owner(), bed.task("robot1")["epoch"]
    assert owner is not None
    assert owner != "robot1"
    bed.network.cut("robot1")
    bed.wait(lambda: bed.served_by("robot1"), 60, "answers of its own worker")
    assert any("works alone" in text for text in bed.task("robot1")["problems"]), bed.task("robot1")
    assert bed.task("robot1")["epoch"] == epoch
    assert bed.owner("robot2", "robot3", "edge1", "edge2") == owner, "the others go on"
    bed.network.heal()
    bed.wait(lambda: bed.served_by(owner), 60, "answers of the owner")
    assert bed.task("robot1")["epoch"] == epoch, "whoever is heard first is no reason to flee from the owner"
    healed = monotonic_s()
    bed.wait(lambda: monotonic_s() > healed + 1.0, 60, "a second of them")
    counts = Counter(one.number for one in tuple(bed.orders_of_robot1.received))
    assert [number for number, count in counts.items() if count > 1] == [], "of class reliable nothing comes twice"
    assert_only_the_newest_came_twice(tuple(bed.app_on_robot1.received))
    owners = bed.app_on_robot1.owners("robot1/out")
    assert owners[-3:] == [owner, "robot1", owner], "the local slot closes before the owner's opens"
    assert not any("works alone" in text for text in bed.task("robot1")["problems"])


def assert_only_the_newest_came_twice(received: Sequence[Received]) -> None:
    """Class ``latest``: when the owner changes the newest value may be answered again, and nothing older follows it."""
    pairs = tuple(pairwise(received))
    assert [(one.number, after.number) for one, after in pairs if after.number < one.number] == []
    moves = sum(one.node != after.node for one, after in pairs)
    twice = [one.number for one, after in pairs if after.number == one.number]
    assert len(twice) <= 2 * moves, (twice, moves)


def test_a_node_whose_file_names_other_electors_than_its_state_is_no_elector_and_works_on(bed: Bed) -> None:
    """The operator changed the electorate on one machine, and restarted it: nothing it says counts in a commit."""
    tree = json.loads(bed.file.read_text())
    tree["electorate"] = ["robot1", "robot2", "edge1"]
    file = bed.folder / "changed.yaml"
    file.write_text(json.dumps(tree))
    bed.stop("robot2")
    stored = StateFile(bed.folder / "robot2", fleet=bed.fleet.name, node="robot2").path
    state = stored.read_bytes()
    process = spawn(bed, "robot2", file)
    try:
        bed.wait(lambda: status(bed)["quorum"]["this_node"] != "elector", 60, "robot2 to be no elector")
        bed.wait(lambda: status(bed)["tasks"][0]["owner"] == bed.task("robot1")["owner"], 60, "what was agreed")
        said = "\n".join(status(bed)["problems"])
        assert "another electorate" in said
        assert "no valid state file" not in said, "it is whole"
        assert status(bed)["quorum"]["this_node"] == "other_electorate"
        assert bed.weigh("robot1", 0.6)["outcome"] == "ok", "two of three agree without it"
        bed.wait(lambda: status(bed)["tasks"][0]["revision"] == bed.task("robot1")["revision"], 60, "it hears of it")
    finally:
        process.terminate()
        process.wait(60)
    assert stored.read_bytes() == state, "what it had promised stays on its disk"
    bed.start("robot2")
    bed.wait(lambda: status(bed)["quorum"]["this_node"] == "elector", 60, "an elector again, with the old file")


def status(bed: Bed) -> Json:
    found: Json = ask(socket_path(bed.folder, "robot2"), {"verb": "status"}, 3.0)
    return found


def spawn(bed: Bed, node: NodeId, file: Path) -> subprocess.Popen[bytes]:
    command = [*bed._daemon, "--config", file, "--node", node, *bed._folders(node)]
    return bed.spawn(node, command, log=f"{node}.log")
