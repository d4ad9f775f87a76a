"""A real worker on a real node beside real busy loops: its jobs take longer, and what it needs stays what it was."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from support.feeding import fed
from support.fleets import task_of, tuning_of
from support.profiles import profile_of
from support.waiting import between
from zsched.core.gateway.demand import Demands
from zsched.core.values.fleet import Demand
from zsched.core.values.profile import Jobs, WorkerLoad, WorkerState
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WORKER = Path(__file__).with_name("busy_echo.py")
BUSY_MS, RATE_HZ = 40.0, 10.0
LOOPS = 4
"""On the worker's CPU; each in a session of its own, so that the kernel's autogroups do not make one of them."""
SPIN = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass"


@pytest.fixture
def bed(tmp_path: Path) -> Iterator[Testbed]:
    tree = echo_fleet(robots=1, edges=1, timing="wired", worker=("python", str(WORKER)))
    tree["tasks"][TASK]["worker"]["env"] = {"BUSY_MS": f"{BUSY_MS:g}"}
    tree["tasks"][TASK]["scheduling"] = {"objective": "latency", "deadline_ms": 1000}
    with Testbed(tmp_path, tree) as made:
        made.init()
        yield made


@contextlib.contextmanager
def busy_loops(count: int) -> Iterator[None]:
    """So many processes that compute for ever."""
    loops = [subprocess.Popen([sys.executable, "-c", SPIN], start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait()


def shown(bed: Testbed) -> dict[str, Any]:
    """The edge as the robot shows it."""
    found: dict[str, Any] = next(one for one in bed.status("robot1")["nodes"] if one["name"] == "edge1")
    return found


def needed(bed: Testbed, for_s: float) -> tuple[float, float, float]:
    """(cores that it needs by the core's rule, cores that it uses, seconds a job), means over a while."""
    spec = task_of(TASK, ("edge1",), tuning=tuning_of(cpu=1.0, memory=0.0), demand=Demand())
    found = []
    until = time.monotonic() + for_s
    while time.monotonic() < until:
        time.sleep(0.5)
        node = shown(bed)
        load = dict(node["workers"][0])
        jobs = None if load["jobs"] is None else Jobs(**load["jobs"])
        if jobs is None or load["cpu_cores"] is None:
            continue
        machine = {name: node[name] for name in ("cpu_cores", "cpu_used_cores", "memory_mb", "memory_used_mb")}
        profile = profile_of(
            **machine,
            workers=(WorkerLoad(**{**load, "state": WorkerState(load["state"]), "jobs": jobs}),),
        )
        demands = Demands()
        demands.learn(TASK, profile, 0.0)
        found.append((demands.at(spec, profile).cpu_cores, load["cpu_cores"], jobs.time_s))
    assert found, "the worker tells"
    need, use, time_s = (sum(column) / len(found) for column in zip(*found, strict=True))
    return need, use, time_s


def test_a_worker_s_jobs_take_longer_beside_a_load_and_its_need_stays(bed: Testbed) -> None:
    bed.start()
    assert bed.wait_settled() == "edge1"
    with fed(bed, RATE_HZ):
        bed.wait(lambda: shown(bed)["workers"][0]["jobs"] is not None, 60, "the worker's word reaches the robot")
        time.sleep(3.0)
        calm_need, _, calm_s = needed(bed, 5.0)
        with busy_loops(LOOPS):
            time.sleep(4.0)
            need, use, time_s = needed(bed, 6.0)
            counts = {one["stream"]: one["answer_s"] for one in bed.task("robot1")["streams"]}
    print(f"calm: {calm_need:.2f} cores, {calm_s:.3f} s a job; loaded: {need:.2f}, {time_s:.3f} s, uses {use:.2f}")
    alone = BUSY_MS / 1e3
    assert calm_s >= 0.9 * alone
    assert time_s > 1.5 * alone  # and no more than when calm, where others keep this machine as busy as our loops do
    assert use < 0.75 * RATE_HZ * alone, "what it uses is no measure of what it needs here"
    for one in (calm_need, need):
        between(0.8 * RATE_HZ * alone, one, 1.2 * RATE_HZ * alone)
    assert counts[f"{TASK}/in/0"] is None
    assert 0.0 < counts[f"{TASK}/out/0"] < 10.0, "the robot sees how far answers come behind their questions"
    task = bed.task("robot1")
    assert task["tuning"]["deadline_ms"] == 1000.0
    assert dict(task["round_trips"])["edge1"] >= 0.0, "the way is measured"
    bed.wait(lambda: dict(bed.task("robot1")["round_trips"])["edge1"] < 0.05, 30, "it is no longer than it is")
    bed.wait(lambda: shown(bed)["workers"][0]["jobs"] is None, 30, "who has nothing to do says nothing")
