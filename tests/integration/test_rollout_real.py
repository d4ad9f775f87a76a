"""A changed worker waits for a look on real daemons: over restarts, and a reliable stream loses and doubles nothing."""

from __future__ import annotations

import json
import time
from copy import deepcopy
from functools import partial
from pathlib import Path

import pytest

from support.operators import Operator, Stream
from support.sessions import matches
from zsched.core.executor.renewing import SAME_FILE_S
from zsched.core.hop.books import unaccounted
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

EDGES = ("edge1", "edge2", "edge3")
MARK = "CHANGED"


def worker_lives(bed: Testbed, node: str) -> list[str]:
    """The pids of the workers that were started on a node, in their order, over the lives of its daemon."""
    lines = [line for line in bed.log(node).splitlines() if f"worker_started task={TASK} " in line]
    return [line.rpartition("pid=")[2].split()[0] for line in lines]


def runs_changed(bed: Testbed, node: str) -> bool | None:
    """Whether a node's worker has the changed environment; ``None``: none runs."""
    lives = worker_lives(bed, node)
    try:
        environment = Path(f"/proc/{lives[-1]}/environ").read_bytes() if lives else b""
    except OSError:
        return None
    return f"{MARK}=1".encode() in environment.split(b"\0") if environment else None


def are_ready(bed: Testbed) -> bool:
    """Whether robot1 hears every edge with a ready worker, and its streams are settled."""
    status = bed.status("robot1")
    workers = {node["name"]: [one["state"] for one in node["workers"]] for node in status["nodes"]}
    return all(workers[name] == ["ready"] for name in EDGES) and status["tasks"][0]["phase"] == "settled"


def waits(bed: Testbed, node: str) -> tuple[list[str], list[str]] | None:
    """(who runs the changed worker, who waits), as a node tells."""
    told = bed.status(node)["tasks"][0]["rollout"]
    return None if told is None else (told["first"], told["waiting"])


def knows(bed: Testbed, node: str, wanted: tuple[str, list[str]]) -> bool:
    """Whether a node tells that one runs the changed worker and these others wait."""
    first, others = wanted
    return waits(bed, node) == ([first], others)


def test_a_changed_worker_waits_for_a_look_over_restarts_while_a_reliable_stream_runs(tmp_path: Path) -> None:
    tree = echo_fleet(robots=2, edges=3, timing="wired", stream_class="reliable")
    tree["tasks"][TASK]["outputs"][0]["handover"] = "all"  # by `latest` a move cuts the old owner's late answers off
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        owner = bed.wait_settled()
        bed.wait(lambda: are_ready(bed), 60, "every edge has its worker")
        operator, stream = Operator(bed), Stream(bed.app("robot1"))
        bed.wait(lambda: matches(stream.publisher), 60, "the relay subscribes")
        stream.start()
        bed.wait(lambda: len(stream.back) > 20, 60, "the stream flows")
        file = tmp_path / "agreed.yaml"
        file.write_text(json.dumps(tree, indent=1))
        operator.done("apply", file, "--yes")

        # one candidate that is not the owner gets the changed worker
        first = min(name for name in EDGES if name != owner)
        others = sorted(name for name in EDGES if name != first)
        changed = deepcopy(tree)
        changed["tasks"][TASK]["worker"]["env"] = {MARK: "1"}
        file.write_text(json.dumps(changed, indent=1))
        told = operator.done("apply", file, "--pause-after", 1, "--yes", "-m", "a new model")
        assert f"{first} first; the others wait for `zsched task promote {TASK}`" in told
        bed.wait(lambda: runs_changed(bed, first), 60, f"{first} runs the changed worker")
        bed.wait(lambda: are_ready(bed), 60, "its worker is ready")

        # every kind of node restarts: who runs it, who waits, who votes; all go on by what is agreed
        standby = next(name for name in others if name != owner)
        for name in (first, standby, "robot2"):
            bed.kill(name)
            bed.start(name)
            bed.wait(partial(knows, bed, name, (first, others)), 60, f"{name} knows what waits")
            bed.wait(lambda: are_ready(bed), 60, f"the workers after {name} has restarted")
        since = time.monotonic()
        bed.wait(lambda: time.monotonic() > since + 2.0 * SAME_FILE_S, 60, "the time after which an old worker ends")
        assert {name: runs_changed(bed, name) for name in EDGES} == {name: name == first for name in EDGES}
        assert [len(worker_lives(bed, name)) for name in (owner, standby, first)] == [1, 2, 3]
        assert bed.owner("robot1") == owner, "nothing has moved"

        # it is seen
        assert f"{first} first, {', '.join(others)} wait, " in operator.done("status", "-v")
        assert f"changed worker: {first} first, the others wait" in operator.done("history")

        # it goes on: those that waited one after another, the owner last, after a move
        operator.done("task", "promote", TASK, "--yes")
        bed.wait(lambda: all(runs_changed(bed, name) for name in EDGES), 90, "all run the changed worker")
        assert [waits(bed, name) for name in bed.names] == [None] * len(bed.names)
        assert bed.owner("robot1") != owner, "the owner has given the task away before its worker ended"
        bed.wait(lambda: are_ready(bed), 60, "every worker is ready")
        assert "all run the changed worker now" in operator.done("history")

        reached = len(stream.back)
        bed.wait(lambda: len(stream.back) > reached + 20, 60, "the stream flows on")
        stream.end()
        bed.wait(lambda: len(stream.back) >= stream.sent, 60, "every sample is answered")
        assert stream.back == list(range(stream.sent)), "lost 0, doubled 0, in order"
        count = next(count for count in bed.counts("robot1") if count.stream == f"{TASK}/in/0")
        assert (count.lost, count.at_most_lost, unaccounted(count)) == (0, 0, 0)
