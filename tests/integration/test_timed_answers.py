"""A real foreign worker: robots time its answers, and leave one whose answers have ended."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from support.feeding import fed
from zsched_lab.fleet.netbed import descendants_running
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WORKER = Path(__file__).with_name("timed_echo.py")
WAIT_S, RATE_HZ = 0.06, 5.0


@contextmanager
def fleet_of(folder: Path, *, keeps_stamp: bool) -> Iterator[Testbed]:
    tree = echo_fleet(robots=1, edges=2, timing="wired", worker=("python", str(WORKER)))
    task = tree["tasks"][TASK]
    task["worker"] |= {"ready": "matching", "env": {"KEEPS_STAMP": f"{keeps_stamp:d}"}}
    task["inputs"] = [{"from": "{robot}/in", "to": f"{{target}}/{TASK}/{{robot}}/in", "class": "latest"}]
    task["outputs"] = [{"from": f"{{target}}/{TASK}/{{robot}}/out", "to": "{robot}/out", "class": "latest"}]
    with Testbed(folder, tree) as bed:
        bed.init()
        bed.start()
        bed.wait_settled()
        with fed(bed, RATE_HZ):
            yield bed


def shown(bed: Testbed) -> dict[str, Any] | None:
    """What robot1 counts of the task's output, once some answers were timed."""
    streams = [one for one in bed.task("robot1")["streams"] if one["stream"] == f"{TASK}/out/0"]
    return next((one for one in streams if one["messages"] > 6 * RATE_HZ and one["answer_s"] is not None), None)


@pytest.mark.parametrize("keeps_stamp", [True, False])
def test_answers_are_timed_and_exactly_so_by_their_input_s_timestamp(tmp_path: Path, *, keeps_stamp: bool) -> None:
    with fleet_of(tmp_path, keeps_stamp=keeps_stamp) as bed:
        told = bed.wait(lambda: shown(bed), 60, "an answer is timed")
        assert told is not None
        assert (told["paired_hz"] is not None) is keeps_stamp
        assert told["answer_s"] >= WAIT_S or not keeps_stamp


def test_a_worker_that_takes_inputs_and_answers_no_more_is_a_problem_and_is_left(tmp_path: Path) -> None:
    with fleet_of(tmp_path, keeps_stamp=True) as bed:
        owner = bed.wait_settled()
        bed.wait(lambda: shown(bed), 60, "answers flow")
        (pid,) = descendants_running(bed.pid(owner), str(WORKER))
        os.kill(pid, signal.SIGUSR1)
        told = f"{owner} has had inputs of this robot and answered none of them"
        bed.wait(lambda: any(told in one for one in bed.task("robot1")["problems"]), 30, "status says so")
        bed.wait(lambda: bed.wait_settled() not in (None, owner), 60, "another owner")
        bed.wait(lambda: not bed.task("robot1")["problems"], 60, "answers of the next owner")
