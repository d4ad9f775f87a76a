"""Where a task's deadline counts: one rule for the fleet file and `tune`."""

from __future__ import annotations

import pytest

from zsched.core.values.deadline import DeadlineFault, deadline_fault, tells_jobs
from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import ScoreForm
from zsched.core.values.plan import ReadyWhen


@pytest.mark.parametrize(
    ("score", "cpu_weight", "fault"),
    [
        (ScoreForm.SERVICE, 0.5, None),
        (ScoreForm.SERVICE, 0.0, DeadlineFault.NO_CPU),
        (ScoreForm.PAPER, 0.5, DeadlineFault.PAPER),
        (ScoreForm.PAPER, 0.0, DeadlineFault.PAPER),
    ],
)
def test_a_deadline_counts_by_service_where_the_cpu_has_a_weight(
    score: ScoreForm, cpu_weight: float, fault: DeadlineFault | None
) -> None:
    assert deadline_fault(score, cpu_weight) is fault


def test_a_worker_that_is_ready_by_its_token_tells_of_its_jobs() -> None:
    told = {when: tells_jobs(WorkerSpec(command=("worker",), ready_when=when)) for when in ReadyWhen}
    assert told == {ReadyWhen.TOKEN: True, ReadyWhen.MATCHING: False}
