"""GATEWAY: what a task would get on a full machine: the fair share of its threads, corrected by experience.

Knows: run queues, what a task got beside how many others. Does not know: the task's need, which node is better.

A fair scheduler (CFS, EEVDF) gives the same to every thread that wants to run. Groups with weights of their own
(services, sessions) share differently, and nobody can see that from outside. So a share is believed until the task has
been there. From then on the ratio of what it got to its fair share counts for that machine. Otherwise two machines that
both promise more than they give would pass the task back and forth for ever.

Others' threads that rest now and then wait longer beside the task. Without it a machine shows fewer that want to run
than the task would find there, so how many more they were is remembered, too.
"""

from __future__ import annotations

from typing import Final

from zsched.core.gateway.company import is_full
from zsched.core.gateway.job_need import CALM_WAIT_RATIO
from zsched.core.gateway.shortfall import is_short
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct, replace

LEFT_S: Final = 4.0
"""So long after the task has left, what others do without it shows: their means have settled, its worker has ended."""


def fair_share(capacity: float, threads: float, others: float) -> float:
    """Cores that a fair scheduler gives ``threads`` beside ``others`` that all want to run; never more than there are.

    Args:
        capacity: cores of the machine, > 0.
        threads: of the task, >= 1.
        others: that run or wait to run there without it, >= 0, on the mean.

    >>> fair_share(capacity=4.0, threads=3.0, others=5.0)
    1.5
    """
    return min(capacity * threads / max(threads + others, capacity), capacity)


class _Others(Struct, frozen=True):
    """Others' threads on a machine that wanted to run beside a task that lacked CPU there."""

    beside: float
    left_at: float | None = None
    """When the task was first seen to be elsewhere; ``None``: it is there."""
    more: float = 0.0
    """So many more they were than without it."""


class Shares:
    """One node's experience of what tasks get of full machines."""

    def __init__(self) -> None:
        self._others: dict[tuple[TaskId, NodeId], _Others] = {}
        self._threads: dict[TaskId, float] = {}
        self._kept: dict[tuple[TaskId, NodeId], float] = {}
        """What a task got on a machine as a part of its fair share there, at most 1; the newest figure."""

    def learn(self, task: TaskId, profile: Profile) -> bool:
        """Note how many threads of the task want to run on its owner, and what they get; whether that has changed.

        A worker that starts does other work, by other threads: that tells nothing of the task.
        """
        load, key = profile.worker(task), (task, profile.node)
        if key in self._others:
            self._others[key] = replace(self._others[key], left_at=None)
        if load is None or load.state is not WorkerState.READY:
            return False
        if load.cpu_cores is None or profile.runnable is None or not (_is_hungry(load) or _is_held_up(profile, load)):
            return False
        threads = max(threads_of(load) if load.wanted_cores is None else load.wanted_cores, 1.0)
        own = threads if load.runnable is None else threads_of(load)
        others = max(profile.runnable - own, 0.0)
        kept = min(load.cpu_cores / fair_share(profile.cpu_cores, threads, others), 1.0)
        before = self._threads.get(task), self._kept.get(key)
        self._threads[task], self._kept[key], self._others[key] = threads, kept, _Others(others)
        return before != (threads, kept)

    def left_by(self, task: TaskId, owner: NodeId) -> tuple[NodeId, ...]:
        """The nodes on which the task lacked CPU, but for its ``owner``."""
        return tuple(node for name, node in self._others if name == task and node != owner)

    def look_back(self, task: TaskId, profile: Profile, now: float) -> bool:
        """Note how many others want to run where the task was and is no more; whether that has changed anything."""
        known = self._others.get((task, profile.node))
        if known is None or profile.runnable is None:
            return False
        left_at = now if known.left_at is None else known.left_at
        if now - left_at > LEFT_S:
            return False
        load = profile.worker(task)
        more = max(known.beside - profile.runnable + (0.0 if load is None else threads_of(load)), 0.0)
        self._others[task, profile.node] = replace(known, left_at=left_at, more=more)
        return (left_at, more) != (known.left_at, known.more)

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more."""
        self._threads.pop(task, None)
        self._kept = {key: kept for key, kept in self._kept.items() if key[0] != task}
        self._others = {key: others for key, others in self._others.items() if key[0] != task}

    def at(self, task: TaskId, profile: Profile, need_cores: float, coming_cores: float = 0.0) -> float:
        """Cores that the task would get on the node of ``profile`` if it were full; 0 where threads are not counted.

        Args:
            task: which one.
            profile: of the node. Where the task runs its own threads are among the runnable ones, and no others.
            need_cores: of the task there. A task without a known lack of CPU runs this many threads, at least one.
            coming_cores: of other tasks that have just moved there and do not show yet.
        """
        if profile.runnable is None:
            return 0.0
        threads = self._threads.get(task, max(need_cores, 1.0))
        load = profile.worker(task)
        own = 0.0 if load is None else threads_of(load)
        seen = self._others.get((task, profile.node))
        more = 0.0 if seen is None or seen.left_at is None else seen.more
        fair = fair_share(profile.cpu_cores, threads, max(profile.runnable - own, 0.0) + more + coming_cores)
        return self._kept.get((task, profile.node), 1.0) * fair


def _is_hungry(load: WorkerLoad) -> bool:
    """Whether some of its threads always want to run."""
    return load.wanted_cores is not None


def _is_held_up(profile: Profile, load: WorkerLoad) -> bool:
    """Whether it leaves jobs undone for waits for a CPU, though none of its threads always wants to run."""
    jobs = load.jobs
    if jobs is None or jobs.wait_s is None or not is_full(profile):
        return False
    return is_short(load) and jobs.wait_s > CALM_WAIT_RATIO * jobs.time_s


def threads_of(load: WorkerLoad) -> float:
    """A worker's threads that run or wait, on the mean, >= 0.

    Of one that somebody else started only its jobs tell (Little's law: how many come, times how long each stays).
    """
    if load.runnable is not None:
        return max(load.runnable, load.cpu_cores or 0.0)  # threads that live for a moment are missed
    if load.cpu_cores is not None:
        return load.cpu_cores if load.wanted_cores is None else load.wanted_cores
    jobs = load.jobs
    return 0.0 if jobs is None else jobs.done_hz * (jobs.cpu_s + (jobs.wait_s or 0.0))
