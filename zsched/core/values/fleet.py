"""The frozen values of the fleet file: nodes, tasks, streams, timing. Built and validated by `zsched.config.load`.

Knows: what an operator may say, with the defaults (they live here only). Does not know: YAML, files, positions.

A class's defaults are the plain rule: a time-to-trigger, signals as they are. The constants below are what a task of a
fleet file gets that says nothing else.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, fields, is_dataclass
from enum import StrEnum
from functools import lru_cache

from zsched.core.values.model import Allocation, LinkSource, NodeId, NodeKind, ScoreForm, TaskId, Tuning, check_range
from zsched.core.values.plan import Direction, ReadyWhen, ServiceSettings, StreamSettings

DEFAULT_SCORE = ScoreForm.SERVICE
"""What a machine is worth to a task whose fleet file does not say how to score (docs/decisions/0031)."""
PAPER_PATIENCE = 0.55
"""Utility seconds, of a task with `ScoreForm.PAPER` whose fleet file gives neither a patience nor a time-to-trigger."""
RADIO_PATIENCE = 0.3
"""Likewise, of a task scored by service that weighs the network. All others learn theirs (docs/decisions/0033)."""
PATIENT_BONUS = 0.05
"""The bonus of a task with a patience, when its fleet file gives none; with a time-to-trigger it is `Tuning`'s."""
PATIENT_COOL_DOWN_S = 2.0
"""The cool-down of a task with a patience, likewise (docs/decisions/0033)."""
DEFAULT_FORESEE_S = 3.0
"""How far ahead the signals of a task count when its fleet file does not say."""


class Standby(StrEnum):
    """Whether candidates keep the worker running (warm) or start it on the move (cold)."""

    WARM = "warm"
    COLD = "cold"


class OnIsolation(StrEnum):
    """What a robot does that is cut off from the owner without a quorum."""

    HOLD = "hold"
    LOCAL = "local"


class Reach(StrEnum):
    """Who must reach a candidate: a majority of the fresh voters, or all of them."""

    MAJORITY = "majority"
    ALL = "all"


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
    column: str = "c_rssi"
    """Trace: the CSV column that holds dBm."""
    offset_s: float = 0.0
    """Trace: where in the drive to start."""
    mac: str = ""
    """nl80211: the station that ``peer`` is (empty: the access point)."""


class LocalMode(StrEnum):
    """How a relay joins its host's own zenoh network."""

    CLIENT = "client"
    PEER = "peer"


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalSide:
    """A network of the host's applications apart from the fleet's: inputs come from it, outputs go to it."""

    mode: LocalMode = LocalMode.CLIENT
    connect: tuple[str, ...] = ()
    """zenoh endpoints, e.g. that of the host's `rmw_zenohd`."""
    listen: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class NodeSpec:
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


@dataclass(frozen=True, slots=True, kw_only=True)
class Demand:
    """What the task needs at least, known before it was ever measured (cores, MiB)."""

    cpu_cores: float = 0.0
    memory_mb: float = 0.0

    def __post_init__(self) -> None:
        check_range("demand.cpu_cores", self.cpu_cores, 0.0, 4096.0)
        check_range("demand.memory_mb", self.memory_mb, 0.0, 1e8)


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerSpec:
    """How a task's worker is run."""

    command: tuple[str, ...] = ()
    """Empty: nothing is started, the worker is somebody else's process."""
    standby: Standby = Standby.WARM
    ready_when: ReadyWhen = ReadyWhen.TOKEN
    link: WorkerLink = WorkerLink.PEER
    env: tuple[tuple[str, str], ...] = ()
    start_deadline_s: float = 20.0
    stop_grace_s: float = 2.0
    output_deadline_s: float | None = None
    """No output for so long while inputs flow counts as hung; ``None``: not watched."""
    max_failures: int = 3
    failure_window_s: float = 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StreamRule:
    """One line of `inputs:`, `outputs:` or `services:`: templates with ``{robot} {node} {target} {task} {epoch}``."""

    direction: Direction
    from_template: str
    to_template: str
    settings: StreamSettings = StreamSettings()
    service: ServiceSettings = ServiceSettings()
    """Services only."""


class PairReading(StrEnum):
    """What a link is worth whose two ends reach each other through one access point (docs/decisions/0018)."""

    CANDIDATE = "candidate"
    """The candidate's own way, as the paper prints Eq. 3: the robot's is part of every path, and decides nothing."""
    WEAKER = "weaker"
    """The weaker of the two ways: the bottleneck."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """Eq. 3: nu (least usable) and rho (best achievable) in dBm, and how links are read."""

    nu_dbm: float = -80.0
    rho_dbm: float = -40.0
    pair: PairReading = PairReading.CANDIDATE
    foresee_s: float = 0.0
    """Signals count as they will be so many seconds ahead along their trend; 0: as they are."""


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One task of the fleet file."""

    name: TaskId
    candidates: tuple[NodeId, ...]
    """Sorted; labels and kinds are resolved by `zsched.config.load`."""
    tuning: Tuning
    demand: Demand = Demand()
    limits: LinkLimits = LinkLimits()
    reach: Reach = Reach.MAJORITY
    memory_floor_ratio: float = 0.05
    """Escape: the owner's free memory under this fraction."""
    max_moves_per_minute: int = 6
    """Hard cap of planned moves; escapes have their own (`zsched.core.scheduler.damping`)."""
    patience: float | None = None
    """Utility seconds that staying may cost before the task moves, in place of the time-to-trigger; ``None``: that."""
    learns_patience: bool = False
    """Its patience is learnt (`zsched.core.scheduler.patience`); ``patience`` is what it begins with."""
    on_isolation: OnIsolation = OnIsolation.HOLD
    exclusive: bool = False
    drain_s: float = 2.0
    worker: WorkerSpec = WorkerSpec()
    rules: tuple[StreamRule, ...] = ()

    def first_value(self, start: int, *, is_new: bool = True) -> Allocation:
        """What a generation begins with, by this file; ``is_new`` unless somebody may work at the task by another."""
        leased = self.exclusive and is_new
        return Allocation(task=self.name, revision=start, epoch=start, owner=None, tuning=self.tuning, leased=leased)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """The clocks of the protocol; profiles `wired`, `wifi`, `wan` are differences from it (`docs/design/timing.md`)."""

    name: str = "wifi"
    beat_s: float = 0.2
    suspect_s: float = 1.2
    """Silence of the beats after which a peer is suspect."""
    confirm_s: float = 0.3
    """How long a suspect may refute, or a second observer confirm, before it is gone."""
    zenoh_lease_s: float = 1.5
    sample_s: float = 0.2
    smoothing_s: float = 0.3
    """EWMA time constant of CPU, memory and dBm."""
    publish_s: float = 1.0
    """Profiles at least so often (sooner on change)."""
    profile_ttl_s: float = 3.0
    decide_s: float = 0.5
    """A robot's own round at least so often."""
    gather_s: float = 0.15
    ballot_s: float = 0.3
    """Deadline of one prepare or accept phase."""
    stagger_s: float = 0.03
    """Wait per rank before a proposer starts."""
    lease_s: float = 1.0
    """Exclusive tasks: how long an owner may work on the echoes of one beat."""


class SharedMemory(StrEnum):
    """Whether large payloads may pass between processes of one machine through shared memory."""

    OFF = "off"
    AUTO = "auto"


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
    """Sorted; the acceptors of the register (default: the robots)."""
    seeds: tuple[NodeId, ...] = ()
    zenoh_config: str = ""
    """Path of a zenoh JSON5 file, passed through untouched; empty: none."""
    relay_orphan_s: float = 10.0
    """A relay carries on for so long when its daemon is gone, and the next daemon takes it over; 0: it ends with it."""
    shared_memory: SharedMemory = SharedMemory.OFF
    """``auto``: where the node finds /dev/shm fit for it."""

    @property
    def voters(self) -> tuple[NodeId, ...]:
        """The robots, sorted: they have utilities and proposals."""
        return tuple(node.name for node in self.nodes if node.kind is NodeKind.ROBOT)

    def node(self, name: NodeId) -> NodeSpec:
        """The node called ``name``. Raises `KeyError` when the fleet has none."""
        for node in self.nodes:
            if node.name == name:
                return node
        raise KeyError(name)

    def task(self, name: TaskId) -> TaskSpec:
        """The task called ``name``. Raises `KeyError` when the fleet has none."""
        for task in self.tasks:
            if task.name == name:
                return task
        raise KeyError(name)


def dial_endpoint(endpoint: str, host: str) -> str:
    """The zenoh endpoint under which others reach a node that listens on ``endpoint``; empty when they cannot.

    A listener on every address (``0.0.0.0``, ``[::]``) is dialled at ``host``; port 0 (any) cannot be dialled.

    >>> dial_endpoint("tcp/0.0.0.0:7457", "192.0.2.11")
    'tcp/192.0.2.11:7457'
    """
    protocol, _, address = endpoint.partition("/")
    for everywhere in ("0.0.0.0:", "[::]:"):
        if address.startswith(everywhere):
            literal = f"[{host}]" if ":" in host else host
            address = f"{literal}:{address.removeprefix(everywhere)}" if host else ""
    port = address.partition("#")[0].partition("?")[0].rpartition(":")[2]
    if not address or port == "0":
        return ""
    return f"{protocol}/{address}"


@lru_cache(maxsize=8)
def fleet_hash(fleet: Fleet) -> str:
    """16 hex digits over all that every machine of the fleet must agree on.

    Left out is what a machine may have to itself: folders (of two paths only the file's name counts). Two nodes with
    different hashes run different fleet files; they say so in their status and go on.
    """
    return _digest("fleet", fleet)


def electorate_hash(fleet: Fleet) -> str:
    """16 hex digits over the fleet's name and its electors: every prepare and accept carries it (design section 6)."""
    return _digest("electorate", (fleet.name, fleet.electors))


def lease_terms(fleet: Fleet) -> str:
    """16 hex digits over all that a lease of an exclusive task hangs on and files may say: the electors and its length.

    A majority of other electors need not meet the majority that has granted, and an elector that waits for a shorter
    lease than the owner counts on waits for nothing. Which tasks are leased is agreed (`Allocation.leased`).
    """
    return _digest("lease/2", (fleet.name, fleet.electors, fleet.timing.lease_s))


def _digest(kind: str, value: object) -> str:
    state = hashlib.blake2s(digest_size=8, person=b"zsched1", salt=kind[:8].encode())
    for part in _canonical(value):
        state.update(len(part).to_bytes(4, "big") + part)
    return state.hexdigest()


_PATHS = frozenset({("Fleet", "zenoh_config"), ("LinkSpec", "value")})
"""Fields that may hold a path: relative to the fleet file, hence another one on every machine."""


def _canonical(value: object) -> Iterable[bytes]:
    """Length-prefixed by the caller, so that no two different values have the same parts."""
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value).__name__
        yield kind.encode()
        for field in fields(value):
            held = getattr(value, field.name)
            yield field.name.encode()
            yield from _canonical(held.rpartition("/")[2] if (kind, field.name) in _PATHS else held)
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
    """Whether ``node`` keeps a worker of the task: candidates do, and robots that work alone when they are cut off."""
    is_alone = kind is NodeKind.ROBOT and task.on_isolation is OnIsolation.LOCAL
    return node in task.candidates or is_alone
