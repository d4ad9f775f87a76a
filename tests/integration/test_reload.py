"""A changed fleet file under running daemons (SIGHUP): a reliable stream runs on, whole, while the rest changes."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from copy import deepcopy
from pathlib import Path
from typing import Any

import pytest
import zenoh

from support.operators import Stream
from support.sessions import matches
from zsched.core.executor.renewing import SAME_FILE_S
from zsched.core.hop.books import unaccounted
from zsched.link.keyspace import Keyspace
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

Tree = dict[str, Any]
PERIOD_S = 0.005


@contextmanager
def stream_of(bed: Testbed) -> Iterator[Stream]:
    """An application beside robot1, whose stream has begun."""
    stream = Stream(bed.app("robot1"), PERIOD_S)
    bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
    stream.start()
    try:
        yield stream
    finally:
        stream.end()


def flows(stream: Stream) -> Callable[[], bool]:
    """Whether 50 more samples have come back since now."""
    wanted = len(stream.back) + 50
    return lambda: len(stream.back) >= wanted


def reload(bed: Testbed, tree: Tree) -> None:
    bed.file.write_text(json.dumps(tree, indent=1))
    for name in bed.running():
        bed.send(name, signal.SIGHUP)


def worker_lives(bed: Testbed) -> dict[str, list[str]]:
    """{node: the pids of the workers of the first task that were started there}, in their order."""
    lines = {name: bed.log(name).splitlines() for name in bed.names}
    return {
        name: [line.rpartition("pid=")[2].split()[0] for line in lines[name] if f"worker_started task={TASK} " in line]
        for name in bed.names
    }


def has_another_task(bed: Testbed) -> bool:
    status = bed.status("robot1")
    return any(task["name"] == "second" and task["owner"] and task["phase"] == "settled" for task in status["tasks"])


def test_tasks_weights_and_commands_change_while_a_reliable_stream_runs(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=2, timing="wired", stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"  # by `latest` a move cuts the old owner's late answers off
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        with stream_of(bed) as stream:
            bed.wait(flows(stream), 60, "the stream through the first owner")
            relay = bed.relay_pid("robot1")

            # a task comes, and the weights of the one that runs change
            tree = deepcopy(tree)
            tree["tasks"]["second"] = deepcopy(tree["tasks"][TASK])
            tree["tasks"]["second"]["inputs"][0] |= {"from": "{robot}/in2", "to": "{target}/second/{robot}/in"}
            tree["tasks"]["second"]["outputs"][0] |= {
                "from": "{target}/second/{epoch}/{robot}/out",
                "to": "{robot}/out2",
            }
            tree["tasks"][TASK]["weights"] = {"cpu": 0.25, "memory": 0.75, "network": 0.0}
            reload(bed, tree)
            bed.wait(lambda: has_another_task(bed), 60, "the task that came has an owner")
            bed.wait(lambda: bed.task("robot1")["tuning"]["weights"]["cpu"] == 0.25, 60, "the weights are agreed anew")
            agreed = time.monotonic()
            bed.wait(lambda: time.monotonic() > agreed + 2.0 * SAME_FILE_S, 60, "the time after which old workers end")
            assert [len(lives) for lives in worker_lives(bed).values()] == [1, 1, 0], "no worker was started again"

            # another command: standby first, then a move, then the owner of before
            owner = bed.wait(lambda: bed.owner("robot1"), 60, "the owner")
            tree["tasks"][TASK]["worker"]["env"] = {"ANOTHER": "1"}
            reload(bed, tree)
            bed.wait(lambda: [len(one) for one in worker_lives(bed).values()] == [2, 2, 0], 90, "each worker runs anew")
            assert bed.owner("robot1") != owner, "the owner has given the task away before its worker ended"
            bed.wait(flows(stream), 60, "the stream through the next owner")

            # the task that came goes again
            del tree["tasks"]["second"]
            reload(bed, tree)
            bed.wait(lambda: len(bed.status("robot1")["tasks"]) == 1, 60, "the task is gone")
            bed.wait(flows(stream), 60, "the stream runs on")
            stream.end()

            def is_settled() -> bool:
                count = next(count for count in bed.counts("robot1") if count.stream == f"{TASK}/in/0")
                return count.acknowledged == stream.sent and len(stream.back) >= stream.sent

            bed.wait(is_settled, 60, "every sample is acknowledged, and answered")
            assert stream.back == list(range(stream.sent)), "lost 0, doubled 0, in order"
            count = next(count for count in bed.counts("robot1") if count.stream == f"{TASK}/in/0")
            assert (count.lost, count.at_most_lost, unaccounted(count)) == (0, 0, 0)
            assert bed.relay_pid("robot1") == relay, "the relay is the same"
            assert [problem for problem in bed.status("robot1")["problems"] if "fleet" in problem] == []


def test_what_needs_a_restart_is_told_and_a_wrong_file_changes_nothing(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=1, timing="wired")
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        changed = deepcopy(tree)
        changed["shared_memory"] = "auto"
        reload(bed, changed)
        bed.wait(lambda: told(bed, "`shared_memory`"), 30, "what needs a restart is told")
        bed.file.write_text("nodes: [")
        bed.send("robot1", signal.SIGHUP)
        bed.wait(lambda: told(bed, "the changed fleet file is not in force"), 30, "a wrong file is told")
        reload(bed, tree)
        bed.wait(lambda: not told(bed, "fleet file") and not told(bed, "restarted"), 30, "all is as it was")
        assert bed.owner("robot1") == "edge1"


def told(bed: Testbed, text: str) -> bool:
    time.sleep(0.01)
    return any(text in problem for problem in bed.status("robot1")["problems"])


@pytest.mark.parametrize("ready", ["matching", "token"])
def test_a_worker_that_somebody_else_runs_is_found_when_its_task_comes_later(tmp_path: Path, ready: str) -> None:
    """It is there before the task is, and runs on while the task is away."""
    worker: Tree = {"ready": "matching"} if ready == "matching" else {}
    tree = echo_fleet(robots=1, edges=1, task={"worker": worker})
    tree["tasks"][TASK]["outputs"][0]["from"] = "{target}/echo/{robot}/out"  # it knows no epoch
    more = deepcopy(tree)
    more["tasks"]["second"] = deepcopy(tree["tasks"][TASK])
    more["tasks"]["second"]["inputs"][0] |= {"from": "{robot}/in2", "to": "{target}/second/{robot}/in"}
    more["tasks"]["second"]["outputs"][0] |= {"from": "{target}/second/{robot}/out", "to": "{robot}/out2"}
    with Testbed(tmp_path, tree) as bed:

        def states() -> Tree:
            (edge,) = (one for one in bed.status("edge1")["nodes"] if one["name"] == "edge1")
            return {one["task"]: one["state"] for one in edge["workers"]}

        bed.init()
        bed.start()
        bed.wait(lambda: bed.status("edge1"), 60, "edge1's daemon")
        config = zenoh.Config.from_file(str(bed.folder / f"edge1-{TASK}.zenoh.json5"))
        with zenoh.open(config) as session:
            kept: list[Any]
            if ready == "matching":
                kept = [session.declare_subscriber(f"edge1/{at}/*/in", lambda _: None) for at in (TASK, "second")]
            else:
                keys = [Keyspace("testbed").worker("edge1", task, "7") for task in (TASK, "second")]
                kept = [session.liveliness().declare_token(key) for key in keys]
            bed.wait(lambda: states() == {TASK: "ready"}, 60, "the worker of the first task")
            for _ in range(2):
                reload(bed, more)
                bed.wait(lambda: states() == {TASK: "ready", "second": "ready"}, 60, "the worker of the task that came")
                reload(bed, tree)
                bed.wait(lambda: states() == {TASK: "ready"}, 60, "the task is away")
            assert len(kept) == 2
