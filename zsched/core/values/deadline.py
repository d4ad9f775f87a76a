"""Whether a task's deadline can count: one rule for the fleet file and for what operators tune.

Knows: scores, the CPU's weight, which workers tell of their jobs. Does not know: who asks, or how it is told.
"""

from __future__ import annotations

from enum import StrEnum

from zsched.core.values.fleet import WorkerSpec
from zsched.core.values.model import ScoreForm
from zsched.core.values.plan import ReadyWhen

TELLS_NOTHING = (
    "this worker (ready: matching) does not tell how long its jobs take: its machines are judged by service, "
    "whatever the deadline"
)


class DeadlineFault(StrEnum):
    """Why a deadline would count nothing, in words."""

    PAPER = "the paper's score knows no deadlines"
    NO_CPU = "jobs are in time or late by the CPU of a machine, and this task gives the CPU no weight"


def deadline_fault(score: ScoreForm, cpu_weight: float) -> DeadlineFault | None:
    """Why a deadline would count nothing under this score and weight; ``None``: it counts.

    >>> deadline_fault(ScoreForm.SERVICE, 0.5) is None, deadline_fault(ScoreForm.SERVICE, 0.0).name
    (True, 'NO_CPU')
    """
    if score is ScoreForm.PAPER:
        return DeadlineFault.PAPER
    return None if cpu_weight > 0.0 else DeadlineFault.NO_CPU


def tells_jobs(worker: WorkerSpec) -> bool:
    """Whether a worker can tell of its jobs, by which a deadline counts."""
    return worker.ready_when is ReadyWhen.TOKEN
