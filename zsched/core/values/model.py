"""The frozen values that every stage exchanges; each checks its own ranges.

Knows: what a value means, in which unit and range. Does not know: how it is measured, sent or stored, what a node tells
of its machine (`zsched.core.values.profile`) and of itself (`zsched.core.values.beat`).

Every class is a frozen dataclass whose fields are plain (str, int, float, bool, enum, tuple, another value), so that
`zsched.core.values.codec` can encode any of them and no object is ever shared with an adapter. ``None`` means "not
measured" or "not there", never -1. A value out of range raises `ValueError` naming the field: from the wire that is a
counted, dropped frame; from our own code it is a bug.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from enum import StrEnum
from functools import lru_cache
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from zsched.core.values.struct import Struct, replace
from zsched.core.values.veto import Veto, read
from zsched.core.values.words import A_NAME, MAX_ASKED, MAX_ASKER, NAME, PAPER_METRICS, Readings, check_range

NodeId = str
"""A node's name: ``[a-z0-9][a-z0-9_-]{0,62}``, unique in the fleet."""
TaskId = str
"""A task's name, same alphabet."""

MAX_COUNTER = 2**53
"""Largest revision, epoch, incarnation or sequence number (exact in every language's float)."""
RSSI_MIN_DBM, RSSI_MAX_DBM = -120.0, 0.0
MAX_GAUGES, MAX_READING = 16, 1e9
"""Bounds that no machine or link exceeds: a larger figure is a fault of its sender."""
MAX_REASON = 400
"""Characters of a worker's reason: it travels with every profile."""
MAX_FOR_S = 366 * 86400.0
"""An operator's order lasts at most this long, or until it is taken back."""


def as_reason(text: str, longest: int = MAX_REASON) -> str:
    """``text``, cut to ``longest`` characters where it has more, visibly."""
    return text if len(text) <= longest else f"{text[: longest - 1]}…"


def check_length(field: str, text: str, longest: int = MAX_REASON) -> None:
    """Raise `ValueError` unless ``text`` has at most ``longest`` characters."""
    if len(text) > longest:
        raise ValueError(f"{field}: {len(text)} characters, at most {longest}")


_match = lru_cache(maxsize=1024)(NAME.fullmatch)


def check_name(field: str, value: str) -> None:
    """Raise `ValueError` unless ``value`` is a valid node, task or fleet name."""
    if _match(value[:64]) is None:  # a name is shorter, and of foreign bytes no more than that is kept
        raise ValueError(f"{field}: {value!r} is not a name ({A_NAME})")


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
MAX_PRICE_S, MAX_AGGREGATE = 1000.0, 2.0


class Tuning(Struct, frozen=True, kw_only=True):
    """The settings that may change on the running fleet, agreed through the register like an allocation.

    ``bonus`` is added to the owner's aggregate (APPLY_COST of Alg. 2), in utility units [0, 1].
    """

    weights: Weights
    bonus: float = 0.10
    score: ScoreForm = ScoreForm.PAPER
    deadline_ms: float | None = None
    """`Objective.LATENCY`: a job that takes longer from input to output, network included, comes too late. ``None``:
    `Objective.SERVICE`. `ScoreForm.PAPER` knows no deadlines."""
    price_s: float | None = None
    """From here on ``None``: as the fleet file says, also when the file changes."""
    reach: Reach | None = None
    nu_dbm: float | None = None
    rho_dbm: float | None = None

    @property
    def objective(self) -> Objective:
        """The figure by which a machine is judged."""
        return Objective.SERVICE if self.deadline_ms is None else Objective.LATENCY

    def __post_init__(self) -> None:
        check_range("deadline_ms", self.deadline_ms, MIN_DEADLINE_MS, MAX_DEADLINE_MS)
        check_range("bonus", self.bonus, 0.0, 1.0)
        check_range("price_s", self.price_s, 0.0, MAX_PRICE_S)
        check_range("nu_dbm", self.nu_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)
        check_range("rho_dbm", self.rho_dbm, RSSI_MIN_DBM, RSSI_MAX_DBM)


class Asked(Struct, frozen=True, kw_only=True):
    """Who ordered a change, and why; ``by`` is user@node as that node told it, for people."""

    by: str
    reason: str = ""

    def __post_init__(self) -> None:
        check_length("asked.by", self.by, MAX_ASKER)
        check_length("asked.reason", self.reason, MAX_ASKED)
        # half a character (a surrogate), which JSON may hold, goes into no frame: a `ValueError`, too
        f"{self.by}{self.reason}".encode()


def told_by(asked: Asked) -> str:
    """Who has ordered something, with the reason.

    >>> told_by(Asked(by="ada@robot1", reason="new battery"))
    'ada@robot1 (new battery)'
    """
    return f"{asked.by} ({asked.reason})" if asked.reason else asked.by


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
    at_limit: bool = False
    """Reached, but with so weak a signal that it is not while the task has an owner that the robots reach."""

    def __post_init__(self) -> None:
        check_name("utility.candidate", self.candidate)
        for share in (self.value, self.cpu, self.memory, self.network):
            if share is not None and not 0.0 <= share <= 1.0:
                for field in ("value", *PAPER_METRICS):
                    check_range(f"utility.{field}", getattr(self, field), 0.0, 1.0)
        if self.gauges:
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
    filters: tuple[str, ...] = ()
    """Which filter (`zsched.core.values.veto.Filter`) keeps out each of ``refused``; an older program tells none."""

    @property
    def vetoes(self) -> dict[NodeId, Veto]:
        """{candidate that this voter did not score: why}."""
        filters = itertools.chain(self.filters, itertools.repeat(None))
        return {name: read(told, why) for (name, why), told in zip(self.refused, filters, strict=False)}

    def refusing(self, vetoes: Mapping[NodeId, Veto]) -> UtilityVector:
        """The same utilities, with these vetoes alone."""
        told = sorted(vetoes.items())
        refused = tuple((name, veto.why) for name, veto in told)
        return replace(self, refused=refused, filters=tuple(veto.filter.value for _, veto in told))

    def __post_init__(self) -> None:
        check_name("vector.voter", self.voter)
        check_name("vector.task", self.task)
        check_counter("vector.revision", self.revision)


class Proposal(Struct, frozen=True, kw_only=True):
    """One robot's ballot paper in Alg. 3: who should own ``task``, judged at ``base_revision``.

    ``aggregate`` is the joint utility that the robot computed for the candidate (a tie-break, rounded to 1/1024);
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
        check_range("proposal.aggregate", self.aggregate, 0.0, MAX_AGGREGATE)


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
