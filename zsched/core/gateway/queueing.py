"""GATEWAY: how long a task's jobs wait for each other on each machine, as it was seen there with CPU to spare.

Knows: means of waits, how often jobs come. Does not know: needs, speeds, which node is better.

Jobs that come irregularly wait for each other, and the more of its time a machine works the longer: their wait grows
faster than the time of a job (Kingman 1961, "The single server queue in heavy traffic"). So a quick machine's queue
tells little of a slow one's. As long as only the owner's counts, a slow machine nearby keeps a deadline by the quick
one's figures and misses it by its own, and the two may hand the task to each other for ever (docs/decisions/0123).
"""

from __future__ import annotations

from typing import Final, Self

from zsched.core.gateway.job_need import JobNeed
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.struct import Struct, replace

MEAN_S: Final = 60.0
"""Means are of at most so long."""
SAME_RATE_RATIO: Final = 1.5
"""Jobs that come so many times as often, or as rarely, wait otherwise."""


class _Mean(Struct, frozen=True):
    """A mean over time: of all that was seen at first, later of the last minute or so."""

    value: float
    for_s: float = 0.0

    def and_(self, value: float, elapsed_s: float) -> Self:
        """With a value that held for the last ``elapsed_s``."""
        for_s = self.for_s + elapsed_s
        part = elapsed_s / for_s if for_s > 0.0 else 0.0
        return type(self)(self.value + part * (value - self.value), min(for_s, MEAN_S))


class _Waits(Struct, frozen=True):
    """A task's waits on one machine."""

    other_s: _Mean
    queue_ratio: _Mean
    hz: float
    """How often jobs came then."""


class Queues:
    """How long jobs wait on machines, as one node has seen it."""

    def __init__(self) -> None:
        self._hz: dict[TaskId, _Mean] = {}
        self._waits: dict[tuple[TaskId, NodeId], _Waits] = {}

    def count(self, task: TaskId, hz: float, elapsed_s: float) -> None:
        """The task's jobs came so often in the last ``elapsed_s``."""
        self._hz[task] = self._hz.get(task, _Mean(hz)).and_(hz, elapsed_s)

    def note(self, task: TaskId, node: NodeId, job: JobNeed, elapsed_s: float) -> None:
        """The task's jobs waited like this in the last ``elapsed_s`` on its owner, which has CPU to spare."""
        hz, waits = self._hz.get(task), self._waits.get((task, node))
        if hz is None:
            return
        if waits is None or not _is_same(waits.hz, hz.value):
            waits = _Waits(_Mean(job.other_s), _Mean(job.queue_ratio), hz.value)
        self._waits[task, node] = _Waits(
            other_s=waits.other_s.and_(job.other_s, elapsed_s),
            queue_ratio=waits.queue_ratio.and_(job.queue_ratio, elapsed_s),
            hz=hz.value,
        )

    def on(self, task: TaskId, node: NodeId, job: JobNeed) -> JobNeed:
        """``job`` with its waits on the node, if they were seen there while jobs came about as often as now.

        A worker that tells what its job waits for tells that for every machine; only the queue is the machine's.
        """
        hz, waits = self._hz.get(task), self._waits.get((task, node))
        if hz is None or waits is None or not _is_same(waits.hz, hz.value):
            return job
        other_s = job.other_s if job.is_serial else waits.other_s.value
        return replace(job, queue_ratio=waits.queue_ratio.value, other_s=other_s)

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more."""
        self._hz.pop(task, None)
        self._waits = {key: waits for key, waits in self._waits.items() if key[0] != task}


def _is_same(one_hz: float, other_hz: float) -> bool:
    return max(one_hz, other_hz) <= SAME_RATE_RATIO * min(one_hz, other_hz)
