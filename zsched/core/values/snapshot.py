"""The status of a node as frozen values: exactly the content of `zsched status`.

Knows: the fields of the schema ``zsched.status/1``. Does not know: tables, colours, JSON.

Fields are only ever added within a major version of the schema. Times are ages in seconds at the moment of the answer
(clocks of two machines are never compared).
"""

from __future__ import annotations

from enum import StrEnum

from zsched.core.values.model import NodeId, TaskId, Tuning, Utility
from zsched.core.values.plan import StreamCount
from zsched.core.values.profile import Link, WorkerLoad
from zsched.core.values.struct import Struct
from zsched.core.values.words import Readings

SCHEMA = "zsched.status/1"


class Exposure(StrEnum):
    """Who can speak and listen in a node's sessions."""

    SECURED = "secured"
    """Holders of the fleet's certificates, each in its own name."""
    ENCRYPTED = "encrypted"
    """Whoever the operator's own zenoh file lets in."""
    LOCAL = "local"
    """Everybody on the node's machine."""
    OPEN = "open"
    """Everybody in the node's network."""


class FlagStatus(Struct, frozen=True, kw_only=True):
    """What an operator has said of a node, as the answering node knows it."""

    kind: str
    """``drain`` or ``ineligible``."""
    by: str
    """user@node."""
    reason: str
    known_s: float
    """Seconds since the answering node learnt it, or since it started."""
    for_s: float | None = None
    """How long it lasts; ``None``: until it is taken back."""


class NodeStatus(Struct, frozen=True, kw_only=True):
    """One node as the answering node sees it; ratios in [0, 1], ``None`` when not measured."""

    name: NodeId
    kind: str
    state: str
    age_s: float | None
    """Age of its newest profile."""
    incarnation: int | None = None
    cpu_cores: float | None = None
    cpu_used_cores: float | None = None
    cpu_ratio: float | None = None
    memory_mb: float | None = None
    memory_used_mb: float | None = None
    memory_ratio: float | None = None
    links: tuple[Link, ...] = ()
    workers: tuple[WorkerLoad, ...] = ()
    draining: bool = False
    speed: float | None = None
    """How fast one of its cores is."""
    cpu_pressure: float | None = None
    """Share of the time in which some process lacked a CPU (PSI)."""
    flags: tuple[FlagStatus, ...] = ()
    """An operator's drain of it, and whether it may get tasks; ``draining`` is the order to stop, of its own daemon."""
    gauges: Readings = ()
    """Of the measured ones: GPU in use and battery in [0, 1], temperature in °C."""


class DecisionStatus(Struct, frozen=True, kw_only=True):
    """The last round of one task at this robot."""

    outcome: str
    """``stay``, ``wait`` (a better one, not long enough), ``propose`` (a vote was called), ``none`` (nobody scored)."""
    winner: NodeId | None
    reason: str
    age_s: float
    aggregates: tuple[tuple[NodeId, float], ...] = ()
    """Joint utility per candidate, the owner's with its bonus."""
    utilities: tuple[tuple[NodeId, tuple[Utility, ...]], ...] = ()
    """(voter, its utilities)."""
    vetoed: tuple[tuple[NodeId, str], ...] = ()
    unkept: tuple[tuple[NodeId, float], ...] = ()
    """What is taken off machines that promised as much before, and did not give it, or failed."""
    owed: tuple[tuple[NodeId, float], ...] = ()
    """Seconds of work that the task owes where it may be, with what it will lose (`zsched.core.scheduler.ledger`)."""
    silent: tuple[NodeId, ...] = ()
    """Robots whose utilities did not come in time."""


class VoteStatus(Struct, frozen=True, kw_only=True):
    """The last vote of one task that this node heard: who proposed whom, and the outcome."""

    base_revision: int
    votes: tuple[tuple[NodeId, NodeId], ...]
    outcome: str
    winner: NodeId | None
    age_s: float


class HoldStatus(Struct, frozen=True, kw_only=True):
    """An operator's pause or pin of a task, as the answering node knows it."""

    by: str
    """user@node."""
    reason: str
    known_s: float
    """Seconds since the answering node learnt it, or since it started."""
    for_s: float | None = None
    """How long it lasts; ``None``: until it is taken back."""
    node: NodeId | None = None
    """A pin: where the task belongs."""
    is_hard: bool = False
    """A pin: no other node gets the task."""


class RolloutStatus(Struct, frozen=True, kw_only=True):
    """A task whose changed worker only some nodes run, until an operator goes on, as the answering node knows it."""

    by: str
    """user@node."""
    reason: str
    known_s: float
    """Seconds since the answering node learnt it, or since it started."""
    first: tuple[NodeId, ...] = ()
    """These run the changed worker, or start it now."""
    waiting: tuple[NodeId, ...] = ()
    """These run the worker of before."""


class PastAllocation(Struct, frozen=True, kw_only=True):
    """One allocation that this node has learnt since it started."""

    epoch: int
    revision: int
    owner: NodeId | None
    age_s: float
    reason: str
    by: str = ""
    """The operator who ordered it, user@node; empty: the fleet decided it."""
    is_known: bool = False
    """It was there before this node knew of it."""


class TaskStatus(Struct, frozen=True, kw_only=True):
    """One task as this node sees it."""

    name: TaskId
    owner: NodeId | None
    epoch: int
    revision: int
    since_s: float | None
    """Seconds since this node learnt the current owner."""
    owner_state: str
    phase: str
    """The handover's phase on this node: ``idle``, ``preparing``, ``flipping``, ``draining``, ``settled``."""
    tuning: Tuning
    candidates: tuple[NodeId, ...]
    decision: DecisionStatus | None = None
    vote: VoteStatus | None = None
    streams: tuple[StreamCount, ...] = ()
    history: tuple[PastAllocation, ...] = ()
    problems: tuple[str, ...] = ()
    problem_kinds: tuple[str, ...] = ()
    """Which problem each of those is (`zsched.core.values.problems.Problem`); an older program does not say."""
    round_trips: tuple[tuple[NodeId, float], ...] = ()
    """(node, seconds from the answering node to it and back), of a task with a deadline."""
    pause: HoldStatus | None = None
    """Nothing moves the task but an operator's move; ``None``: it is not paused."""
    pin: HoldStatus | None = None
    rollout: RolloutStatus | None = None
    """The task's changed worker waits for a look; ``None``: all its nodes run the same worker."""
    file_tuning: Tuning | None = None
    """The tuning that the answering node's fleet file gives it."""
    switched_s: float | None = None
    """How long this robot's streams took to switch to the owner; ``None``: they have not yet, or it is an edge."""
    gap_s: float | None = None
    """The longest time, over this robot's output streams, between the last answer of the owner before and the first
    one of this owner; ``None``: this owner has not answered yet, no other one answered before, or it is an edge."""
    tells_no_jobs: bool = False
    """Whether its worker cannot tell of its jobs, without which no deadline counts; an older program does not say."""


class QuorumStatus(Struct, frozen=True, kw_only=True):
    """Whether a change could be committed now, as far as this node knows."""

    electors: int
    needed: int
    alive: int
    """Electors that are alive, have their state, and are not apart."""
    ok: bool
    this_node: str
    """``elector``, ``no_elector`` (not in the electorate), ``lost_state`` or ``other_electorate`` (its state is)."""
    voted: tuple[NodeId, ...] = ()
    """Electors that this node knows to have voted (they must not be initialised anew)."""
    stateless: tuple[NodeId, ...] = ()
    """Electors that have lost their state, as they say themselves; also of those that are not alive any more."""
    apart: tuple[NodeId, ...] = ()
    """Electors of another generation, or with other electors in their file: they and this node refuse each other."""
    names: tuple[NodeId, ...] = ()
    """The electors, sorted."""
    number: int = 0
    """Of the agreed electors; 0: the fleet file's are in force."""
    generation: int = 0
    """Of the answering node's state."""
    pilot: str = ""
    """What this elector does about electors and robots that are not heard, or why it does nothing; empty: it rests."""
    away: tuple[NodeId, ...] = ()
    """Robots that do not count in votes, because the electors have not heard them for long."""
    generation_id: str = ""
    """Of the generation by which the answering node counts; empty: it knows none yet, or is an older version."""
    recovered_by: NodeId = ""
    """The node on which that generation was recovered; empty: it was founded."""


class Snapshot(Struct, frozen=True, kw_only=True):
    """The whole answer."""

    schema: str
    version: str
    fleet: str
    node: NodeId
    kind: str
    incarnation: int
    up_s: float
    loop_lag_s: float
    """The longest delay of the decision loop in the last half minute or so."""
    quorum: QuorumStatus
    nodes: tuple[NodeStatus, ...]
    tasks: tuple[TaskStatus, ...]
    fleet_file: str = ""
    """Hash of the fleet file, or of what the document says, by which the answering node goes."""
    fleet_revision: int = 0
    """Of the fleet value that it has learnt; 0: no change of the fleet was ever agreed."""
    document: str = ""
    """Hash of the document by which it goes; empty: by its own file."""
    joins_at: tuple[str, ...] = ()
    """Where applications on this machine join its streams: zenoh endpoints for a client to dial."""
    counters: tuple[tuple[str, int], ...] = ()
    problems: tuple[str, ...] = ()
    problem_kinds: tuple[str, ...] = ()
    """As `TaskStatus.problem_kinds`."""
    frames_dropped_s: float | None = None
    """Seconds since the newest invalid frame, ``None`` when none has come."""
    dropped_ages: tuple[tuple[str, float], ...] = ()
    """{counter of invalid frames or links that are refused: seconds since it rose last}."""
    refused: tuple[str, ...] = ()
    """Who dials with a certificate of this fleet and is not let in, and what to do; no problem of the fleet."""
    security: str = ""
    """How the answering node's sessions are let in to (`Exposure`); empty: an older version, which does not tell."""
    order_s: float = 0.0
    """How long the answering node waits for the end of an operator's order, by its fleet's timing; 0: an older
    version, which waits 3 s."""
