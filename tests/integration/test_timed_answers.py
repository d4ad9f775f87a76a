"""A real foreign worker of a task with a deadline: robots time its answers, and the deadline counts by them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from support.feeding import fed
from support.verbs import command
from zsched_lab.fleet.testbed import TASK, Testbed, echo_fleet

pytestmark = pytest.mark.long

WORKER = Path(__file__).with_name("timed_echo.py")
WAIT_S, RATE_HZ = 0.06, 5.0


@contextmanager
def fleet_of(folder: Path, *, keeps_stamp: bool) -> Iterator[Testbed]:
    tree = echo_fleet(robots=1, edges=1, timing="wired", worker=("python", str(WORKER)))
    task = tree["tasks"][TASK]
    task["worker"] |= {"ready": "matching", "env": {"KEEPS_STAMP": f"{keeps_stamp:d}"}}
    task["inputs"] = [{"from": "{robot}/in", "to": f"{{target}}/{TASK}/{{robot}}/in", "class": "latest"}]
    task["outputs"] = [{"from": f"{{target}}/{TASK}/{{robot}}/out", "to": "{robot}/out", "class": "latest"}]
    task["scheduling"] = {"objective": "latency", "deadline_ms": 1000}
    with Testbed(folder, tree) as bed:
        bed.init()
        bed.start()
        assert bed.wait_settled() == "edge1"
        with fed(bed, RATE_HZ):
            yield bed


def out(bed: Testbed) -> dict[str, Any]:
    """What robot1 counts of the task's output, once its relay counts."""
    none_yet = {"messages": 0, "answer_s": None, "paired_hz": None}
    return next((one for one in bed.task("robot1")["streams"] if one["stream"] == f"{TASK}/out/0"), none_yet)


def knows_jobs(bed: Testbed) -> bool:
    """Whether robot1 judges machines by the deadline."""
    known: bool = json.loads(command(bed, "explain", TASK, "--json"))["knows_jobs"]
    return known


def test_answers_with_their_input_s_timestamp_tell_how_long_a_job_takes(tmp_path: Path) -> None:
    with fleet_of(tmp_path, keeps_stamp=True) as bed:
        bed.wait(lambda: knows_jobs(bed), 60, "the deadline counts")

        def shown() -> dict[str, Any] | None:
            count = out(bed)
            return None if count["paired_hz"] is None else count

        told = bed.wait(shown, 30, "it is shown")
        assert told is not None
        assert told["answer_s"] >= WAIT_S
        assert "which does not count yet" not in command(bed, "explain", TASK)


def test_without_it_answers_are_shown_and_no_deadline_counts(tmp_path: Path) -> None:
    with fleet_of(tmp_path, keeps_stamp=False) as bed:
        bed.wait(lambda: out(bed)["messages"] > 6 * RATE_HZ and out(bed)["answer_s"] is not None, 60, "answers come")
        assert out(bed)["paired_hz"] is None
        assert not knows_jobs(bed)
        assert "does not count yet: how long a job takes is not known" in command(bed, "explain", TASK)
