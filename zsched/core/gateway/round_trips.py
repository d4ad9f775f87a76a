"""GATEWAY: the round trip from this node to every other one, in seconds, from the echoes in profiles.

Knows: which of our profiles another node has, and for how long. Does not know: links, signals, the price of a delay.

Every node's profile names the newest profile that it has of each other node, and for how long it has held it (as NTP
does, and RTCP's DLSR, RFC 3550). The time since we sent that profile, less the hold, is the round trip, whatever the
clocks show. Profiles are taken as they come while any task has a deadline; a busy daemon takes a frame late all the
same, so the least of the last few counts. A way that becomes longer is seen that many profiles later. After a break the
first one counts alone: what was before tells of another time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping

from zsched.core.values.model import NodeId
from zsched.core.values.profile import Echo, Profile

KEPT = 8
"""The least of this many round trips counts."""
SENT = 64
"""Number of our own profiles that may be echoed; an older one says nothing."""
ECHO_S = 10.0
"""A profile that was held for longer is not echoed."""
BREAK_S = 10.0
"""A round trip that comes so long after the last one begins anew."""


class RoundTrips:
    """This node's round trips, and its echoes for others."""

    def __init__(self, me: NodeId) -> None:
        self._me = me
        self._sent: dict[int, float] = {}
        """{sequence of our own profile: when it was sent}, the oldest first."""
        self._heard: dict[NodeId, tuple[int, int, float]] = {}
        """{node: (incarnation, sequence, when) of its newest profile}."""
        self._known: dict[NodeId, deque[float]] = {}
        self._known_at: dict[NodeId, float] = {}
        """{node: when its last round trip was measured}."""

    def note_sent(self, profile: Profile, now: float) -> None:
        """Our own profile leaves."""
        self._sent[profile.sequence] = now
        if len(self._sent) > SENT:
            del self._sent[next(iter(self._sent))]

    def note_heard(self, profile: Profile, incarnation: int, now: float) -> None:
        """Another node's profile that the gateway has believed; ``incarnation``: our own."""
        self._heard[profile.node] = (profile.incarnation, profile.sequence, now)
        for echo in profile.echoes:
            sent_at = self._sent.get(echo.sequence)
            if echo.node != self._me or echo.incarnation != incarnation or sent_at is None:
                continue
            round_trip_s = now - sent_at - echo.held_s
            if round_trip_s >= 0.0:  # or its clock runs ahead
                self._note(profile.node, round_trip_s, now)

    def _note(self, node: NodeId, round_trip_s: float, now: float) -> None:
        if now - self._known_at.get(node, -math.inf) > BREAK_S:
            self._known[node] = deque(maxlen=KEPT)
        self._known[node].append(round_trip_s)
        self._known_at[node] = now

    def echoes(self, now: float) -> tuple[Echo, ...]:
        """The echoes for our next profile."""
        return tuple(
            Echo(node=node, incarnation=incarnation, sequence=sequence, held_s=now - at)
            for node, (incarnation, sequence, at) in sorted(self._heard.items())
            if 0.0 <= now - at <= ECHO_S
        )

    def seconds(self) -> Mapping[NodeId, float]:
        """{node: round trip}, where it is known."""
        return {node: min(known) for node, known in sorted(self._known.items())}
