"""GATEWAY, how far away nodes are: seconds from this node to each other one and back, by what profiles echo.

Knows: which of our profiles another node has heard, and how long it has kept it. Does not know: links, signals, what a
delay is worth.

Every node's profile names the newest profile that it has of each node, and how long it has held it (as NTP does, and
RTCP's DLSR, RFC 3550): what is left of the time since we sent that is the way there and back, whatever the clocks. A
busy daemon takes a frame late, so the least of the last few counts.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping

from zsched.core.values.model import Echo, NodeId, Profile

KEPT = 8
"""The least of so many round trips counts."""
SENT = 64
"""So many of our own profiles may be echoed; one of before is too old to mean anything."""
ECHO_S = 10.0
"""A profile that has been held for longer is not echoed."""


class RoundTrips:
    """This node's round trips, and what it echoes."""

    def __init__(self, me: NodeId) -> None:
        self._me = me
        self._sent: dict[int, float] = {}
        """{sequence of our own profile: when it was sent}, the oldest first."""
        self._heard: dict[NodeId, tuple[int, int, float]] = {}
        """{node: (incarnation, sequence, when) of its newest profile}."""
        self._known: dict[NodeId, deque[float]] = {}

    def note_sent(self, profile: Profile, now: float) -> None:
        """Our own profile leaves."""
        self._sent[profile.sequence] = now
        if len(self._sent) > SENT:
            del self._sent[next(iter(self._sent))]

    def note_heard(self, profile: Profile, incarnation: int, now: float) -> None:
        """Another node's profile, which the gateway has believed; ``incarnation``: our own."""
        self._heard[profile.node] = (profile.incarnation, profile.sequence, now)
        for echo in profile.echoes:
            sent_at = self._sent.get(echo.sequence)
            if echo.node != self._me or echo.incarnation != incarnation or sent_at is None:
                continue
            round_trip_s = now - sent_at - echo.held_s
            if round_trip_s >= 0.0:  # or its clock runs ahead
                self._known.setdefault(profile.node, deque(maxlen=KEPT)).append(round_trip_s)

    def echoes(self, now: float) -> tuple[Echo, ...]:
        """What our next profile says of the others'."""
        return tuple(
            Echo(node=node, incarnation=incarnation, sequence=sequence, held_s=now - at)
            for node, (incarnation, sequence, at) in sorted(self._heard.items())
            if 0.0 <= now - at <= ECHO_S
        )

    def seconds(self) -> Mapping[NodeId, float]:
        """{node: there and back}, of those that are known."""
        return {node: min(known) for node, known in sorted(self._known.items())}
