"""A worker that somebody else starts reads its session once: when a robot is added behind it, every status says so."""

from __future__ import annotations

import copy
import json
import time
from pathlib import Path

import pytest
import zenoh

from zsched.runtime.crew import REJOIN_S
from zsched_lab.fleet.testbed import TASK, Json, Testbed, echo_fleet

pytestmark = pytest.mark.long

WAIT_S = 60.0
SAID = "the worker on edge1: seems to run since before its session changed: start it again on edge1"


def trees() -> tuple[Json, Json]:
    """A fleet with one robot, and the same one with another robot, whose electors stay."""
    outputs = [{"from": "{target}/echo/{robot}/out", "to": "{robot}/out", "class": "latest"}]
    after = echo_fleet(robots=2, edges=1, task={"worker": {"ready": "matching"}, "outputs": outputs})
    after["electorate"] = ["robot1"]
    before = copy.deepcopy(after)
    del before["nodes"]["robot2"]
    return before, after


class Stranger:
    """A program that knows the session's file and the keys, and nothing of zsched."""

    def __init__(self, bed: Testbed) -> None:
        self.session = zenoh.open(zenoh.Config.from_file(str(bed.folder / f"edge1-{TASK}.zenoh.json5")))
        self._inputs = self.session.declare_subscriber(f"edge1/{TASK}/*/in", lambda _sample: None)


def told(bed: Testbed, node: str) -> list[str]:
    return [one for one in bed.task(node)["problems"] if one.startswith(SAID)]


def is_ready(bed: Testbed) -> bool:
    (edge,) = (one for one in bed.status("edge1")["nodes"] if one["name"] == "edge1")
    return [one["state"] for one in edge["workers"]] == ["ready"]


def test_a_stranger_that_runs_since_before_a_robot_was_added_is_told_of_until_it_is_started_again(
    tmp_path: Path,
) -> None:
    before, after = trees()
    with Testbed(tmp_path, before) as bed:

        def restart() -> None:
            bed.stop("edge1")
            bed.start("edge1")
            bed.wait(lambda: is_ready(bed), WAIT_S, "the worker, which has gone on")

        bed.init()
        bed.start()
        bed.wait(lambda: bed.status("edge1"), WAIT_S, "edge1's daemon")
        worker = Stranger(bed)
        bed.wait(lambda: is_ready(bed), WAIT_S, "the worker")
        restart()
        time.sleep(REJOIN_S)
        assert not told(bed, "edge1"), "the file is the same"

        bed.file.write_text(json.dumps(after))
        for _ in range(2):  # the second start finds no change, and a worker that has read none of it
            restart()
            bed.wait(lambda: told(bed, "edge1") and told(bed, "robot1"), WAIT_S, "the problem, everywhere")
        (problem,) = told(bed, "edge1")
        assert f"with the session {bed.folder / f'edge1-{TASK}.zenoh.json5'}"[:60] in problem
        assert bed.log("edge1").count(f"it lacks {after['nodes']['robot2']['listen']['data']}") == 2

        worker.session.close()
        bed.wait(lambda: not is_ready(bed), WAIT_S, "its end")
        time.sleep(REJOIN_S)
        worker = Stranger(bed)
        bed.wait(lambda: is_ready(bed) and not told(bed, "robot1"), WAIT_S, "nothing to tell any more")
        restart()
        time.sleep(REJOIN_S)
        assert not told(bed, "edge1"), "it has read what is written now"
        worker.session.close()
