"""GATEWAY: what a task would get on a full machine: the fair share of its threads, corrected by experience.

Knows: run queues, what a task got beside how many others. Does not know: how a need is learnt, which node is better.

A fair scheduler (CFS, EEVDF) gives the same to every thread that wants to run. Groups with weights of their own
(services, sessions) share differently, and nobody can see that from outside: so a share is believed until the task has
been there and lacked CPU. From then on the part of it that it got counts on that machine.
"""

from __future__ import annotations

from collections.abc import Container
from typing import Final, Self

from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerLoad, WorkerState
from zsched.core.values.struct import Struct, replace

COUNTED_S: Final = 8.0
"""The threads that came with a task are counted for so long; later ones are others'."""
LEFT_S: Final = 4.0
"""Others show what they do without the task for this time after its worker has stopped working there."""


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


class _Unmeasured(Struct, frozen=True):
    """A worker of which nobody measures anything, on its owner."""

    others: float | None
    """Threads that ran or waited there before it came; ``None``: nobody has seen that."""
    since: float
    own: float | None = None
    """How many more there are since, on the mean of the first seconds in which they show; ``None``: not known."""
    looks: int = 0
    left_at: float | None = None
    """When the task was first seen to have another owner; ``None``: it has this one."""

    def look(self, runnable: float, now: float) -> Self:
        """With one more figure of the machine."""
        found = self if self.left_at is None else replace(self, left_at=None)
        if self.others is None or now - self.since >= COUNTED_S:
            return found
        more, looks = max(runnable - self.others, 0.0), self.looks + 1
        return replace(found, own=((self.own or 0.0) * self.looks + more) / looks, looks=looks)


class Shares:
    """One node's experience of what tasks get of full machines."""

    def __init__(self) -> None:
        self._threads: dict[TaskId, float] = {}
        """How many of a task's threads wanted to run where it lacked CPU last."""
        self._kept: dict[tuple[TaskId, NodeId], float] = {}
        """The part of their fair share that they got last on a machine where a task lacked CPU, at most 1."""
        self._without: dict[tuple[TaskId, NodeId], float] = {}
        """Threads that run or wait on machines where a task is not that nobody measures."""
        self._unmeasured: dict[tuple[TaskId, NodeId], _Unmeasured] = {}

    def learn(self, task: TaskId, profile: Profile, now: float) -> bool:
        """Note how many threads of the task want to run on its owner; whether that has changed.

        A worker that starts does other work, by other threads: that tells nothing of the task.
        """
        load, key = profile.worker(task), (task, profile.node)
        has_changed = self._look_unmeasured(key, profile, now)
        if load is None or load.state is not WorkerState.READY or profile.runnable is None:
            return has_changed
        if load.cpu_cores is None or load.wanted_cores is None:
            return has_changed
        threads = max(load.wanted_cores, 1.0)
        own = threads if load.runnable is None else threads_of(load)
        fair = fair_share(profile.cpu_cores, threads, max(profile.runnable - own, 0.0))
        before, found = (self._threads.get(task), self._kept.get(key)), (threads, min(load.cpu_cores / fair, 1.0))
        self._threads[task], self._kept[key] = found
        return has_changed or before != found

    def _look_unmeasured(self, key: tuple[TaskId, NodeId], profile: Profile, now: float) -> bool:
        """Note how many threads came with a worker that nobody measures; whether that has changed."""
        load = profile.worker(key[0])
        is_at_work = load is None or (load.state is WorkerState.READY and load.cpu_cores is None)
        if profile.runnable is None or not is_at_work:
            return False
        before = self._unmeasured.get(key)
        if before is None:
            before = _Unmeasured(self._without.get(key), now)
        self._unmeasured[key] = found = before.look(profile.runnable, now)
        return found.own != before.own

    def look_elsewhere(self, task: TaskId, profile: Profile, now: float) -> None:
        """Note how many threads want to run where the task is not; for some seconds it may still be there, unseen."""
        key = (task, profile.node)
        known = self._unmeasured.get(key)
        if known is not None and (known.left_at is None or now - known.left_at <= LEFT_S):
            self._unmeasured[key] = replace(known, left_at=now) if known.left_at is None else known
            return
        self._unmeasured.pop(key, None)
        if profile.runnable is not None:
            self._without[key] = profile.runnable

    def beside_unmeasured(self, task: TaskId, profile: Profile, need_cores: float) -> tuple[float, float] | None:
        """(the task's threads, others') on its owner, of a worker that nobody measures; ``None``: nobody counts them.

        ``need_cores``: so many threads it has at least, for all that is known.
        """
        if profile.runnable is None:
            return None
        known = self._unmeasured.get((task, profile.node))
        own = max(need_cores, 0.0 if known is None or known.own is None else known.own)
        others = max(profile.runnable - own, 0.0)
        if known is not None and known.own is None and known.others is not None:
            others = min(others, known.others)  # it has just come: who else wants to run is not seen yet
        return own, others

    def keep(self, nodes: Container[NodeId]) -> None:
        """Know nothing of other nodes: one of the same name that comes later is another one."""
        self._without = {key: seen for key, seen in self._without.items() if key[1] in nodes}
        self._unmeasured = {key: seen for key, seen in self._unmeasured.items() if key[1] in nodes}
        self._kept = {key: one for key, one in self._kept.items() if key[1] in nodes}

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more."""
        self._threads.pop(task, None)
        self._without = {key: seen for key, seen in self._without.items() if key[0] != task}
        self._unmeasured = {key: seen for key, seen in self._unmeasured.items() if key[0] != task}
        self._kept = {key: one for key, one in self._kept.items() if key[0] != task}

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
        cores = profile.cpu_cores
        load = profile.worker(task)
        own = 0.0 if load is None else threads_of(load)
        others = max(profile.runnable - own + coming_cores, 0.0)
        fair = fair_share(cores, self._threads.get(task) or max(need_cores, 1.0), others)
        return fair * self._kept.get((task, profile.node), 1.0)


def threads_of(load: WorkerLoad) -> float:
    """A worker's threads that run or wait, on the mean, >= 0.

    Of one that somebody else started only its jobs tell (Little's law: how many come, times how long each stays).
    """
    if load.runnable is not None:
        return max(load.runnable, load.cpu_cores or 0.0)  # threads that live for a moment are missed
    jobs = load.jobs
    told = 0.0 if jobs is None else jobs.done_hz * (jobs.cpu_s + (jobs.wait_s or 0.0))
    return max(told, (load.cpu_cores or 0.0) if load.wanted_cores is None else load.wanted_cores)
