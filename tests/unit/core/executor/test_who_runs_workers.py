"""Which nodes keep a worker of a task: its candidates, and robots that may have to work alone; no other edge."""

from __future__ import annotations

import pytest

from support.fleets import task_of, tuning_of
from support.todos import done
from zsched.core.executor.handover import Executor
from zsched.core.values.fleet import OnIsolation, WorkerSpec
from zsched.core.values.instructions import StartWorker


@pytest.mark.parametrize(
    ("me", "is_robot", "isolation", "runs"),
    [
        ("edge1", False, OnIsolation.HOLD, True),
        ("edge2", False, OnIsolation.HOLD, False),
        ("edge2", False, OnIsolation.LOCAL, False),
        ("robot1", True, OnIsolation.HOLD, False),
        ("robot1", True, OnIsolation.LOCAL, True),
    ],
)
def test_candidates_and_robots_that_work_alone_start_a_warm_worker(
    me: str, is_robot: bool, isolation: OnIsolation, runs: bool
) -> None:
    spec = task_of(
        candidates=("edge1",),
        tuning=tuning_of(cpu=1.0, memory=0.0),
        worker=WorkerSpec(command=("work",)),
        on_isolation=isolation,
    )
    executor = Executor(spec=spec, me=me, has_streams=is_robot)
    assert executor.runs_worker is runs
    assert done(executor.start) == ((StartWorker(task="merge"),) if runs else ())
