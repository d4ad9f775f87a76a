"""GATEWAY: whether a machine is full, and whether a worker visibly lacks CPU.

Knows: threads that always want to run, jobs left undone. Does not know: how needs and shares are learnt.
"""

from __future__ import annotations

from typing import Final

from zsched.core.values.profile import Profile, WorkerLoad

STARVED_CPU_RATIO: Final = 0.9
"""On a busier owner a task may get less than it wants: its use is only a lower bound of its need."""
SHORT_RATIO: Final = 0.9
"""A worker that gets a smaller part of what it wants lacks something."""


def is_full(profile: Profile) -> bool:
    """Whether so little CPU is free that a task's use tells no more what it needs."""
    return profile.cpu_used_cores is not None and profile.cpu_used_cores / profile.cpu_cores >= STARVED_CPU_RATIO


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
