"""The frozen values by which a relay knows its daemon.

Knows: the greeting between a relay and the successor of its daemon, the pulse. Does not know: pipes, frames, plans.
"""

from __future__ import annotations

from zsched.core.values.model import NodeId, TaskId, check_counter, check_name
from zsched.core.values.struct import Struct
from zsched.core.values.words import check_range


class RelayPulse(Struct, frozen=True, kw_only=True):
    """The relay lives, though it has nothing to say; ``counted_s``: its streams were last counted this long ago."""

    counted_s: float

    def __post_init__(self) -> None:
        check_range("pulse.counted_s", self.counted_s, 0.0, 1e9)


class RelayHello(Struct, frozen=True, kw_only=True):
    """A daemon asks for the relay that another daemon left: who it is, and what it would start a relay with."""

    fleet: str
    node: NodeId
    incarnation: int
    """Of the daemon's durable state: it rises with every start."""
    digest: str
    """Over the protocol, the host's own side and all else that a process keeps for its life (`digest_of`)."""
    session: str = ""
    """A digest over what its data session is opened with: access rules, certificate, addresses."""
    threads: int = 0
    """How many threads it needs, each to receive, to transmit, and to close links."""
    tasks: tuple[TaskId, ...] | None = None
    """Of its fleet: what an earlier daemon's relay carries beside these has ended. ``None``: it ends nothing."""

    def __post_init__(self) -> None:
        check_name("hello.fleet", self.fleet)
        check_name("hello.node", self.node)
        check_counter("hello.incarnation", self.incarnation)
        check_counter("hello.threads", self.threads)


class RelayHere(Struct, frozen=True, kw_only=True):
    """The relay obeys this daemon from now on."""

    pid: int
    reopens: bool = False
    """Its data session is not the daemon's: it waits for the configuration of one, and opens that."""


class RelayRefused(Struct, frozen=True, kw_only=True):
    """The relay is not this daemon's."""

    reason: str
