"""The frozen values of the fleet file: nodes, tasks, streams, timing. Built and validated by `zsched.config`.

Knows: what an operator may say, with the defaults (they live here only). Does not know: YAML, files, positions.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from zsched.core.model import LinkSource, NodeId, NodeKind, TaskId, Tuning, check_range
from zsched.core.plan import Direction, ReadyWhen, StreamSettings


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
    """One line of `inputs:` or `outputs:`: templates with ``{robot} {node} {target} {task} {epoch}``."""

    direction: Direction
    from_template: str
    to_template: str
    settings: StreamSettings = StreamSettings()


@dataclass(frozen=True, slots=True, kw_only=True)
class LinkLimits:
    """Eq. 3: nu (least usable) and rho (best achievable) in dBm."""

    nu_dbm: float = -80.0
    rho_dbm: float = -40.0


@dataclass(frozen=True, slots=True, kw_only=True)
class TaskSpec:
    """One task of the fleet file."""

    name: TaskId
    candidates: tuple[NodeId, ...]
    """Sorted; labels and kinds are resolved by `zsched.config`."""
    tuning: Tuning
    demand: Demand = Demand()
    limits: LinkLimits = LinkLimits()
    reach: Reach = Reach.MAJORITY
    memory_floor_ratio: float = 0.05
    """Escape: the owner's free memory under this fraction."""
    on_isolation: OnIsolation = OnIsolation.HOLD
    exclusive: bool = False
    drain_s: float = 2.0
    worker: WorkerSpec = WorkerSpec()
    rules: tuple[StreamRule, ...] = ()


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """The clocks of the protocol; profiles `wired`, `wifi`, `wan` are written as differences (`docs/timing.md`)."""

    name: str = "wifi"
    beat_s: float = 0.2
    suspect_s: float = 1.2
    """Silence of the beats after which a peer is suspect."""
    confirm_s: float = 0.3
    """How long a suspect may refute, or a second observer confirm, before it is gone."""
    zenoh_lease_s: float = 1.5
    sample_s: float = 0.2
    smoothing_s: float = 3.0
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
