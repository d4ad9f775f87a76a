"""The frozen values that only the relay's pipe and the streams themselves carry.

Knows: the messages between the daemon and its relay beside plans, roles and events (`zsched.core.values.events`); the
content of end markers. Does not know: pipes, frames, zenoh.

Commands (daemon to relay): `RoutePlan`, `Role`, `WorkerWatch`, `TaskEnded`, `RelayStop`. Reports (relay to daemon):
`RelayStarted`, `WorkerSeen`, `WorkerMatched`, `WorkerTrouble`, `WorkerJobs`, `SlotLost` and the events `SlotReady`,
`SlotFlipped`, `SlotDrained`, `RoleEnded`, `StreamsCounted`, `ProblemReported`, `FrameDropped`. The handle adds
`RelayChanged`. Between workers and relays: `WorkerTrouble`, `WorkerJobs`, `EndMarker`, `StreamAcks`.
"""

from __future__ import annotations

import hashlib
from enum import StrEnum
from functools import lru_cache
from typing import Final

from zsched.core.values.events import (
    FrameDropped,
    ProblemReported,
    RelayChanged,
    RoleEnded,
    SlotDrained,
    SlotFlipped,
    SlotReady,
    StreamsCounted,
    WorkerJobs,
)
from zsched.core.values.model import MAX_REASON, NodeId, TaskId, check_counter, check_name
from zsched.core.values.plan import Route
from zsched.core.values.struct import Struct


class RelayStop(Struct, frozen=True, kw_only=True):
    """Close everything and exit; the end of the pipe means the same."""


class TaskEnded(Struct, frozen=True, kw_only=True):
    """The task left the fleet file: close its streams, watch nothing of it, tell its worker nothing any more."""

    task: TaskId

    def __post_init__(self) -> None:
        check_name("ended.task", self.task)


class RelayStarted(Struct, frozen=True, kw_only=True):
    """The relay's data session is open."""

    pid: int
    zid: str


class WorkerSeen(Struct, frozen=True, kw_only=True):
    """A worker's token on the data network came (it is ready for its inputs) or went (``is_present`` false)."""

    node: NodeId
    task: TaskId
    incarnation: str
    is_present: bool

    def __post_init__(self) -> None:
        check_name("worker.node", self.node)
        check_name("worker.task", self.task)


class WorkerWatch(Struct, frozen=True, kw_only=True):
    """A task's keys that do not depend on its owner; told when the daemon starts, and when they change.

    The first three are for a worker of this node that shows no token (`zsched.relay.matching`).
    """

    task: TaskId
    inputs: tuple[str, ...] = ()
    """The inputs of the worker here, over all robots: one key expression per rule."""
    strangers: tuple[str, ...] = ()
    """The same for a node that cannot exist: a subscriber to these as well is not (only) the worker."""
    services: tuple[tuple[str, ...], ...] = ()
    """The services of the worker here: per rule the key of every robot."""
    standbys: tuple[Route, ...] = ()
    """Robots: the inputs towards every candidate, to be announced in the ROS graph for warm workers to find."""
    unowned: tuple[Route, ...] = ()
    """Robots: the inputs towards nobody, taken from the start: what comes while there is no owner is counted."""


class WorkerMatched(Struct, frozen=True, kw_only=True):
    """Whether zenoh reports subscribers for all inputs of this node's worker of the task."""

    task: TaskId
    is_matched: bool
    is_certain: bool = True
    """False: the only match may be another program that subscribes to everything."""
    missing: str = ""
    """The inputs without a subscriber, in words."""


class WorkerTrouble(Struct, frozen=True, kw_only=True):
    """Something is wrong in a worker that is ready: its report to its relay, and the relay's to the daemon."""

    task: TaskId
    incarnation: str
    count: int
    """How many of its callbacks have raised in this life; 0: the text tells of a mistake that lasts."""
    text: str
    """The newest error, in one line."""
    is_cold: bool = False
    """The text tells why it has begun an epoch without its predecessor's state, and of no error."""

    def __post_init__(self) -> None:
        check_name("trouble.task", self.task)
        check_counter("trouble.count", self.count)
        if len(self.text) > MAX_REASON:
            raise ValueError(f"trouble.text: {len(self.text)} characters, at most {MAX_REASON}")


class EndMarker(Struct, frozen=True, kw_only=True):
    """Behind a stream's last sample of ``epoch``: ``count`` samples went before it on this key (source number - 1).

    With epoch 0 it ends nothing and is a *start marker*: no number below ``count`` will come any more.
    """

    epoch: int
    count: int
    replayed: int = 0
    """Start markers: this many samples from ``count`` on may have gone to an earlier owner, which died."""
    is_whole: bool = False
    """Start markers: the stream is of class ``reliable``, every sample is wanted."""
    had: int | None = None
    """Start markers among answers: the numbers below this one an earlier life of the same relay has acknowledged;
    ``None``: no other life of it is known."""
    age_s: float | None = None
    """Start markers among answers: seconds since number 0 was put."""
    slot: int = 0
    """Start markers of inputs: the epoch of the slot that this publisher feeds; 0: it does not say. Of class ``latest``
    that is all that a marker with a slot says; one without asks the worker how far it is."""
    is_given_up: bool = False
    """Start markers of inputs: the slot is closed. What of this publisher has not been acknowledged is counted as lost
    by now, or goes to another owner, and shall not be done any more."""

    def __post_init__(self) -> None:
        check_counter("end.epoch", self.epoch)
        check_counter("end.count", self.count)
        check_counter("end.slot", self.slot)
        check_counter("end.replayed", self.replayed)
        check_counter("end.had", self.had or 0)


class SnapshotChunk(Struct, frozen=True, kw_only=True):
    """Beside each piece of a worker's snapshot: its place, and the checksum of the whole (blake2s, 16 bytes, hex)."""

    index: int
    count: int
    size: int
    checksum: str

    def __post_init__(self) -> None:
        for name in ("index", "count", "size"):
            check_counter(f"snapshot.{name}", getattr(self, name))


ERROR_ENCODING: Final = "text/plain;zsched.error"
"""Of an error reply that zsched gives in place of the owner's answer."""
REFUSED_ENCODING: Final = "text/plain;zsched.refused"
"""Of a worker's word that it is not the owner and has done nothing."""


SKIP_ENCODING: Final = "application/zsched.skip"
"""Of an end marker among answers that are sent again: no number below its count is kept any more."""


class ServiceProblem(StrEnum):
    """Why a request was not answered: the first words of an error reply."""

    BUSY = "busy"
    NO_OWNER = "no owner"
    OWNER_GONE = "owner gone"
    MOVED = "moved"
    TIMEOUT = "timeout"


@lru_cache(maxsize=512)
def mark_of(key: str) -> int:
    """A number from 1 to 2^56 for a key, which no other key is known to have."""
    return int.from_bytes(hashlib.blake2s(key.encode(), digest_size=7, person=b"zsched1", salt=b"ack").digest()) + 1


class StreamAck(Struct, frozen=True, kw_only=True):
    """A worker's progress on one publisher of a relay, or a relay's on one of a worker; a hop's numbers start at 0."""

    eid: int
    """The publisher's entity id in the sender's session."""
    first: int
    """The first number the receiver has seen."""
    arrived: int
    """The number it waits for: everything from `first` up to it has come, or is given up."""
    processed: int
    """Everything below this number is processed (or gave way to newer samples)."""
    lost: int = 0
    doubled: int = 0
    reordered: int = 0
    has_gap: bool = False
    """Something newer than `arrived` has come and cannot go on yet: it wants the rest again..."""
    until: int = 0
    """...up to this number, which it has; 0: it has kept nothing newer."""
    is_ended: bool = False
    """The end marker has come."""
    has_left: bool = False
    """The receiver wants nothing more of it: nobody need wait until it has the rest."""
    is_whole: bool | None = None
    """A worker's: what a start marker has told it of the stream's class (`EndMarker.is_whole`); ``None``: nothing."""
    replays: int = 0
    """A worker's: this many numbers from `arrived` on count as replays, by a start marker."""
    of: int = 0
    """`mark_of` the key under which it was heard: there anybody may name any publisher; 0: not told."""

    def __post_init__(self) -> None:
        for name in ("eid", "first", "arrived", "processed", "lost", "doubled", "reordered", "until", "replays"):
            check_counter(f"ack.{name}", getattr(self, name))


class StreamAcks(Struct, frozen=True, kw_only=True):
    """A receiver's acknowledgements for one session, those that changed."""

    acks: tuple[StreamAck, ...]


class SlotLost(Struct, frozen=True, kw_only=True):
    """A slot closed, or its worker restarted, with unacknowledged samples: at most that many had no result."""

    task: TaskId
    epoch: int
    owner: NodeId
    samples: int


RelayReport = (
    RelayStarted
    | WorkerSeen
    | WorkerMatched
    | WorkerTrouble
    | WorkerJobs
    | FrameDropped
    | SlotReady
    | SlotFlipped
    | SlotDrained
    | SlotLost
    | RoleEnded
    | StreamsCounted
    | ProblemReported
)
HandleReport = RelayReport | RelayChanged
"""What `zsched.runtime.relay.streams.RelayHandle` hands to the daemon."""
