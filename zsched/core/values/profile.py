"""What a node measures and tells of its machine: links, workers and their jobs, and the profile that is made of them.

Knows: what a figure means, in which unit and range. Does not know: how it is measured, smoothed or sent.
"""

from __future__ import annotations

from enum import StrEnum

from zsched.core.values.model import (
    RSSI_MAX_DBM,
    RSSI_MIN_DBM,
    NodeId,
    TaskId,
    check_counter,
    check_length,
    check_name,
    check_readings,
)
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import Readings, Trouble, check_range

MAX_CPU_CORES, MAX_MEMORY_MB, MAX_BITRATE_MBPS = 4096.0, 1e8, 1e6
MIN_SPEED, MAX_SPEED = 0.001, 1000.0
MAX_RUNNABLE = 1e6
MAX_JOBS_HZ, MAX_JOB_S = 1e6, 1e6
MAX_HELD_S = 3600.0
"""Bounds that no machine or link exceeds: a larger figure is a fault of its sender."""


class LinkSource(StrEnum):
    """Where a link's figure comes from; status shows it."""

    NL80211 = "nl80211"
    WIRELESS = "wireless"  # /proc/net/wireless
    WIRED = "wired"
    FIXED = "fixed"
    TRACE = "trace"


class Link(Struct, frozen=True, kw_only=True):
    """One radio or wired link as its node measures it.

    ``peer`` is the node at the other end, or ``None`` for "the way to everybody" (the access point, the cable).
    ``rssi_dbm`` is the smoothed signal in dBm, ``None`` when not measured; a wired link has none and counts 1.
    """

    source: LinkSource
    peer: NodeId | None = None
    rssi_dbm: float | None = None
    bitrate_mbps: float | None = None
    retry_ratio: float | None = None

    def __post_init__(self) -> None:
        if self.peer is not None:
            check_name("link.peer", self.peer)
        check_range("link.rssi_dbm", self.rssi_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)
        check_range("link.bitrate_mbps", self.bitrate_mbps, 0.0, MAX_BITRATE_MBPS)
        check_range("link.retry_ratio", self.retry_ratio, 0.0, 1.0)


class WorkerState(StrEnum):
    """A worker process as its supervisor (and its token) show it."""

    STOPPED = "stopped"  # startable: a cold standby, or between restarts
    STARTING = "starting"
    READY = "ready"
    FAILED = "failed"  # too many failures in the window, or it said that it cannot: the node is not eligible


class Jobs(Struct, frozen=True, kw_only=True):
    """A worker's report of its jobs, smoothed (`zsched.core.profile.jobs`).

    A job is one input sample and its callback. Times are seconds per job, means over the done jobs; rates are jobs per
    second.
    """

    time_s: float
    """From the beginning of a job to its end."""
    cpu_s: float
    """CPU time of a job, in all threads that work on it."""
    wait_s: float | None = None
    """Of ``time_s``, what its thread waited for a CPU; ``None``: the kernel does not tell, or several threads work."""
    age_s: float | None = None
    """From a job's arrival to its end, the wait for its turn included; ``None``: not told."""
    done_hz: float = 0.0
    wanted_hz: float = 0.0
    """Done and undone jobs: skipped for newer ones, or added to the waiting ones."""
    backlog: int = 0
    """Jobs that wait."""
    late_ratio: float | None = None
    """Share of the done ones that took longer than the task's deadline from arrival to end; ``None``: it has none."""

    def __post_init__(self) -> None:
        for name in ("time_s", "cpu_s", "wait_s", "age_s"):
            check_range(f"jobs.{name}", getattr(self, name), 0.0, MAX_JOB_S)
        for name in ("done_hz", "wanted_hz"):
            check_range(f"jobs.{name}", getattr(self, name), 0.0, MAX_JOBS_HZ)
        check_counter("jobs.backlog", self.backlog)
        check_range("jobs.late_ratio", self.late_ratio, 0.0, 1.0)

    @property
    def done_ratio(self) -> float | None:
        """Share of the wanted jobs that are done, in [0, 1]; ``None`` while none is wanted."""
        return min(self.done_hz / self.wanted_hz, 1.0) if self.wanted_hz > 0.0 else None


class Renewal(StrEnum):
    """Whether a worker runs by an old recipe and is to start again (`zsched.core.executor.renewing`)."""

    NONE = ""
    DUE = "due"
    LEAVES = "leaves"  # as the owner it gives the task away first


class WorkerLoad(Struct, frozen=True, kw_only=True):
    """One task's worker on one node: its state and what its process tree uses now (cores, MiB)."""

    task: TaskId
    state: WorkerState
    cpu_cores: float | None = None
    memory_mb: float | None = None
    wanted_cores: float | None = None
    """Cores that it would use alone if some of its threads always want to run; ``None``: none does, or unknown."""
    trouble: Trouble = Trouble.NONE
    reason: str = ""
    """Why it is not ready, or what is wrong with it though it is; at most `MAX_REASON` characters."""
    jobs: Jobs | None = None
    """Its report of its jobs; ``None``: none."""
    renewal: Renewal = Renewal.NONE
    unended_s: float | None = None
    """For how long it has had work without a break, and has ended no job; ``None``: not for long, or it does not
    report its jobs."""
    runnable: float | None = None
    """How many of its threads run or wait for a CPU, on the mean; ``None``: unknown."""

    def __post_init__(self) -> None:
        check_name("worker.task", self.task)
        check_range("worker.unended_s", self.unended_s, 0.0, MAX_JOB_S)
        check_length("worker.reason", self.reason)
        check_range("worker.cpu_cores", self.cpu_cores, 0.0, MAX_CPU_CORES)
        check_range("worker.memory_mb", self.memory_mb, 0.0, MAX_MEMORY_MB)
        check_range("worker.wanted_cores", self.wanted_cores, 0.0, MAX_CPU_CORES)
        check_range("worker.runnable", self.runnable, 0.0, MAX_RUNNABLE)


class TaskProgress(Struct, frozen=True, kw_only=True):
    """A robot's view of a task with `output_deadline_s`: do its inputs of ``epoch`` lead to outputs?"""

    task: TaskId
    epoch: int
    is_served: bool

    def __post_init__(self) -> None:
        check_name("progress.task", self.task)
        check_counter("progress.epoch", self.epoch)


class DeviceSample(Struct, frozen=True, kw_only=True):
    """One raw reading of this machine by the device profiler.

    ``cpu_cores`` is what may be used (cgroup quota or number of CPUs), ``cpu_used_cores`` what was in use since the
    previous sample (``None`` on the first: there is nothing to compare with), memory in MiB, ``*_used`` including
    everything that is not available (total - MemAvailable, or the cgroup's working set against its limit).
    ``workers`` holds one load per supervised worker (state as the supervisor knows it).
    """

    cpu_cores: float
    cpu_used_cores: float | None
    memory_mb: float
    memory_used_mb: float | None
    workers: tuple[WorkerLoad, ...] = ()
    speed: float | None = None
    """How fast one of its cores is; ``None``: not measured."""
    cpu_pressure: float | None = None
    """Share of the time since the last sample in which some process wanted a CPU and had none; ``None``: not known."""
    runnable: float | None = None
    """Threads that run or wait to run now, without the profiler's own; ``None``: not known."""
    gauges: Readings = ()
    """The newest readings of its gauges, raw."""


class LinkSample(Struct, frozen=True, kw_only=True):
    """One raw reading of one link by a network profiler, with outliers and without smoothing."""

    source: LinkSource
    peer: NodeId | None = None
    rssi_dbm: float | None = None
    bitrate_mbps: float | None = None
    retry_ratio: float | None = None


class Echo(Struct, frozen=True, kw_only=True):
    """The newest profile that the sender has of another node, and how long it has held it."""

    node: NodeId
    incarnation: int
    sequence: int
    held_s: float

    def __post_init__(self) -> None:
        check_name("echo.node", self.node)
        check_counter("echo.incarnation", self.incarnation)
        check_counter("echo.sequence", self.sequence)
        check_range("echo.held_s", self.held_s, 0.0, MAX_HELD_S)


class Profile(Struct, frozen=True, kw_only=True):
    """The smoothed state of a node that goes to every robot's gateway (Alg. 1: beta, mu, lambda).

    CPU in cores: ``cpu_cores`` is Eq. 1's gamma, ``cpu_used_cores`` its beta. Memory in MiB: ``memory_mb`` is Eq. 2's
    delta, ``memory_used_mb`` its mu. ``links`` are Eq. 3's lambda.
    """

    node: NodeId
    incarnation: int
    sequence: int
    cpu_cores: float
    cpu_used_cores: float | None
    memory_mb: float
    memory_used_mb: float | None
    links: tuple[Link, ...] = ()
    workers: tuple[WorkerLoad, ...] = ()
    draining: bool = False
    progress: tuple[TaskProgress, ...] = ()
    """Robots: the watched tasks that answer here, or fail to although inputs flow."""
    speed: float | None = None
    """How fast one of its cores is (`zsched.host.machine.core_speed`); ``None``: not measured."""
    cpu_pressure: float | None = None
    """Share of the time in which some process wanted a CPU and had none (PSI "some"); ``None``: not measured."""
    echoes: tuple[Echo, ...] = ()
    """Which profiles of others the node has, where a task has a deadline (`zsched.core.gateway.round_trips`)."""
    runnable: float | None = None
    """Mean number of threads that run or wait to run: a full machine is shared with them; ``None``: unknown."""
    relay: str = ""
    """What is wrong with its relay (`zsched.core.profile.relay_ends`); at most `MAX_REASON` long; empty: nothing."""
    gauges: Readings = ()
    """Smoothed readings of its gauges (`zsched.core.values.gauges`)."""

    def __post_init__(self) -> None:
        check_name("profile.node", self.node)
        check_counter("profile.incarnation", self.incarnation)
        check_counter("profile.sequence", self.sequence)
        check_range("profile.cpu_cores", self.cpu_cores, 0.001, MAX_CPU_CORES)
        check_range("profile.cpu_used_cores", self.cpu_used_cores, 0.0, MAX_CPU_CORES)
        check_range("profile.memory_mb", self.memory_mb, 1.0, MAX_MEMORY_MB)
        check_range("profile.memory_used_mb", self.memory_used_mb, 0.0, MAX_MEMORY_MB)
        check_range("profile.speed", self.speed, MIN_SPEED, MAX_SPEED)
        check_range("profile.cpu_pressure", self.cpu_pressure, 0.0, 1.0)
        check_range("profile.runnable", self.runnable, 0.0, MAX_RUNNABLE)
        check_length("profile.relay", self.relay)
        check_readings("profile.gauges", self.gauges)

    def worker(self, task: TaskId) -> WorkerLoad | None:
        """The load of ``task``'s worker on this node, or ``None`` when the node runs none."""
        for load in self.workers:
            if load.task == task:
                return load
        return None

    def has_failed(self, task: TaskId) -> bool:
        """Whether ``task``'s worker on this node has failed for good."""
        load = self.worker(task)
        return load is not None and load.state is WorkerState.FAILED

    def rests(self, task: TaskId) -> bool:
        """Whether ``task``'s worker on this node may not work, for want of a lease, though it is ready."""
        load = self.worker(task)
        return load is not None and load.trouble is Trouble.RESTS


# Goes with the next release: a daemon of the one before tells a worker's trouble by the first words of its reason.
_OLD_WORDS = {"was ready until ": Trouble.LOST, "restarting": Trouble.AGAIN, "it rests, for it": Trouble.RESTS}


def with_troubles(profile: Profile) -> Profile:
    """A peer's profile, in which an older daemon's words about its workers have become values."""
    loads = tuple(map(_with_trouble, profile.workers))
    return profile if loads == profile.workers else replace(profile, workers=loads)


def _with_trouble(load: WorkerLoad) -> WorkerLoad:
    told = (one for words, one in _OLD_WORDS.items() if load.reason.startswith(words))
    trouble = load.trouble or next(told, Trouble.NONE)
    is_old = trouble is not load.trouble and (load.state is WorkerState.READY) is (trouble is Trouble.RESTS)
    return replace(load, trouble=trouble) if is_old else load
