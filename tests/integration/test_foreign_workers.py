"""Any zenoh program as a worker: real daemons on the form of configs/ros2-node.yaml.

The worker knows nothing of zsched. It is started by zsched or by somebody else, runs all the time or only at its owner;
then it is killed.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from ruamel.yaml import YAML

from support.ros_host import opened
from support.verbs import command
from support.waiting import free_endpoint, until
from zsched.core.route.ros2 import Endpoint, EndpointKind, default_qos, endpoint_token
from zsched.core.values.plan import RosGraph
from zsched.link.sessions.config import client_config
from zsched_lab.fleet.testbed import Testbed, echo_fleet

pytestmark = pytest.mark.long

ROOT = Path(__file__).parents[2]
MERGER = Path(__file__).with_name("ros_merger.py")
TYPE = "nav_msgs::msg::dds_::OccupancyGrid_/RIHS01_8d348150c12913a31ee0ec170fbf25089e4745d17035792a1ba94d6f0bc0cfc7"
TASK = "map_merge"
PERIOD_S = 0.05
AWAY_S = 8.0


class Host:
    """robot1's own network: its router, and an application that publishes /map and hears /merged_map."""

    def __init__(self, stack: ExitStack) -> None:
        self.endpoint = free_endpoint()
        stack.callback(opened(client_config(connect=()), "router", self.endpoint).close)
        self._session = opened(client_config(connect=(self.endpoint,)))
        stack.callback(self._session.close)
        self._declared: list[Any] = []
        self.heard: list[tuple[float, str]] = []
        self._count = 0

    def begin(self) -> None:
        """Join the graph, as a node does."""
        zid = str(self._session.zid())
        for number, (kind, key) in enumerate(
            ((EndpointKind.PUBLISHER, f"0/map/{TYPE}"), (EndpointKind.SUBSCRIPTION, f"0/merged_map/{TYPE}"))
        ):
            endpoint = Endpoint(kind=kind, key=key, qos=default_qos(is_latched=True, depth=1))
            token = endpoint_token(RosGraph.RMW_ZENOH, endpoint, zid=zid, node="slam", number=number)
            self._declared.append(self._session.liveliness().declare_token(token))
        self._declared.append(self._session.declare_subscriber(f"0/merged_map/{TYPE}", self._hear))
        self._publisher = self._session.declare_publisher(f"0/map/{TYPE}")

    def _hear(self, sample: zenoh.Sample) -> None:
        self.heard.append((time.monotonic(), sample.payload.to_string().split()[0]))

    def answers_from(self, node: str, since: float) -> bool:
        """Publish one map; whether ``node`` has answered one since then."""
        self._count += 1
        self._publisher.put(f"map {self._count}")
        time.sleep(PERIOD_S)
        return any(at >= since and who == node for at, who in tuple(self.heard))


class Merging:
    """The fleet of configs/ros2-node.yaml on this machine: one of its robots, both edges."""

    def __init__(self, folder: Path, stack: ExitStack, *, has_command: bool, standby: str = "warm") -> None:
        tree = YAML(typ="safe").load((ROOT / "configs" / "ros2-node.yaml").read_text())
        here = echo_fleet(robots=1, edges=2)["nodes"]
        self.host = Host(stack)
        for name, node in here.items():
            tree["nodes"][name] = {**node, "local": {"connect": [self.host.endpoint]}} if "robot" in name else node
        for name in set(tree["nodes"]) - set(here):
            del tree["nodes"][name]
        worker = tree["tasks"][TASK]["worker"]
        assert (worker["ready"], worker["command"][0]) == ("matching", "bash"), "the form has changed"
        worker |= {"standby": standby, "failure_window_s": 600}
        worker["command"] = [sys.executable, str(MERGER)]
        tree["tasks"][TASK]["demand"] = {"cpu_cores": 0.1, "memory_mb": 50}
        if not has_command:
            del worker["command"]
            worker["start_deadline_s"] = AWAY_S  # nobody is ended by it, so a busy machine's slow start does no harm
        self.bed = stack.enter_context(Testbed(folder, tree))
        self._stack = stack
        self._folder = folder
        self.bed.init()
        self.bed.start()
        self.host.begin()

    def start_worker(self, node: str) -> subprocess.Popen[bytes]:
        """Somebody else starts a worker for ``node``."""
        config = self._folder / f"{node}-{TASK}.zenoh.json5"  # the daemon writes it, whoever starts the worker
        until(config.exists, "the daemon has said how a worker joins")
        env = {**os.environ, "ZSCHED_NODE": node, "ZENOH_SESSION_CONFIG_URI": str(config)}
        with (self._folder / f"{node}-foreign.log").open("ab") as log:
            process = subprocess.Popen([sys.executable, MERGER], stdin=subprocess.DEVNULL, stderr=log, env=env)
        self._stack.callback(end, process)
        return process

    def task(self, node: str = "robot1") -> dict[str, Any]:
        """The task's block in one node's status."""
        return self.bed.task(node)

    def worker(self, node: str, seen_by: str = "robot1") -> dict[str, Any]:
        """What one node's status says of the worker on another."""
        nodes = {one["name"]: one for one in self.bed.status(seen_by)["nodes"]}
        loads: list[dict[str, Any]] = nodes[node]["workers"]
        return loads[0] if loads else {"state": "unknown", "reason": ""}

    def why(self, node: str) -> str:
        """Why the worker on a node is not ready, as robot1 shows it."""
        reason: str = self.worker(node)["reason"]
        return reason

    def serving(self, deadline_s: float = 60.0) -> str:
        """The owner, once it has answered the application."""

        def found() -> str | None:
            owner: str | None = self.task()["owner"]
            return owner if owner is not None and self.host.answers_from(owner, began) else None

        began = time.monotonic()
        return self.bed.wait(found, deadline_s, "an owner that answers") or ""


def end(process: subprocess.Popen[bytes]) -> None:
    process.kill()
    process.wait(60)


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as made:
        yield made


def pids_of(bed: Testbed, node: str) -> list[int]:
    """The processes of the workers that one daemon has started, newest last."""
    lines = [line for line in bed.log(node).splitlines() if "worker_started" in line]
    return [int(line.partition(" pid=")[2].partition(" ")[0]) for line in lines]


def has_started(bed: Testbed, node: str, count: int) -> bool:
    return len(pids_of(bed, node)) == count


def test_a_stock_node_that_zsched_starts_is_warm_serves_and_is_followed_when_it_fails(
    tmp_path: Path, stack: ExitStack
) -> None:
    fleet = Merging(tmp_path, stack, has_command=True)
    owner = fleet.serving()
    other = "edge2" if owner == "edge1" else "edge1"
    fleet.bed.wait(lambda: fleet.worker(other)["state"] == "ready", 60, "the standby is ready though it owns nothing")
    assert [len(pids_of(fleet.bed, node)) for node in (owner, other)] == [1, 1], "none was ended at its deadline"
    for life in (1, 2, 3):  # as often as the default lets a worker fail
        until(partial(has_started, fleet.bed, owner, life), "the next process runs")
        os.kill(pids_of(fleet.bed, owner)[-1], signal.SIGKILL)
    fleet.bed.wait(lambda: fleet.task()["owner"] == other, 60, "the task leaves a worker that failed")
    assert fleet.serving() == other
    load = fleet.worker(owner, seen_by=other)
    assert load["state"] == "failed"
    assert "killed by signal 9" in load["reason"]
    assert [problem for problem in fleet.task()["problems"] if f"the worker on {owner} failed: killed" in problem]


def test_a_cold_stock_node_is_started_for_its_task_and_serves(tmp_path: Path, stack: ExitStack) -> None:
    fleet = Merging(tmp_path, stack, has_command=True, standby="cold")
    owner = fleet.serving()
    other = "edge2" if owner == "edge1" else "edge1"
    assert len(pids_of(fleet.bed, owner)) == 1
    assert pids_of(fleet.bed, other) == []
    fleet.bed.wait(lambda: fleet.worker(owner)["state"] == "ready", 60, "no deadline runs for it any more")
    assert len(pids_of(fleet.bed, owner)) == 1
    fleet.bed.stop(owner)
    fleet.bed.wait(lambda: fleet.task()["owner"] == other, 60, "the task moves")
    assert fleet.serving() == other


def test_without_any_worker_nobody_owns_the_task_and_status_says_who_is_missed(
    tmp_path: Path, stack: ExitStack
) -> None:
    fleet = Merging(tmp_path, stack, has_command=False)

    def judged() -> dict[str, Any] | None:
        decision: dict[str, Any] | None = fleet.task()["decision"]
        return decision if decision is not None and len(decision["vetoed"]) == 2 else None

    decision = fleet.bed.wait(judged, 60, "a decision about both edges") or {}
    assert fleet.task()["owner"] is None
    for node in ("edge1", "edge2"):
        why = fleet.bed.wait(partial(fleet.why, node), 60, "why there is no worker")
        assert f"nobody subscribes to 0/{node}/map_merge/" in why
    assert decision["outcome"] == "none"
    assert set(decision["vetoed"]) == {"edge1", "edge2"}


def test_a_worker_that_somebody_else_starts_is_seen_to_come_and_to_go(tmp_path: Path, stack: ExitStack) -> None:
    fleet = Merging(tmp_path, stack, has_command=False)
    first = fleet.start_worker("edge2")
    assert fleet.serving() == "edge2", "the only node that has a worker"
    second = fleet.start_worker("edge1")
    fleet.bed.wait(lambda: fleet.worker("edge1")["state"] == "ready", 60, "the other one is seen, too")
    assert fleet.task()["owner"] == "edge2"

    end(first)
    fleet.bed.wait(
        lambda: [text for text in fleet.task()["problems"] if "edge2" in text and "nobody subscribes to" in text],
        AWAY_S,
        "the owner's status says that nobody is there",
    )
    fleet.bed.wait(lambda: fleet.task()["owner"] == "edge1", 60, "an escape after the deadline")
    assert fleet.serving() == "edge1"

    def told() -> bool:
        problems = fleet.task()["problems"]
        is_named = any(text.startswith("the worker on edge2 was ready until") for text in problems)
        return is_named and "no other candidate can take it" in problems

    fleet.bed.wait(told, 60, "status names the standby that is away")
    said = command(fleet.bed, "wait", "--until", "healthy", "--timeout", "0")
    assert "healthy: not met" in said
    assert "no other candidate can take it" in said
    third = fleet.start_worker("edge2")
    said = command(fleet.bed, "wait", "--until", "healthy", "--timeout", "50")
    assert "healthy: met" in said, said
    end(third)  # or it would get the task while the other one is away

    end(second)
    fleet.bed.wait(lambda: fleet.worker("edge1")["state"] == "stopped", 60, "its end is seen")
    fleet.start_worker("edge1")
    fleet.bed.wait(lambda: fleet.worker("edge1")["state"] == "ready", 60, "it is back")
    assert fleet.serving() == "edge1"


def test_a_recorder_of_everything_is_not_taken_for_a_worker_without_a_word(tmp_path: Path, stack: ExitStack) -> None:
    fleet = Merging(tmp_path, stack, has_command=False)
    fleet.bed.wait(lambda: fleet.worker("edge1")["reason"], 60, "nobody is there")
    recorder = fleet.bed.app("edge1").declare_subscriber("**", lambda _sample: None)
    told = "somebody takes every node's inputs"
    fleet.bed.wait(
        lambda: [text for text in fleet.bed.status("edge1")["problems"] if told in text], 60, "the doubt is told"
    )
    recorder.undeclare()
    fleet.bed.wait(
        lambda: not [text for text in fleet.bed.status("edge1")["problems"] if told in text], 60, "and ends with it"
    )
    fleet.bed.wait(lambda: fleet.worker("edge1")["state"] == "stopped", 60, "nobody is there")
