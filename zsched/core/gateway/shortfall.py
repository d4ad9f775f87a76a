"""GATEWAY: what a task got less of on a machine than was foretold, and whether its worker lacks anything.

Knows: forecasts of work and of jobs' ages, what came of them. Does not know: how needs, speeds and shares are learnt.

The owner's service is measured, the candidates' foretold. So what a machine did not keep is remembered of it for as
long as others use about as much there. Otherwise it would look better as soon as the task has left, and the task go
there and back for ever (docs/decisions/0032). Where no wait for CPU explains it (the worker was stuck once, a disk is
slow for good), it is remembered for a minute, and twice as long each time that it is seen again (0135). A wait beside
nobody (a quota, a clock that is held down against heat) is remembered for an hour: no end of anybody's use shows its.
"""

from __future__ import annotations

import math
from collections.abc import Container
from typing import Final

from zsched.core.doubt import LONGEST_DOUBT_S, Doubt
from zsched.core.gateway.company import Company, is_full
from zsched.core.gateway.job_need import JobNeed
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.profile import Profile, WorkerLoad
from zsched.core.values.struct import Struct

SHORT_RATIO: Final = 0.9
"""A task that gets a smaller part of its forecast has a shortfall on that machine."""
LAGS_S: Final = 4.0
"""Time constant of the age that is foretold: jobs' ages are means that follow later than the machine's figures."""
WAITING_RATIO: Final = 0.1
"""A job that waits for a CPU for this share of its time is held up by others."""


class _Foretold(Struct, frozen=True):
    """How long a task's jobs were to take on a machine, on the mean of the last seconds."""

    node: NodeId
    age_s: float
    at: float


class _Shortfall(Struct, frozen=True):
    """What a task got on a machine, compared with the forecast for that machine."""

    share: float
    """The part of the forecast work that it got, at most 1."""
    stretch: float
    """How many times as long its jobs took, at least 1."""
    company: Company
    is_explained: bool = True
    """By a wait for CPU: it ends with the others' use, and not by time."""


class Shortfalls:
    """One node's experience of what machines did not keep."""

    def __init__(self) -> None:
        self._seen: dict[tuple[TaskId, NodeId], _Shortfall] = {}
        self._foretold: dict[TaskId, _Foretold] = {}
        self._doubts: dict[tuple[TaskId, NodeId], Doubt] = {}
        self._alone_at: dict[tuple[TaskId, NodeId], float] = {}
        """When such a wait was seen last beside next to nobody."""

    def note(
        self,
        task: TaskId,
        profile: Profile,
        job: JobNeed,
        age_s: float,
        *,
        need_cores: float,
        speed: float,
        fair_cores: float,
        now: float,
    ) -> bool:
        """Remember that the task gets less on its owner than forecast, or no longer does; whether that has changed.

        Args:
            task: which one.
            profile: its owner's.
            job: one job's need.
            age_s: how long its jobs take, from arrival to end.
            need_cores: what it needs there, > 0.
            speed: of the task there.
            fair_cores: what a job gets there at least while it runs.
            now: monotonic seconds.
        """
        load, company = profile.worker(task), Company.of(task, profile)
        if load is None or load.cpu_cores is None or company is None:
            return False
        free, most = profile.cpu_cores - company.others_cores, job.most_cores(speed, need_cores)
        foreseen = min(free / need_cores, 1.0 if most is None else most / need_cores, 1.0)
        is_lacking = foreseen > 0.0 and shows_lack(load) and is_short(load)
        share = min(load.cpu_cores / need_cores / foreseen, 1.0) if is_lacking else 1.0
        foretold_s = self._foretell(task, profile.node, job.age_s(speed, max(free, fair_cores)), now)
        stretch = max(age_s / max(foretold_s, 1e-9), 1.0)
        before = self._seen.pop((task, profile.node), None)
        if share >= SHORT_RATIO and stretch <= 1.0 / SHORT_RATIO:
            if (doubt := self._doubts.get((task, profile.node))) is not None:
                doubt.keep(now)
            return before is not None
        is_explained = _waits(load, profile)
        if is_explained and company.is_next_to_nobody(profile):
            self._alone_at[task, profile.node] = now
        else:
            self._alone_at.pop((task, profile.node), None)
        if not is_explained:
            self._doubts.setdefault((task, profile.node), Doubt(seen_at=now)).see(now)
        self._seen[task, profile.node] = _Shortfall(share, stretch, company, is_explained)
        return before != self._seen[task, profile.node]

    def end_doubts(self, task: TaskId, now: float) -> None:
        """Forget what nothing explains, or nobody who is there, and was not seen for long enough."""
        for key in [key for key, at in self._alone_at.items() if key[0] == task and now - at >= LONGEST_DOUBT_S]:
            del self._alone_at[key]
            self._seen.pop(key, None)
        unexplained = [key for key, one in self._seen.items() if key[0] == task and not one.is_explained]
        for key in unexplained:
            if self._doubts[key].is_over(now):
                del self._seen[key]

    def _foretell(self, task: TaskId, node: NodeId, age_s: float, now: float) -> float:
        """The age that jobs' mean age is compared with: this one, or what was foretold of those that ended before.

        When a load ends the jobs that it held up count in their mean for some seconds.
        """
        known = self._foretold.get(task)
        if known is None or known.node != node:
            known = _Foretold(node, age_s, now)
        mean_s = age_s + (known.age_s - age_s) * math.exp(-max(now - known.at, 0.0) / LAGS_S)
        self._foretold[task] = _Foretold(node, mean_s, now)
        return max(age_s, mean_s)

    def of(self, task: TaskId, profile: Profile) -> tuple[float, float]:
        """(part of the forecast work that the task got there, at most 1; how many times as long its jobs took)."""
        seen = self._seen.get((task, profile.node))
        return (seen.share, seen.stretch) if seen and seen.company.is_still(task, profile) else (1.0, 1.0)

    def keep(self, nodes: Container[NodeId]) -> None:
        """Know nothing of other nodes."""
        self._seen = {key: seen for key, seen in self._seen.items() if key[1] in nodes}
        self._doubts = {key: doubt for key, doubt in self._doubts.items() if key[1] in nodes}
        self._alone_at = {key: at for key, at in self._alone_at.items() if key[1] in nodes}

    def forget(self, task: TaskId) -> None:
        """Know nothing of a task that is no more."""
        self._foretold.pop(task, None)
        self._seen = {key: seen for key, seen in self._seen.items() if key[0] != task}
        self._doubts = {key: doubt for key, doubt in self._doubts.items() if key[0] != task}
        self._alone_at = {key: at for key, at in self._alone_at.items() if key[0] != task}


def _waits(load: WorkerLoad, profile: Profile) -> bool:
    """Whether a worker waits for CPU; where nobody tells, whether its machine is full."""
    jobs = load.jobs
    told_s = None if jobs is None else jobs.wait_s
    if load.wanted_cores is None and told_s is None:
        return is_full(profile)
    return _is_hungry(load) or (jobs is not None and told_s is not None and told_s > WAITING_RATIO * jobs.time_s)


def _is_hungry(load: WorkerLoad) -> bool:
    """Whether threads that always want to run use less than they would alone."""
    return load.wanted_cores is not None and (load.cpu_cores or 0.0) < SHORT_RATIO * load.wanted_cores


def is_short(load: WorkerLoad) -> bool:
    """Whether the worker visibly wants more than it gets; an idle worker lacks nothing.

    Either its threads always want to run and run for less, or it leaves work undone.
    """
    jobs = load.jobs
    return _is_hungry(load) or (jobs is not None and jobs.done_hz < SHORT_RATIO * jobs.wanted_hz)


def shows_lack(load: WorkerLoad) -> bool:
    """Whether the worker's report shows its lack of CPU, and not only its undone work."""
    jobs = load.jobs
    return jobs is not None and (jobs.wait_s is not None or load.wanted_cores is not None)
