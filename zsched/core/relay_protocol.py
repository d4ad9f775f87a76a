"""The frozen values that only the relay's pipe and the streams themselves carry.

Knows: what the daemon and its relay tell each other beside plans, roles and the events of `zsched.core.events`; what an
end marker says. Does not know: pipes, frames, zenoh.

Commands (daemon to relay): `RoutePlan`, `Role`, `RelayStop`. Reports (relay to daemon): `RelayStarted`, `WorkerSeen`
and the events `SlotReady`, `SlotFlipped`, `SlotDrained`, `RoleEnded`, `StreamsCounted`, `ProblemReported`. The handle
adds `RelayChanged`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

from zsched.core.events import (
    ProblemReported,
    RelayChanged,
    RoleEnded,
    SlotDrained,
    SlotFlipped,
    SlotReady,
    StreamsCounted,
)
from zsched.core.model import NodeId, TaskId, check_counter, check_name
from zsched.core.plan import Role, RoutePlan


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayStop:
    """Close everything and exit; the end of the pipe means the same."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayStarted:
    """The relay's data session is open."""

    pid: int
    zid: str


@dataclass(frozen=True, slots=True, kw_only=True)
class WorkerSeen:
    """A worker's token on the data network came (it is ready for its inputs) or went (``is_present`` false)."""

    node: NodeId
    task: TaskId
    incarnation: str
    is_present: bool

    def __post_init__(self) -> None:
        check_name("worker.node", self.node)
        check_name("worker.task", self.task)


@dataclass(frozen=True, slots=True, kw_only=True)
class EndMarker:
    """Behind a stream's last sample of ``epoch``: ``count`` samples went before it on this key (source number - 1)."""

    epoch: int
    count: int

    def __post_init__(self) -> None:
        check_counter("end.epoch", self.epoch)
        check_counter("end.count", self.count)


ERROR_ENCODING: Final = "text/plain;zsched.error"
"""Of an error reply that zsched gives in place of the owner's answer."""
REFUSED_ENCODING: Final = "text/plain;zsched.refused"
"""Of a worker's word that it is not the owner and has done nothing."""


class ServiceProblem(StrEnum):
    """Why a request was not answered: the first words of an error reply."""

    BUSY = "busy"
    NO_OWNER = "no owner"
    OWNER_GONE = "owner gone"
    MOVED = "moved"
    TIMEOUT = "timeout"


RelayCommand = RoutePlan | Role | RelayStop
RelayReport = (
    RelayStarted | WorkerSeen | SlotReady | SlotFlipped | SlotDrained | RoleEnded | StreamsCounted | ProblemReported
)
HandleReport = RelayReport | RelayChanged
"""What `zsched.adapters.streams.RelayHandle` hands to the daemon."""
