"""Strangers on the network, twins, and electors that lose their disk or their memory, on real daemons in namespaces.

One fleet for the module: three robots and two edges, all electors. Disks are lost in the order of the tests, each run
leaves a majority until the last one, which brings the fleet back by a new generation.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import msgpack
import pytest

from support.beats import beat_of
from zsched.commands.members.blank import init_state
from zsched.core.membership.identity import TOLD_YOUNG_S
from zsched.core.values import codec as wire
from zsched.host.operator_client import ask
from zsched.host.paths import socket_path
from zsched.link.keyspace import Keyspace
from zsched.link.sessions import config as zenoh_config
from zsched_lab.fleet import netns
from zsched_lab.fleet.netbed import CONTROL_PORT, Netbed, Probe
from zsched_lab.fleet.testbed import DAEMON, TASK, Json, echo_fleet

pytestmark = [pytest.mark.long, pytest.mark.root]

GUEST = "guest"
"""A machine on the network that the fleet file does not name."""
PUT = """
import sys, time, zenoh
with zenoh.open(zenoh.Config.from_json5(sys.argv[1])) as session:
    for _ in range(20):
        session.put(sys.argv[2], bytes.fromhex(sys.argv[3]))
        time.sleep(0.02)
"""


class Bed(Netbed):
    """The fleet, an application on robot1, and a place for a guest."""

    __test__ = False
    app_on_robot1: Probe

    def agree(self, node: str, cpu: float) -> None:
        """Change the weights, as often as it takes: the fleet may be busy with something else."""
        self.wait(lambda: self.weigh(node, cpu).get("outcome") == "ok", 60, f"an agreement by {node}")

    def role(self, node: str) -> str:
        """What an elector is at present."""
        found: str = self.status(node)["quorum"]["this_node"]
        return found

    def problems(self, node: str) -> str:
        """Its status' problems."""
        return "\n".join(self.status(node)["problems"])

    def revision(self) -> int | None:
        """The revision that all nodes know; ``None`` while they differ."""
        found = {self.task(node)["revision"] for node in self.running()}
        return found.pop() if len(found) == 1 else None


@pytest.fixture(scope="module")
def bed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bed]:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    tree = echo_fleet(robots=3, edges=2, timing="wired")
    tree["electorate"] = sorted(tree["nodes"])
    folder = tmp_path_factory.mktemp("electors")
    with Bed(folder, tree, tmpfs={"robot3": "64k", "robot2": "64k"}) as found:
        found.network.add(GUEST)
        found.init()
        found.start()
        found.app_on_robot1 = found.probe("robot1", put="robot1/in", watch=["robot1/out"])
        found.wait_settled()
        yield found


@pytest.fixture(autouse=True)
def books(bed: Bed) -> Iterator[None]:
    """After every test each sample is in one counter of a robot's relay."""
    yield
    assert bed.unaccounted() == []


@contextlib.contextmanager
def guest(bed: Bed, node: str, tree: Json) -> Iterator[tuple[Path, subprocess.Popen[bytes]]]:
    """A daemon in the guest's namespace with a fleet file, state and runtime folder of its own."""
    folder = bed.folder / f"guest-{node}"
    folder.mkdir(exist_ok=True)
    file = folder / "fleet.yaml"
    file.write_text(json.dumps(tree))
    command: list[str | Path] = [*DAEMON, "--config", file, "--node", node]
    command += ["--state-dir", folder / "state", "--runtime-dir", folder]
    process = bed.spawn(GUEST, command, log=f"guest-{node}.log")
    try:
        yield folder, process
    finally:
        process.kill()
        process.wait(60)


def inside(bed: Bed, node: str) -> Path:
    """The state folder of a node with its own file system, as that node sees it."""
    return Path(f"/proc/{bed.pid(node)}/root{bed.folder / node}")


# --- strangers -------------------------------------------------------------------------------------------------------


def test_second_fleet_on_the_same_network_stays_apart(bed: Bed) -> None:
    """Its daemon dials our nodes, zenoh joins them; neither sees anything of the other."""
    tree = json.loads(bed.file.read_text())
    before = bed.status("robot1")
    host = bed.network.address(GUEST)
    tree["fleet"] = "another"
    tree["nodes"]["robot9"] = {**tree["nodes"]["robot1"], "host": host}
    with guest(bed, "robot9", tree) as (folder, _):

        def is_joined() -> bool:
            links = netns.run("ip", "netns", "exec", bed.network.name_of(GUEST), "ss", "-Htn")
            return sum("ESTAB" in line and ":7457" in line for line in links.splitlines()) >= 2

        bed.wait(is_joined, 60, "zenoh links to our nodes")
        bed.wait(lambda: ask(socket_path(folder, "robot9"), {"verb": "status"})["up_s"] > 1.5, 60, "its status")
        theirs = ask(socket_path(folder, "robot9"), {"verb": "status"})
        assert {node["state"] for node in theirs["nodes"] if node["name"] != "robot9"} == {"unknown"}
        assert theirs["tasks"][0]["revision"] == 0
    after = bed.status("robot1")
    assert after["tasks"][0]["epoch"] == before["tasks"][0]["epoch"]
    assert {node["state"] for node in after["nodes"]} == {"alive"}
    assert {key for key in after["counters"] if key.startswith("dropped")} <= set(before["counters"])


def test_frames_of_another_wire_version_are_counted_and_nothing_else(bed: Bed) -> None:
    beat = beat_of("robot2", 10**6, incarnation=2**40, learnt=((TASK, 10**6, 10**6),), suspects=("robot1",))
    version, *rest = msgpack.unpackb(wire.encode(beat))
    frame = msgpack.packb([version + 1, *rest])
    epoch = bed.task("robot1")["epoch"]
    config = zenoh_config.client_config(
        connect=(f"tcp/{bed.network.address('robot1')}:{CONTROL_PORT}",), timing=bed.fleet.timing
    )
    key = Keyspace(bed.fleet.name).beat("robot2")
    process = bed.spawn(GUEST, [sys.executable, "-c", PUT, config, key, frame.hex()], log="putter.log")
    assert process.wait(60) == 0
    bed.wait(lambda: bed.status("robot1")["counters"].get("dropped_beat_version", 0) >= 10, 60, "the frames counted")
    assert (bed.task("robot1")["epoch"], bed.owner() is not None) == (epoch, True)
    assert {node["state"] for node in bed.status("robot1")["nodes"]} == {"alive"}


# --- twins and lost disks --------------------------------------------------------------------------------------------


def test_full_disk_makes_no_elector_and_the_node_works_on(bed: Bed) -> None:
    with contextlib.suppress(OSError), (inside(bed, "robot3") / "filler").open("wb") as filler:
        while True:
            filler.write(bytes(4096))
            filler.flush()
    bed.agree("robot1", 0.6)
    bed.wait(lambda: bed.role("robot3") != "elector", 60, "robot3 to be no elector")
    assert "No space left on device" in bed.problems("robot3")
    owner = bed.wait(lambda: bed.task("robot1")["owner"], 60, "an owner")
    assert owner == bed.task("robot3")["owner"]
    bed.wait(bed.app_on_robot1.is_flowing, 60, "echoes")
    bed.agree("robot1", 0.5)


def test_disk_remounted_read_only_makes_no_elector(bed: Bed) -> None:
    """As the kernel does when a card fails: an open lock file cannot hold a new mount on top back."""
    folder = bed.folder / "robot2"
    script = 'mount --bind "$1" "$1" && mount -o remount,bind,ro "$1"'
    netns.run("nsenter", "--mount", f"--target={bed.pid('robot2')}", "sh", "-c", script, "sh", str(folder))
    bed.agree("robot1", 0.7)
    bed.wait(lambda: bed.role("robot2") != "elector", 60, "robot2 to be no elector")
    assert "Read-only file system" in bed.problems("robot2")
    bed.wait(lambda: bed.owner() is not None, 60, "an owner")
    bed.wait(bed.app_on_robot1.is_flowing, 60, "echoes")


def test_too_many_lost_states_move_nothing_until_a_new_generation(bed: Bed) -> None:
    """Three of five are lost: what was allocated stays, status says why; a new generation on all nodes helps."""
    for node in ("edge1", "robot2", "robot3"):
        bed.kill(node)
        bed.tmpfs.pop(node, None)
        shutil.rmtree(bed.folder / node)
    bed.start()
    lost = ("edge1", "robot2", "robot3")
    bed.wait(lambda: all(bed.role(node) == "lost_state" for node in lost), 60, "three without state")
    bed.wait(lambda: bed.revision() is not None, 60, "all know what was agreed")
    epoch = bed.task("robot1")["epoch"]
    refused = bed.weigh("robot1", 0.55)
    assert refused.get("outcome") == "no_quorum", refused
    assert "no valid state file" in bed.problems("robot3")
    bed.wait(bed.app_on_robot1.is_flowing, 60, "echoes, for what was allocated stays")
    bed.stop()
    for node in bed.names:
        init_state(bed.fleet, node, bed.folder / node, 1)
    bed.start()
    bed.wait_settled()
    assert bed.task("robot1")["epoch"] >= 2**32 > epoch
    bed.wait(bed.app_on_robot1.is_flowing, 60, "echoes")


def test_twins_that_meet_after_a_cut_both_stop_electing(bed: Bed) -> None:
    """The copy came up where it could not see its original: neither leaves, so neither may vote as robot3 any more."""
    bed.wait_settled()
    tree = json.loads(bed.file.read_text())
    bed.network.cut(GUEST)
    init_state(bed.fleet, "robot3", bed.folder / "guest-robot3" / "state", 1)  # an operator who asks nobody
    with guest(bed, "robot3", tree) as (folder, _):
        twin = socket_path(folder, "robot3")
        old_s = TOLD_YOUNG_S + 0.5
        bed.wait(lambda: ask(twin, {"verb": "status"})["up_s"] > old_s, 60, "a twin that is not young any more")
        bed.network.heal()
        bed.wait(
            lambda: ask(twin, {"verb": "status"})["quorum"]["this_node"] != "elector", 60, "the twin to stand down"
        )
        bed.wait(lambda: bed.role("robot3") != "elector", 60, "the original to stand down")
        assert "another daemon calls itself" in bed.problems("robot3")
    bed.agree("robot1", 0.65)


def test_what_a_killed_test_leaves_is_swept() -> None:
    reason = netns.why_not()
    if reason is not None:
        pytest.skip(f"no network namespaces here: {reason}")
    script = (
        "import os, subprocess; from zsched_lab.fleet.netns import Network; network = Network(['one']); "
        "quiet = {'stdout': subprocess.DEVNULL, 'stderr': subprocess.DEVNULL}; "
        "child = subprocess.Popen(network.wrap('one', ['sleep', '1000']), **quiet); "
        "print(network.name_of('one'), child.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=30, check=False)
    name, pid = done.stdout.split()
    assert name in netns.run("ip", "netns", "list")
    netns.sweep()
    assert name not in netns.run("ip", "netns", "list")
    with contextlib.suppress(ProcessLookupError):
        os.kill(int(pid), 0)
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
        assert state == "Z", "only a zombie that nobody has reaped yet"
