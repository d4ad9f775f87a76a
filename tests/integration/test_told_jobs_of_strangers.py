"""A worker that somebody else starts, with the library: what it tells of its jobs is all that is known of it."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.sessions import matches
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WORKER = Path(__file__).with_name("slow_echo.py")
WAIT_S = 60.0


def test_what_a_stranger_tells_of_its_jobs_stands_in_the_robot_s_status_and_counts_as_its_use(tmp_path: Path) -> None:
    tree = echo_fleet(robots=1, edges=1, timing="wired")
    tree["tasks"][TASK]["worker"] = {}
    with Testbed(tmp_path, tree) as bed:
        bed.init()
        bed.start()
        config = tmp_path / f"edge1-{TASK}.zenoh.json5"
        bed.wait(config.exists, WAIT_S, "the daemon has said how a worker joins")
        env = {**os.environ, "ZSCHED_FLEET": "testbed", "ZSCHED_NODE": "edge1", "ZSCHED_TASK": TASK}
        env |= {"ZSCHED_INCARNATION": "1", "ZSCHED_ZENOH_CONFIG": str(config)}
        with subprocess.Popen([sys.executable, WORKER], stdin=subprocess.DEVNULL, env=env) as stranger:
            try:
                assert bed.wait_settled() == "edge1"
                publisher = bed.app("robot1").declare_publisher("robot1/in")
                bed.wait(lambda: matches(publisher), WAIT_S, "the relay subscribes")

                def told() -> dict[str, Any] | None:
                    """The load of the worker as robot1 sees it, once that tells of jobs."""
                    publisher.put(b"1")
                    (edge,) = (one for one in bed.status("robot1")["nodes"] if one["name"] == "edge1")
                    (load,) = edge["workers"]
                    return load if load["jobs"] is not None and load["jobs"]["done_hz"] > 0.0 else None

                load = bed.wait(told, WAIT_S, "the jobs of somebody else's worker") or {}
            finally:
                stranger.kill()

    jobs = load["jobs"]
    assert jobs["time_s"] >= 0.01
    assert load["cpu_cores"] == pytest.approx(jobs["done_hz"] * jobs["cpu_s"])
    assert load["memory_mb"] is None, "nobody measures it"
