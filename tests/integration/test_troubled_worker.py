"""Workers in trouble, with real daemons: every node's status says what is wrong, and a failed one has a way back."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

WORKER = Path(__file__).with_name("touchy_echo.py")


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    tree = echo_fleet(robots=2, edges=2, timing="wired", worker=("python", str(WORKER)))
    tree["tasks"][TASK]["worker"]["env"] = {"TOUCHY_FOLDER": str(tmp_path)}
    with Testbed(tmp_path, tree) as made:
        made.init()
        yield made


def told(bed: Testbed, node: str, *words: str) -> list[str]:
    """The problems of the task in a node's status that hold all these words."""
    return [text for text in bed.task(node)["problems"] if all(word in text for word in words)]


def worker(bed: Testbed, node: str) -> dict[str, Any]:
    """The worker on ``node``, as robot1 shows it."""
    nodes = {one["name"]: one for one in bed.status("robot1")["nodes"]}
    found: dict[str, Any] = nodes[node]["workers"][0]
    return found


def restart(bed: Testbed, *arguments: str) -> tuple[int, dict[str, Any]]:
    folder = str(bed.folder)
    command = [
        sys.executable,
        "-m",
        "zsched.cli",
        "restart",
        TASK,
        *arguments,
        "--yes",
        "--json",
        "--runtime-dir",
        folder,
    ]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=60, check=False, env={"ZSCHED_NODE": "robot1"}
    )
    return done.returncode, json.loads(done.stdout) if done.stdout else {"error": done.stderr}


def test_a_callback_that_raises_is_in_every_node_s_status(bed: Testbed) -> None:
    bed.start()
    owner = bed.wait_settled()
    robot = bed.app("robot1")
    publisher = robot.declare_publisher("robot1/in")
    heard: list[bytes] = []
    kept = robot.declare_subscriber("robot1/out", lambda sample: heard.append(sample.payload.to_bytes()))
    count = 0

    def complains(node: str) -> bool:
        nonlocal count
        count += 1
        publisher.put(f"bad {count}")
        return bool(told(bed, node, f"the worker on {owner}: callback raised", "ValueError: no such map"))

    for node in bed.names:
        bed.wait(partial(complains, node), 60, f"{node} knows")
    assert worker(bed, owner)["state"] == "ready"

    def answers() -> bool:
        publisher.put("good")
        return b"good" in heard

    bed.wait(answers, 60, "what does not raise is answered all the same")
    assert bed.log(owner).count("Traceback") <= 3, "not one a sample"
    kept.undeclare()


@pytest.mark.long
def test_a_failed_worker_is_told_everywhere_and_comes_back_when_it_is_tried_again(bed: Testbed) -> None:
    broken = bed.folder / "broken-edge1"
    broken.touch()
    bed.start()
    assert bed.wait_settled() == "edge2"
    why = ("the worker on edge1 failed", "exited with status 78: no model file here")
    for node in bed.names:
        bed.wait(partial(told, bed, node, *why), 60, f"{node} knows why")

    assert restart(bed, "edge1")[0] == 0
    bed.wait(lambda: "no model" in worker(bed, "edge1")["reason"], 60, "it fails again")
    broken.unlink()
    code, answer = restart(bed, "edge1")
    assert (code, answer["node"], answer["outcome"]) == (0, "edge1", "ok")
    bed.wait(lambda: worker(bed, "edge1")["state"] == "ready", 60, "it runs, without a restart of the daemon")
    bed.wait(lambda: not told(bed, "robot2", "failed"), 60, "nothing is told any more")

    assert restart(bed, "edge7")[0] == 2
    bed.kill("edge2")
    bed.wait(lambda: bed.owner() == "edge1", 60, "it takes the task")
