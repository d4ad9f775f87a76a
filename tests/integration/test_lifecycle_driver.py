"""Managed ROS 2 nodes as workers on real daemons: active at the owner only; moved, killed, refusing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

NODE = Path(__file__).with_name("ros2_lifecycle_node.py")
ACTIVATE = "3"
INACTIVE, ACTIVE = 2, 3
pytestmark = [pytest.mark.long, pytest.mark.timeout(240)]


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    script = f"exec {sys.executable} {NODE} /$ZSCHED_NODE/slam {tmp_path}/$ZSCHED_NODE.states {ACTIVATE}"
    worker: dict[str, Any] = {
        "driver": "ros2_lifecycle",
        "node": "/{target}/slam",
        "command": ["sh", "-c", script],
        "ready": "matching",
        "env": {"ROS_DOMAIN_ID": "7"},
        "max_failures": 5,
        "start_deadline_s": 60,
    }
    with Testbed(tmp_path, echo_fleet(robots=1, edges=2, task={"worker": worker})) as made:
        made.init()
        made.start()
        yield made


def states(bed: Testbed, node: str) -> list[int]:
    """All states of the node on a machine, over its lives, oldest first."""
    file = bed.folder / f"{node}.states"
    return [int(line.split()[2]) for line in file.read_text().splitlines()] if file.exists() else []


def is_in(bed: Testbed, node: str, state: int) -> bool:
    return states(bed, node)[-1:] == [state]


def load(bed: Testbed, node: str) -> dict[str, Any]:
    found = next(one for one in bed.status("robot1")["nodes"] if one["name"] == node)
    return next(iter(found["workers"]), {"state": "unknown", "reason": ""})


def move(bed: Testbed, to: str) -> str:
    words = ("move", TASK, to, "--yes", "--node", "robot1", "--runtime-dir", str(bed.folder))
    done = subprocess.run(
        [sys.executable, "-m", "zsched.cli", *words], capture_output=True, text=True, timeout=60, check=False
    )
    return done.stdout + done.stderr


def test_a_managed_node_is_active_at_the_owner_only_and_followed_when_it_ends_or_refuses(bed: Testbed) -> None:
    first = bed.wait(bed.owner, 60, "an owner") or ""
    other = "edge2" if first == "edge1" else "edge1"
    bed.wait(
        lambda: is_in(bed, first, ACTIVE) and is_in(bed, other, INACTIVE), 60, "the owner is active, not the other"
    )
    bed.wait(lambda: load(bed, other)["state"] == "ready", 60, "the standby is ready")
    assert states(bed, other) == [1, INACTIVE], "a standby was never active"

    said = move(bed, other)
    bed.wait(lambda: bed.owner() == other, 30, f"the move, of which was said: {said}")
    bed.wait(lambda: is_in(bed, other, ACTIVE) and is_in(bed, first, INACTIVE), 30, "the states have followed")
    assert states(bed, first) == [1, INACTIVE, ACTIVE, INACTIVE]

    node = int((bed.folder / f"{other}-{TASK}.pid").read_text().split()[0])
    assert str(NODE).encode() in Path(f"/proc/{node}/cmdline").read_bytes(), "the node's process is measured"
    os.kill(node, signal.SIGKILL)
    bed.wait(lambda: f"/{other}/slam was killed by signal 9" in load(bed, other)["reason"], 30, "the reason in status")
    bed.wait(lambda: states(bed, other)[:3] == [1, INACTIVE, ACTIVE] and len(states(bed, other)) > 4, 60, "it is anew")

    owner = bed.wait_settled()
    standby = first if owner == other else other
    bed.wait(lambda: is_in(bed, standby, INACTIVE), 60, "the standby is inactive")
    (bed.folder / f"{standby}.refuse").touch()
    move(bed, standby)
    bed.wait(
        lambda: f"/{standby}/slam refused to activate" in load(bed, standby)["reason"], 60, "the refusal in status"
    )
    bed.wait(lambda: bed.owner() == owner and is_in(bed, owner, ACTIVE), 90, "the task leaves a node that refuses")
    assert not is_in(bed, standby, ACTIVE)
