"""The frozen values of the fleet file: nodes, tasks, streams, timing. Built and validated by `zsched.config.load`.

Knows: what an operator may say, with the defaults (they live here only). Does not know: YAML, files, positions.

A class's defaults are the plain rule: the paper's score, signals as they are. The constants below are what a task of a
fleet file gets that says nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import lru_cache
from typing import Any

from zsched.core.values.document import Rollout
from zsched.core.values.endpoint import Endpoint
from zsched.core.values.gauges import check_limits
from zsched.core.values.limits import Range, check_ranges, key
from zsched.core.values.model import (
    MAX_PRICE_S,
    RSSI_MAX_DBM,
    RSSI_MIN_DBM,
    Allocation,
    NodeId,
    NodeKind,
    Reach,
    ScoreForm,
    TaskId,
    Tuning,
)
from zsched.core.values.plan import Direction, ReadyWhen, ServiceSettings, StreamSettings
from zsched.core.values.profile import MAX_CPU_CORES, MAX_MEMORY_MB, LinkSource
from zsched.core.values.struct import Struct, replace
from zsched.core.values.words import Readings

DEFAULT_SCORE = ScoreForm.SERVICE
"""How to score a machine when the fleet file does not say."""
DEFAULT_BONUS = 0.05
"""The bonus of a task whose fleet file gives none."""
FEWEST_SIGNS, MOST_SIGNS = 3, 4
"""Of life in a lease of data sessions; `zsched.config.timing` keeps ``lease_s`` short enough for the latter."""
LEAST_ORDER_S, MOST_ORDER_S = 3.0, 60.0
"""The end of an operator's order is waited for at least and at most this long, by whatever timing."""
ORDER_BALLOTS = 14.0
"""And for so many times ``ballot_s``: a round is given up 6 of them after it began, and its last phase may take one
more; a round that is under way is waited for first."""
PACED_SAVES = 3.0
"""A phase of a vote may take so many saves of the electors' disks..."""
MOST_PACED_S = 5.0
"""...and this long at most: one stall of a disk that is quick says nothing of the next save."""
SECONDS = Range(0.01, 3600, "s")
DBM = Range(RSSI_MIN_DBM, RSSI_MAX_DBM, "dBm")


class Standby(StrEnum):
    """Whether candidates keep the worker running (warm) or start it on the move (cold)."""

    WARM = "warm"
    COLD = "cold"


class OnIsolation(StrEnum):
    """What a robot does when it is cut off from the owner and has no quorum."""

    HOLD = "hold"
    LOCAL = "local"


class WorkerLink(StrEnum):
    """How workers join the data network."""

    PEER = "peer"
    CLIENT = "client"


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkSpec:
    """Where a node's link figure comes from (`nodes.*.wifi|wired|fixed|trace` and `nodes.*.links`).

    ``value`` by source: interface name (nl80211, with /proc/net/wireless as fallback), dBm (fixed), file (trace).
    """

    source: LinkSource
    peer: NodeId | None = None
    value: str = ""
    column: str = key("c_rssi", "The column that holds dBm.")
    offset_s: float = key(0.0, "Where in the drive to start.", Range(0, 1e6, "s"))
    mac: str = ""
    """nl80211: the station that ``peer`` is (empty: the access point)."""


class LocalMode(StrEnum):
    """How a relay joins its host's own zenoh network."""

    CLIENT = "client"
    PEER = "peer"


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSide:
    """A network of the host's applications, apart from the fleet's: inputs come from it, outputs go to it."""

    mode: LocalMode = key(LocalMode.CLIENT, "`client`: of the host's router; `peer`: among the host's peers.")
    connect: tuple[str, ...] = key((), "Endpoints to dial, such as the host's `rmw_zenohd`.")
    listen: tuple[str, ...] = key((), "Where the host's applications dial us (`peer` only).")


class NodeSpec(Struct, frozen=True, kw_only=True):
    """One machine of the fleet file."""

    name: NodeId
    kind: NodeKind
    host: str = ""
    listen_control: str = ""
    """zenoh endpoint of the control session, e.g. ``tcp/0.0.0.0:7457``."""
    listen_data: str = ""
    labels: tuple[tuple[str, str], ...] = ()
    links: tuple[LinkSpec, ...] = ()
    local: LocalSide | None = None
    """``None``: the host's applications are on the fleet's data network."""

    @property
    def control_at(self) -> str:
        """Where others dial its control session; empty: they cannot."""
        return Endpoint.of(self.listen_control).dialled(self.host)

    @property
    def data_at(self) -> str:
        """Where others dial its data session."""
        return Endpoint.of(self.listen_data).dialled(self.host)

    @property
    def can_be_dialled(self) -> bool:
        """Control and data are meshes of their own: whether it can be a seed of both."""
        return bool(self.control_at and self.data_at)


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """The task's least need, known before it was ever measured (cores, MiB, share of a GPU)."""

    cpu_cores: float = key(0.0, "CPU that the task needs at least.", Range(0, MAX_CPU_CORES, "cores"))
    memory_mb: float = key(0.0, "Memory that the task needs at least.", Range(0, MAX_MEMORY_MB, "MiB"))
    gpu: float = key(0.0, "Share of a GPU that the task uses; it is not measured.", Range(0, 1))

    def __post_init__(self) -> None:
        check_ranges(self, "demand.")


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerSpec:
    """How a task's worker is run."""

    command: tuple[str, ...] = key(
        (),
        "Program and arguments, no shell; `python` is the daemon's own. Absent: somebody else starts the worker.",
    )
    standby: Standby = key(Standby.WARM, "`warm`: runs on every candidate; `cold`: starts with the move.")
    ready_when: ReadyWhen = key(
        ReadyWhen.TOKEN,
        "`token`: the library says so; `matching`: while any zenoh program takes every input and service.",
        name="ready",
    )
    link: WorkerLink = key(WorkerLink.PEER, "How workers join the data network.")
    env: tuple[tuple[str, str], ...] = key((), "Environment.")
    user: str = key(
        "",
        "As whom the worker runs, where `zsched-worker@USER.socket` is enabled.",
        shown="`zsched-worker`, where the service starts workers",
    )
    start_deadline_s: float = key(
        20.0,
        "Ready within this time, or the start has failed; an owner's worker may be away for so long, in short "
        "absences together.",
        SECONDS,
    )
    stop_grace_s: float = key(2.0, "Between SIGINT, SIGTERM and SIGKILL; not at the daemon's own end.", SECONDS)
    output_deadline_s: float | None = key(
        None, "No output for so long while inputs flow: it is started again.", SECONDS, shown="by the task's rhythm"
    )
    max_failures: int = key(3, "So many failures in the window make the worker *failed*.", Range(1, 100))
    failure_window_s: float = key(
        60.0, "The window; failures since it was last ready always count.", Range(1, 86400, "s")
    )


class StreamRule(Struct, frozen=True, kw_only=True):
    """One line of `inputs:`, `outputs:` or `services:`: templates with ``{robot} {node} {target} {task} {epoch}``."""

    direction: Direction
    from_template: str
    to_template: str
    settings: StreamSettings = StreamSettings()
    service: ServiceSettings = ServiceSettings()
    """Services only."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """Eq. 3: nu (least usable) and rho (best achievable) in dBm."""

    nu_dbm: float = key(
        -80.0,
        "Least usable signal (Eq. 3): below it a candidate is worth nothing; while the owner is reached, others need 3 "
        "dB more.",
        DBM,
    )
    rho_dbm: float = key(-40.0, "Best achievable signal (Eq. 3); above `nu_dbm`.", DBM)


TASK_RULES = ("reach", "price_s", "memory_s", "priority")
"""Keys of `scheduling` that are fields of `TaskSpec`, under the same name."""
TUNED_RULES = ("reach", "price_s")
TUNED_LINKS = ("nu_dbm", "rho_dbm")
"""Settings of a task's file that a `Tuning` may set anew: fields of `TaskSpec` and of `LinkLimits`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One task of the fleet file."""

    name: TaskId
    candidates: tuple[NodeId, ...]
    """Sorted; labels and kinds are resolved by `zsched.config.load`."""
    tuning: Tuning
    demand: Demand = Demand()
    limits: LinkLimits = LinkLimits()
    gauge_limits: Readings = ()
    """Sorted; how far a candidate's gauges may go (`zsched.core.values.gauges`)."""
    reach: Reach = key(Reach.MAJORITY, "Who must reach a candidate, of the robots that answer.")
    price_s: float = key(
        0.3,
        "What a move costs, in seconds of the task's work: the task moves once its machine owes so much more.",
        Range(0, MAX_PRICE_S, "s"),
    )
    max_moves_per_minute: int = 6
    """A fuse, whatever the figures say; no file sets it."""
    memory_s: float = key(1000.0, "In it half of what is owed, or was not kept, is forgotten.", Range(1, 86400, "s"))
    priority: int = key(
        0,
        "CPU that tasks of less priority use counts as free.",
        Range(-100, 100),
    )
    prefer: Readings = ()
    """(node, how much more it is worth), sorted; labels are resolved by `zsched.config.tasks`."""
    beside: Readings = ()
    """(task, how much more the machine that it is on is worth; less than 0: it is worth less), sorted."""
    on_isolation: OnIsolation = key(OnIsolation.HOLD, "What a robot does that is cut off: wait, or work alone.")
    exclusive: bool = key(
        False,
        "Only an owner with a lease works; needs `{epoch}` in every output's `from`.",
    )
    drain_s: float = key(2.0, "How long the old owner may finish what it has in work.", Range(0, 600, "s"))
    worker: WorkerSpec = WorkerSpec()
    rules: tuple[StreamRule, ...] = ()
    rollout: Rollout | None = None
    """Who runs this worker already, and what the others run; ``None``: all run it. The document says it, no file."""

    def __post_init__(self) -> None:
        check_limits(self.gauge_limits)

    def worker_on(self, node: NodeId) -> WorkerSpec:
        """The worker that a node runs: while a rollout waits, that of before on all nodes but the first ones."""
        if self.rollout is None or node in self.rollout.first:
            return self.worker
        return replace(self.worker, command=self.rollout.command, env=self.rollout.env)

    def head_starts(self, owners: Mapping[TaskId, NodeId | None]) -> Readings:
        """(candidate, how much more or less than its figures say it is worth), sorted; ``owners``: of all tasks."""
        found = {name: more for name, more in self.prefer if name in self.candidates}
        for task, more in self.beside:
            node = owners.get(task)
            if node in self.candidates:
                found[node] = found.get(node, 0.0) + more
        return tuple(sorted(found.items()))

    def under(self, tuning: Tuning) -> TaskSpec:
        """This task as operators have tuned it: what they have not set is the file's.

        A pair of signals that no link could lie between is left out: another node's file may be the one it fits.
        """
        own: dict[str, Any] = {name: getattr(tuning, name) for name in TUNED_RULES}
        links: dict[str, Any] = {name: getattr(tuning, name) for name in TUNED_LINKS}
        limits = replace(self.limits, **{name: value for name, value in links.items() if value is not None})
        if limits.nu_dbm >= limits.rho_dbm:
            limits = replace(limits, nu_dbm=self.limits.nu_dbm, rho_dbm=self.limits.rho_dbm)
        return replace(self, limits=limits, **{name: value for name, value in own.items() if value is not None})

    def in_force(self, tuning: Tuning) -> Tuning:
        """The tuning with every setting that it leaves to the file."""
        spec = self.under(tuning)
        rules = {name: getattr(spec, name) for name in TUNED_RULES}
        links = {name: getattr(spec.limits, name) for name in TUNED_LINKS}
        return replace(tuning, **rules, **links)

    def first_value(self, start: int, *, is_new: bool = True) -> Allocation:
        """The first value of a generation, by this file; ``is_new``: no worker may still run by an earlier one."""
        leased = self.exclusive and is_new
        return Allocation(task=self.name, revision=start, epoch=start, owner=None, tuning=self.tuning, leased=leased)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """The clocks of the protocol; profiles `wired`, `wifi`, `wan` are differences from it (`docs/design/timing.md`)."""

    name: str = "wifi"
    beat_s: float = key(0.2, "Period of the heartbeat.", SECONDS)
    suspect_s: float = key(1.2, "Silence after which a peer is suspect.", SECONDS)
    confirm_s: float = key(0.3, "How long a suspect may refute before it is gone.", SECONDS)
    """In which a second observer may confirm, too."""
    zenoh_lease_s: float = key(1.5, "zenoh's own lease.", SECONDS)
    sample_s: float = key(0.2, "Period of the profilers.", SECONDS)
    smoothing_s: float = key(0.3, "Time constant of CPU and memory; of dBm at least 0.5 s.", SECONDS)
    publish_s: float = key(1.0, "Longest time between two profiles.", SECONDS)
    """Sooner on change."""
    profile_ttl_s: float = key(3.0, "An older profile does not count.", SECONDS)
    decide_s: float = key(0.5, "Longest time between two rounds of a robot.", SECONDS)
    gather_s: float = key(0.15, "Deadline for the peers' utilities.", SECONDS)
    ballot_s: float = key(0.3, "Deadline of one prepare or accept phase.", SECONDS)
    stagger_s: float = key(0.03, "Wait per rank before a proposer starts.", Range(0, 10, "s"))
    lease_s: float = key(1.0, "Exclusive tasks: how long an owner may work on the echoes of one beat.", SECONDS)

    def paced(self, save_s: float) -> Timing:
        """The same, where a save takes ``save_s`` on a majority of the electors.

        An answer may wait for a save that is under way and then for its own; the next proposer steps in behind both.
        """
        least_s = min(PACED_SAVES * save_s, MOST_PACED_S)
        return replace(self, ballot_s=max(self.ballot_s, least_s), stagger_s=max(self.stagger_s, least_s))

    @property
    def rest_beat_s(self) -> float:
        """Period of the beat while nothing goes on: three of them fit into the silence that makes a peer suspect."""
        return max(min(2 * self.beat_s, self.suspect_s / 3), self.beat_s)

    @property
    def control_lease_s(self) -> float:
        """How long a link that carries beats may be silent before zenoh ends it.

        Where beats find silence first, a link is not ended while they are held up (at most 1.4 x ``suspect_s``); zenoh
        may end it after three quarters of this.
        """
        is_second = self.zenoh_lease_s >= self.suspect_s
        return max(self.zenoh_lease_s, 2 * self.suspect_s) if is_second else self.zenoh_lease_s

    @property
    def order_s(self) -> float:
        """How long a node that takes an operator's order waits for its end (agreed, or not), 3 to 60 s."""
        return min(max(LEAST_ORDER_S, ORDER_BALLOTS * self.ballot_s), MOST_ORDER_S)

    @property
    def data_signs(self) -> int:
        """How many signs of life a data session sends in one ``zenoh_lease_s``, where it sends nothing else: 3 or 4.

        A frozen worker's link may end one period of these signs before its lease is over, but not before ``lease_s``:
        what the worker might still send must be past its lease by then (decision 0100).
        """
        longest_s = self.zenoh_lease_s - self.lease_s  # between two signs
        return FEWEST_SIGNS if longest_s * FEWEST_SIGNS >= self.zenoh_lease_s - 1e-9 else MOST_SIGNS


class SharedMemory(StrEnum):
    """Whether large payloads may pass between processes of one machine through shared memory."""

    OFF = "off"
    AUTO = "auto"


class Signatures(StrEnum):
    """What a secured fleet does with signatures on votes, learnt values and commands."""

    REQUIRED = "required"  # a frame without a right one is dropped
    OFFERED = "offered"  # one that is there must be right; while some nodes do not sign yet
    OFF = "off"  # nobody signs, and nobody looks


class Security(Struct, frozen=True, kw_only=True):
    """A fleet with certificates of its own authority: who is let in, besides its nodes.

    Names of operators and guests are of the same form as nodes' and are no node's.
    """

    folder: str
    """Path of this machine's certificate, its key, and what it trusts."""
    operators: tuple[str, ...] = ()
    """Sorted; they may give commands."""
    guests: tuple[str, ...] = ()
    """Sorted; they read status and streams."""
    revoked: tuple[str, ...] = ()
    """Sorted labels of keys that are not let in (`zsched.core.values.certificates`)."""
    signatures: Signatures = Signatures.REQUIRED
    orders: tuple[NodeId, ...] | None = None
    """Sorted: the nodes that may give commands, besides operators; ``None``: each of them."""

    def nameless(self) -> Security:
        """The section without the names that it lets in."""
        return replace(self, operators=(), guests=(), revoked=(), orders=None)


class Cell(Struct, frozen=True, kw_only=True):
    """Another fleet of the same site, and how it is asked."""

    name: str
    """The fleet's own name."""
    gateways: tuple[str, ...]
    """Control endpoints of some of its nodes, in the order in which they are tried."""
    file: str = ""
    """Path of its fleet file, by which its certificates are found; empty: it is not secured."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Fleet:
    """The whole fleet file, validated and with every name resolved."""

    name: str
    timing: Timing
    nodes: tuple[NodeSpec, ...]
    """Sorted by name."""
    tasks: tuple[TaskSpec, ...]
    """Sorted by name."""
    electors: tuple[NodeId, ...]
    """Sorted; the acceptors of the register (default: the robots), until the fleet has agreed others."""
    is_auto: bool = False
    """Whether electors are replaced by themselves (`electorate: auto`, or none named) once a document is agreed."""
    replace_s: float = key(
        10.0,
        "After this silence an elector is replaced, where the document names none.",
        Range(1, 3600, "s"),
    )
    away_s: float = key(
        60.0,
        "After this silence a robot does not count in votes, where a document is agreed; at least `replace_s`.",
        Range(1, 604800, "s"),
    )
    seeds: tuple[NodeId, ...] = ()
    zenoh_config: str = ""
    """Path of a zenoh JSON5 file, passed through untouched; empty: none."""
    security: Security | None = None
    """``None``: there is no `security:` section."""
    cells: tuple[Cell, ...] = ()
    """Sorted by name; the other fleets of the site, which agree on nothing with this one."""
    shared_memory: SharedMemory = key(
        SharedMemory.OFF, "Large payloads within a machine; `auto`: where the node finds it fit."
    )
    """Fit is its /dev/shm (`zsched.host.machine.shared_memory`)."""

    @property
    def voters(self) -> tuple[NodeId, ...]:
        """The robots, sorted: they have utilities and proposals."""
        return tuple(node.name for node in self.nodes if node.kind is NodeKind.ROBOT)

    @property
    def has_keyless_workers(self) -> bool:
        """Whether a task's workers have a user of their own, who may not read the key of a secured fleet's node."""
        return self.security is not None and any(task.worker.user for task in self.tasks)

    def link_of(self, task: TaskSpec) -> WorkerLink:
        """How a task's workers join: by their own relay alone where they have no key."""
        is_keyless = self.security is not None and task.worker.user
        return WorkerLink.CLIENT if is_keyless else task.worker.link

    def node(self, name: NodeId) -> NodeSpec:
        """The node called ``name``. Raises `KeyError` when the fleet has none."""
        for node in self.nodes:
            if node.name == name:
                return node
        raise KeyError(name)

    def task(self, name: TaskId) -> TaskSpec:
        """The task called ``name``. Raises `KeyError` when the fleet has none."""
        return {task.name: task for task in self.tasks}[name]


@lru_cache(maxsize=8)
def fleet_hash(fleet: Fleet) -> str:
    """16 hex digits over everything on which all machines of the fleet must agree.

    A machine's own folders are left out (of two paths only the file's name counts). Two nodes with different hashes
    have different fleet files; their status says so, and they go on.
    """
    return _digest("fleet", fleet)


def file_hash(fleet: Fleet) -> str:
    """`fleet_hash` of the text alone: what the document says beside it (rollouts) is left out."""
    return fleet_hash(replace(fleet, tasks=tuple(replace(task, rollout=None) for task in fleet.tasks)))


def electorate_hash(fleet: Fleet) -> str:
    """16 hex digits over the fleet's name and its electors: every prepare and accept carries it (design section 6)."""
    return _digest("electorate", (fleet.name, fleet.electors))


def lease_terms(fleet: Fleet) -> str:
    """16 hex digits over everything in a fleet file that a lease depends on: the electors and the lease's length.

    A majority of other electors need not meet the one that has granted. An elector that waits for a shorter lease than
    the owner's waits too briefly. Which tasks are leased is agreed (`Allocation.leased`).
    """
    return _digest("lease/2", (fleet.name, fleet.electors, fleet.timing.lease_s))


def _digest(kind: str, value: object) -> str:
    state = hashlib.blake2s(digest_size=8, person=b"zsched1", salt=kind[:8].encode())
    for part in _canonical(value):
        state.update(len(part).to_bytes(4, "big") + part)
    return state.hexdigest()


_PATHS = frozenset({("Fleet", "zenoh_config"), ("LinkSpec", "value"), ("Security", "folder"), ("Cell", "file")})
"""Fields that may hold a path: relative to the fleet file, hence another one on every machine."""


_LATER = frozenset(
    {
        ("Weights", "gauges"),
        ("Demand", "gpu"),
    }
    | {("TaskSpec", name) for name in ("gauge_limits", "rollout", "prefer", "beside", "priority")}
    | {("Fleet", "cells"), ("WorkerSpec", "user")}
    | {("Tuning", name) for name in (*TUNED_RULES, *TUNED_LINKS)}
)
"""Fields that came later: left out where they say nothing, so that nodes of two versions see the same file."""


def _canonical(value: object) -> Iterable[bytes]:
    """Length-prefixed by the caller, so that no two different values have the same parts."""
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value).__name__
        yield kind.encode()
        for one in fields(value):
            held = getattr(value, one.name)
            if not one.compare or ((kind, one.name) in _LATER and held == one.default):
                continue
            yield one.name.encode()
            yield from _canonical(held.rpartition("/")[2] if (kind, one.name) in _PATHS else held)
        return
    if isinstance(value, tuple):
        yield b"%d" % len(value)
        for item in value:
            yield from _canonical(item)
        return
    if isinstance(value, float | int) and not isinstance(value, bool):
        yield float(value).hex().encode()  # 2 and 2.0 are one setting
        return
    yield f"{type(value).__name__}:{value}".encode()


def runs_worker(task: TaskSpec, node: NodeId, kind: NodeKind) -> bool:
    """Whether ``node`` keeps a worker of the task: candidates do, and robots that may work alone when cut off."""
    is_alone = kind is NodeKind.ROBOT and task.on_isolation is OnIsolation.LOCAL
    return node in task.candidates or is_alone
