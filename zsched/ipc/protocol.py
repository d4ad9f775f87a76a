"""The frozen values by which a daemon and its relay know each other: question, answer, and a sign that the relay lives.

Knows: the greeting between a relay and the successor of its daemon, the pulse. Does not know: pipes, frames, plans.
"""

from __future__ import annotations

from dataclasses import dataclass

from zsched.core.values.model import NodeId, check_counter, check_name, check_range


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayPulse:
    """The relay lives, though it has nothing to say; ``counted_s``: its streams were last counted this long ago."""

    counted_s: float

    def __post_init__(self) -> None:
        check_range("pulse.counted_s", self.counted_s, 0.0, 1e9)


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayHello:
    """A daemon asks for the relay that another daemon left: who it is, and what it would start a relay with."""

    fleet: str
    node: NodeId
    incarnation: int
    """Of the daemon's durable state: it rises with every start."""
    digest: str
    """Over the fleet file, the sessions and the version (`zsched.ipc.takeover.digest_of`)."""

    def __post_init__(self) -> None:
        check_name("hello.fleet", self.fleet)
        check_name("hello.node", self.node)
        check_counter("hello.incarnation", self.incarnation)


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayHere:
    """The relay obeys this daemon from now on."""

    pid: int


@dataclass(frozen=True, slots=True, kw_only=True)
class RelayRefused:
    """The relay is not this daemon's."""

    reason: str
