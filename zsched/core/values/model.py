"""The frozen values that every stage exchanges; each checks its own ranges.

Knows: what a value means, in which unit and range. Does not know: how it is measured, sent or stored.

Every class is a frozen dataclass whose fields are plain (str, int, float, bool, enum, tuple, another value), so that
`zsched.wire.codec` can encode any of them and no object is ever shared with an adapter. ``None`` means "not measured"
or "not there", never -1. A value out of range raises `ValueError` naming the field: from the wire that is a counted,
dropped frame; from our own code it is a bug.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from enum import StrEnum
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from zsched.core.values.struct import Struct
from zsched.core.values.words import MAX_ASKED, MAX_ASKER, NAME, PAPER_METRICS, Readings, check_range

NodeId = str
"""A node's name: ``[a-z0-9][a-z0-9_-]{0,62}``, unique in the fleet."""
TaskId = str
"""A task's name, same alphabet."""

MAX_COUNTER = 2**53
"""Largest revision, epoch, incarnation or sequence number (exact in every language's float)."""
MAX_CPU_CORES, MAX_MEMORY_MB, MAX_BITRATE_MBPS = 4096.0, 1e8, 1e6
MIN_SPEED, MAX_SPEED = 0.001, 1000.0
MAX_RUNNABLE = 1e6
RSSI_MIN_DBM, RSSI_MAX_DBM = -120.0, 0.0
MAX_TREND_DB_S = 100.0
MAX_JOBS_HZ, MAX_JOB_S = 1e6, 1e6
MAX_GAUGES, MAX_READING = 16, 1e9
"""Bounds that no machine or link exceeds: a larger figure is a fault of its sender."""
MAX_REASON = 400
"""Characters of a worker's reason: it travels with every profile."""
MAX_FOR_S = 366 * 86400.0
"""An operator's order lasts at most this long, or until it is taken back."""


def as_reason(text: str, longest: int = MAX_REASON) -> str:
    """``text``, cut to ``longest`` characters where it has more, visibly."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def check_name(field: str, value: str) -> None:
    """Raise `ValueError` unless ``value`` is a valid node, task or fleet name."""
    if NAME.fullmatch(value) is None:
        raise ValueError(f"{field}: {value!r} is not a name ([a-z0-9][a-z0-9_-]{{0,62}})")


def check_readings(field: str, readings: Readings, low: float = -MAX_READING, high: float = MAX_READING) -> None:
    """Raise `ValueError` unless the gauges' names are names, no more than `MAX_GAUGES`, and their numbers in range.

    A name may be unknown here: a peer's program may be newer.
    """
    if len(readings) > MAX_GAUGES:
        raise ValueError(f"{field}: {len(readings)} gauges, at most {MAX_GAUGES}")
    for name, number in readings:
        check_name(field, name)
        check_range(f"{field}.{name}", number, low, high)


def check_counter(field: str, value: int) -> None:
    """Raise `ValueError` unless ``0 <= value <= MAX_COUNTER``."""
    if not 0 <= value <= MAX_COUNTER:
        check_range(field, value, 0, MAX_COUNTER)


class NodeKind(StrEnum):
    """What a node is: robots vote and have streams; edges are candidates only."""

    ROBOT = "robot"
    EDGE = "edge"


class Aggregate(StrEnum):
    """How a column of utilities (one per fresh voter) becomes one number (Eq. 5-6)."""

    MEAN = "mean"
    MEDIAN = "median"


class ScoreForm(StrEnum):
    """How a candidate's CPU and memory become a utility (`zsched.core.scheduler.utility`)."""

    PAPER = "paper"  # Eq. 1, 2 and 4: what is left over, as shares of the machine, and their weighted sum
    SERVICE = "service"  # which share of its work the task would get done, and a weighted product


class Objective(StrEnum):
    """The figure by which a task judges its machine (`ScoreForm.SERVICE`)."""

    SERVICE = "service"  # as many of its jobs done as possible
    LATENCY = "latency"  # as many of them as possible done within a deadline


class Reach(StrEnum):
    """How many robots must reach a candidate: a majority of the fresh voters, or all of them."""

    MAJORITY = "majority"
    ALL = "all"


class PairReading(StrEnum):
    """How to value a link whose two ends reach each other through one access point (docs/decisions/0018)."""

    CANDIDATE = "candidate"
    """The candidate's own way, as the paper prints Eq. 3: the robot's is part of every path, and decides nothing."""
    WEAKER = "weaker"
    """The weaker of the two ways: the bottleneck."""


# --- what an operator sets -------------------------------------------------------------------------------------------


class Weights(Struct, frozen=True, kw_only=True):
    """The weights of Eq. 4 and of the gauges: each in [0, 1], their sum 1 (to 1e-6).

    An older program reads no ``gauges``. It drops a frame with such weights, since the other weights' sum is not 1.
    """

    cpu: float
    memory: float
    network: float
    gauges: Readings = ()
    """Sorted; only weights above 0."""

    def __post_init__(self) -> None:
        for field in ("cpu", "memory", "network"):
            check_range(f"weights.{field}", getattr(self, field), 0.0, 1.0)
        check_readings("weights", self.gauges, 0.0, 1.0)
        total = self.cpu + self.memory + self.network + sum(weight for _, weight in self.gauges)
        if not math.isclose(total, 1.0, abs_tol=1e-6):
            raise ValueError(f"weights: the sum is {total:g}, not 1")

    @classmethod
    def of(cls, shares: Mapping[str, float]) -> Weights:
        """The weights of ``{metric: weight}``; what is not the paper's is a gauge, and what is left out is 0.

        Raises:
            ValueError: a weight is out of range, or the sum is not 1.
        """
        three = {name: shares.get(name, 0.0) for name in PAPER_METRICS}
        gauges = tuple((name, shares[name]) for name in sorted(shares) if name not in PAPER_METRICS and shares[name])
        return cls(**three, gauges=gauges)

    @property
    def shares(self) -> tuple[tuple[str, float], ...]:
        """Every metric with its weight: the paper's three, then the gauges."""
        return (("cpu", self.cpu), ("memory", self.memory), ("network", self.network), *self.gauges)


MIN_DEADLINE_MS, MAX_DEADLINE_MS = 1.0, 3.6e6
MAX_PATIENCE, MAX_MOVES_PER_MINUTE, MAX_MEMORY_FLOOR, MAX_FORESEE_S = 1000.0, 100_000, 0.9, 30.0


class Tuning(Struct, frozen=True, kw_only=True):
    """The settings that may change on the running fleet, agreed through the register like an allocation.

    ``bonus`` is added to the owner's aggregate (APPLY_COST of Alg. 2), in utility units [0, 1]; ``cool_down_s`` is the
    least stay after a move.
    """

    weights: Weights
    bonus: float = 0.10
    cool_down_s: float = 10.0
    aggregate: Aggregate = Aggregate.MEAN
    score: ScoreForm = ScoreForm.PAPER
    deadline_ms: float | None = None
    """`Objective.LATENCY`: a job that takes longer from input to output, network included, comes too late. ``None``:
    `Objective.SERVICE`. `ScoreForm.PAPER` knows no deadlines."""
    patience: float | None = None
    """From here on ``None``: as the fleet file says, also when the file changes."""
    max_moves_per_minute: int | None = None
    memory_floor_ratio: float | None = None
    reach: Reach | None = None
    nu_dbm: float | None = None
    rho_dbm: float | None = None
    pair: PairReading | None = None
    foresee_s: float | None = None

    @property
    def objective(self) -> Objective:
        """The figure by which a machine is judged."""
        return Objective.SERVICE if self.deadline_ms is None else Objective.LATENCY

    def __post_init__(self) -> None:
        check_range("deadline_ms", self.deadline_ms, MIN_DEADLINE_MS, MAX_DEADLINE_MS)
        check_range("bonus", self.bonus, 0.0, 1.0)
        check_range("cool_down_s", self.cool_down_s, 0.0, 86400.0)
        check_range("patience", self.patience, 0.0, MAX_PATIENCE)
        check_range("max_moves_per_minute", self.max_moves_per_minute, 1, MAX_MOVES_PER_MINUTE)
        check_range("memory_floor_ratio", self.memory_floor_ratio, 0.0, MAX_MEMORY_FLOOR)
        check_range("nu_dbm", self.nu_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)
        check_range("rho_dbm", self.rho_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)
        check_range("foresee_s", self.foresee_s, 0.0, MAX_FORESEE_S)


class Asked(Struct, frozen=True, kw_only=True):
    """Who ordered a change, and why; ``by`` is user@node as that node told it, for people."""

    by: str
    reason: str = ""

    def __post_init__(self) -> None:
        _check_text("asked.by", self.by, MAX_ASKER)
        _check_text("asked.reason", self.reason, MAX_ASKED)


def told_by(asked: Asked) -> str:
    """Who has ordered something, with the reason.

    >>> told_by(Asked(by="ada@robot1", reason="new battery"))
    'ada@robot1 (new battery)'
    """
    return f"{asked.by} ({asked.reason})" if asked.reason else asked.by


def _check_text(field: str, text: str, longest: int) -> None:
    if len(text) > longest:
        raise ValueError(f"{field}: {len(text)} characters, at most {longest}")


class Pause(Struct, frozen=True, kw_only=True):
    """An operator's order: nothing moves the task but a `move`, and a dead owner is not replaced."""

    asked: Asked
    revision: int
    """Of the allocation that brought it: nodes count its age from when they learnt that."""
    for_s: float | None = None
    """Seconds until it ends by itself; ``None``: never."""

    def __post_init__(self) -> None:
        check_counter("pause.revision", self.revision)
        check_range("pause.for_s", self.for_s, 1.0, MAX_FOR_S)


class Pin(Struct, frozen=True, kw_only=True):
    """An operator's order: the task belongs on ``node`` and moves for an escape only, or (hard) for nothing."""

    node: NodeId
    asked: Asked
    revision: int
    is_hard: bool = False
    """No other node ever gets the task."""
    for_s: float | None = None

    def __post_init__(self) -> None:
        check_name("pin.node", self.node)
        check_counter("pin.revision", self.revision)
        check_range("pin.for_s", self.for_s, 1.0, MAX_FOR_S)


# --- PROFILE ---------------------------------------------------------------------------------------------------------


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
    trend_db_s: float | None = None
    """How fast the smoothed signal changes, dB per second; ``None``: not known."""

    def __post_init__(self) -> None:
        if self.peer is not None:
            check_name("link.peer", self.peer)
        check_range("link.rssi_dbm", self.rssi_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)
        check_range("link.trend_db_s", self.trend_db_s, -MAX_TREND_DB_S, MAX_TREND_DB_S)
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
    reason: str = ""
    """Why it is not ready, or what is wrong with it though it is; at most `MAX_REASON` characters."""
    jobs: Jobs | None = None
    """Its report of its jobs; ``None``: none."""
    renewal: Renewal = Renewal.NONE

    def __post_init__(self) -> None:
        check_name("worker.task", self.task)
        if len(self.reason) > MAX_REASON:
            raise ValueError(f"worker.reason: {len(self.reason)} characters, at most {MAX_REASON}")
        check_range("worker.cpu_cores", self.cpu_cores, 0.0, MAX_CPU_CORES)
        check_range("worker.memory_mb", self.memory_mb, 0.0, MAX_MEMORY_MB)
        check_range("worker.wanted_cores", self.wanted_cores, 0.0, MAX_CPU_CORES)


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


MAX_HELD_S = 3600.0


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
    """How fast one of its cores is (`zsched.adapters.machine.core_speed`); ``None``: not measured."""
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
        if len(self.relay) > MAX_REASON:
            raise ValueError(f"profile.relay: {len(self.relay)} characters, at most {MAX_REASON}")
        check_readings("profile.gauges", self.gauges)

    def worker(self, task: TaskId) -> WorkerLoad | None:
        """The load of ``task``'s worker on this node, or ``None`` when the node runs none."""
        for load in self.workers:
            if load.task == task:
                return load
        return None

    def cores_of(self, task: TaskId) -> float:
        """Cores that ``task``'s worker uses on this node; 0 without a worker or a measurement."""
        load = self.worker(task)
        return 0.0 if load is None else load.cpu_cores or 0.0


# --- SCHEDULER -------------------------------------------------------------------------------------------------------


class Utility(Struct, frozen=True, kw_only=True):
    """One robot's score of one candidate: Eq. 4 and its terms, each in [0, 1] or absent (nobody measured it)."""

    candidate: NodeId
    value: float
    cpu: float | None = None
    memory: float | None = None
    network: float | None = None
    reachable: bool = True
    gauges: Readings = ()
    """The terms of the gauges that the task weighs."""

    def __post_init__(self) -> None:
        check_name("utility.candidate", self.candidate)
        check_range("utility.value", self.value, 0.0, 1.0)
        check_range("utility.cpu", self.cpu, 0.0, 1.0)
        check_range("utility.memory", self.memory, 0.0, 1.0)
        check_range("utility.network", self.network, 0.0, 1.0)
        check_readings("utility.gauges", self.gauges, 0.0, 1.0)

    @property
    def terms(self) -> dict[str, float | None]:
        """Every metric with its term: the paper's three, then the gauges."""
        return {"cpu": self.cpu, "memory": self.memory, "network": self.network, **dict(self.gauges)}


class UtilityVector(Struct, frozen=True, kw_only=True):
    """One robot's utilities of a task's candidates, in the candidates' order, under the tuning of ``revision``."""

    voter: NodeId
    task: TaskId
    revision: int
    utilities: tuple[Utility, ...]
    refused: tuple[tuple[NodeId, str], ...] = ()
    """Candidates this voter did not score, each with its reason."""
    penalties: tuple[tuple[NodeId, float], ...] = ()
    """This voter's penalties against nodes, each in [0, 1] (`zsched.core.scheduler.damping`)."""

    def __post_init__(self) -> None:
        check_name("vector.voter", self.voter)
        check_name("vector.task", self.task)
        check_counter("vector.revision", self.revision)
        for _, penalty in self.penalties:
            check_range("vector.penalties", penalty, 0.0, 1.0)


class Proposal(Struct, frozen=True, kw_only=True):
    """One robot's ballot paper in Alg. 3: who should own ``task``, judged at ``base_revision``.

    ``aggregate`` is the joint utility that the robot computed for the candidate (a tie-break, rounded to 1/256);
    ``is_escape`` says that the robot holds the owner for gone, not ready or below its floor.
    """

    voter: NodeId
    task: TaskId
    base_revision: int
    candidate: NodeId
    aggregate: float
    is_escape: bool = False
    reason: str = ""

    def __post_init__(self) -> None:
        check_name("proposal.voter", self.voter)
        check_name("proposal.task", self.task)
        check_name("proposal.candidate", self.candidate)
        check_counter("proposal.base_revision", self.base_revision)
        check_range("proposal.aggregate", self.aggregate, 0.0, 2.0)


# --- VOTE: the register ----------------------------------------------------------------------------------------------


class Allocation(Struct, frozen=True, kw_only=True):
    """The register's value: who owns the task, and how it is tuned.

    ``revision`` rises by one with every change, ``epoch`` only when ``owner`` changes. Revision 0 is "nothing agreed
    yet": no owner, the fleet file's tuning.
    """

    task: TaskId
    revision: int
    epoch: int
    owner: NodeId | None
    tuning: Tuning
    pinned: bool = False
    """Whether `pin` is in force. An older program knows only this much of it, and moves nothing then."""
    paused: bool = False
    """Whether `pause` is, likewise; without that its author is not known."""
    leased: bool = False
    """The task is exclusive for every node, whatever its file says: none works without a lease."""
    pin: Pin | None = None
    pause: Pause | None = None
    asked: Asked | None = None
    """Who ordered the change that led to this revision; ``None``: the fleet's own decision."""

    @property
    def home(self) -> NodeId | None:
        """The node to which the task is pinned; ``None``: to none."""
        if not self.pinned:
            return None
        return self.owner if self.pin is None else self.pin.node

    @property
    def is_bound(self) -> bool:
        """Whether no other node than `home` may get the task."""
        return self.pinned and self.pin is not None and self.pin.is_hard

    def __post_init__(self) -> None:
        check_name("allocation.task", self.task)
        check_counter("allocation.revision", self.revision)
        check_counter("allocation.epoch", self.epoch)
        if self.owner is not None:
            check_name("allocation.owner", self.owner)


class Ballot(Struct, frozen=True, kw_only=True, order=True):
    """A proposer's attempt, totally ordered by (counter, node, incarnation, disk)."""

    counter: int
    node: NodeId
    incarnation: int
    disk: str = ""
    """Id of the proposer's disk: a node that has lost its disk counts its lives anew."""

    def __post_init__(self) -> None:
        check_counter("ballot.counter", self.counter)
        check_counter("ballot.incarnation", self.incarnation)
        if self.node:
            check_name("ballot.node", self.node)


NO_BALLOT = Ballot(counter=0, node="", incarnation=0)
"""Lower than every real ballot."""


class Revised(Protocol):
    """What a register can hold: a value that is agreed and rewritten."""

    @property
    def task(self) -> TaskId:
        """The register's name."""

    @property
    def revision(self) -> int:
        """Rises with every change."""


if TYPE_CHECKING:
    V = TypeVar("V", bound=Revised, default=Allocation)
else:
    V = TypeVar("V")
"""What a register holds; a generic value that is named without it is of a task's register."""


class Acceptance(Struct, Generic[V], frozen=True, kw_only=True):
    """What an elector has accepted: a value under a ballot."""

    ballot: Ballot
    value: V


class RegisterState(Struct, Generic[V], frozen=True, kw_only=True):
    """The durable part of one register on one node; written before any answer leaves."""

    task: TaskId
    creation: int = 0
    """Which register of this name it is: a task that is removed and added again gets another."""
    promised: Ballot = NO_BALLOT
    accepted: Acceptance[V] | None = None
    learnt: V | None = None


# --- membership ------------------------------------------------------------------------------------------------------


class PeerState(StrEnum):
    """A peer as this node sees it."""

    UNKNOWN = "unknown"  # configured, never heard
    ALIVE = "alive"
    SUSPECT = "suspect"  # silent, or its token went, but in grace
    GONE = "gone"


class Grant(Struct, frozen=True, kw_only=True):
    """An exclusive task's lease in numbers: beat ``number`` of ``owner``'s life ``incarnation``, working in ``epoch``.

    In an elector's beat it is the grant (an echo); in the owner's, a release of all numbers up to this one.
    """

    task: TaskId
    owner: NodeId
    incarnation: int
    epoch: int
    number: int

    def __post_init__(self) -> None:
        check_name("grant.task", self.task)
        check_name("grant.owner", self.owner)
        check_counter("grant.incarnation", self.incarnation)
        check_counter("grant.epoch", self.epoch)
        check_counter("grant.number", self.number)


class Beat(Struct, frozen=True, kw_only=True):
    """The heartbeat, sent from the decision loop itself (a wedged loop stops it; zenoh's own keep-alives go on)."""

    node: NodeId
    incarnation: int
    sequence: int
    loop_lag_s: float
    learnt: tuple[tuple[TaskId, int, int], ...] = ()
    """(task, revision, epoch) of every value this node has learnt."""
    suspects: tuple[NodeId, ...] = ()
    """Nodes that this node suspects or takes for gone: the second observer's word."""
    echoes: tuple[Grant, ...] = ()
    """Exclusive tasks: this elector's grants."""
    released: tuple[Grant, ...] = ()
    """Exclusive tasks: this owner's releases."""
    asked_to_leave: tuple[tuple[TaskId, NodeId, int], ...] = ()
    """(task, owner, epoch): this elector has refused another owner because of them."""
    fleet_file: str = ""
    """Hash of the fleet file that this node goes by."""
    has_voted: bool = False
    """Whether this elector has ever promised anything."""
    generation: int = 0
    """Of this node's state; what nodes of another generation have learnt means nothing here."""
    lease_terms: str = ""
    """The terms of this node's leases; an echo under other terms does not count."""
    has_lost_state: bool = False
    """This node is in the electorate and answers no proposer: its state is lost, disputed or cannot be written."""

    votes: int = 0
    """How many promises and acceptances this elector has ever given."""

    number: int = 0
    fleet_revision: int = 0
    """Of the learnt fleet value; 0 while it is the one that every node makes of its file."""

    electorate: str = ""
    """Hash of the electors that this elector counts with, and its generation; empty: it answers no proposer."""
    twins: tuple[NodeId, ...] = ()
    """Names with two daemons, as this node hears them; the daemons themselves ask about it."""
    lacks_state_file: bool = False
    """With `has_lost_state`: there is no file at all, so `zsched init` may only have been forgotten."""
    disk: str = ""
    """Id of the disk with which this node may elect; empty: it may not."""
    gone: tuple[NodeId, ...] = ()
    """Electors that this elector takes for gone (`zsched.core.electorate.pilot`)."""
    away: tuple[NodeId, ...] = ()
    """Robots that this elector takes for away."""
    may_return: bool = False
    """With `has_lost_state`: once its seat is given up, this node can be added as an elector again."""
    calm: bool = False
    """Nothing goes on at this node: its next beat may come at the slow pace (`zsched.core.membership.pace`)."""

    def __post_init__(self) -> None:
        check_name("beat.node", self.node)
        check_counter("beat.votes", self.votes)
        check_counter("beat.number", self.number)
        check_counter("beat.fleet_revision", self.fleet_revision)
        check_counter("beat.incarnation", self.incarnation)
        check_counter("beat.sequence", self.sequence)
        check_range("beat.loop_lag_s", self.loop_lag_s, 0.0, 86400.0)
        check_counter("beat.generation", self.generation)
