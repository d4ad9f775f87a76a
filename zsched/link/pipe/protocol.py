"""The frozen values by which a relay knows its daemon.

Knows: the greeting between a relay and its daemon, the pulse. Does not know: pipes, frames, plans.
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
    """A daemon comes to its node's relay: which relay it needs, and what a relay that runs has to hear first.

    The text of the data session follows, and that of the host's own side if there is one.
    """

    protocol: int
    """`zsched.link.pipe.relay_socket.PROTOCOL` of the daemon."""
    fleet: str
    node: NodeId
    threads: int
    """How many threads it needs, each to receive, to transmit, and to close links..."""
    spare_threads: int = 0
    """...and how many more a relay begins with, for a fleet that grows."""
    has_local_side: bool = False
    certificate: str = ""
    """A digest over the files that the data session reads when it opens."""
    addresses: tuple[str, ...] = ()
    """Without a local side: those of the host, which zenoh reads once."""
    listen: str = ""
    """Where the data session listens."""
    credentials: str = ""
    """The folder of what systemd has handed to the daemon: its sessions' texts name the key there."""
    tasks: tuple[TaskId, ...] | None = None
    """Of its fleet: what the relay carries beside these has ended. ``None``: it ends nothing."""

    def __post_init__(self) -> None:
        check_name("hello.fleet", self.fleet)
        check_name("hello.node", self.node)
        check_counter("hello.threads", self.threads)
        check_counter("hello.spare_threads", self.spare_threads)


class RelayQuestion(Struct, frozen=True, kw_only=True):
    """Somebody asks what relay runs here."""


class RelayHere(Struct, frozen=True, kw_only=True):
    """The answer to a daemon that is obeyed from now on, and to a question."""

    version: str
    """Of the program."""
    listen: str = ""
    """Where its data session listens."""


class RelayRefused(Struct, frozen=True, kw_only=True):
    """The relay is not this daemon's, or has one; in the first case it ends."""

    reason: str
