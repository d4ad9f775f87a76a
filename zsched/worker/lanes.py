"""One output's answers that are kept: the lock and the ways to single relays around `zsched.core.hop.shared`.

Knows: threads, zenoh's publishers. Does not know: what is owed to which relay (`SharedSender`), when it is put
(`zsched.worker.keep`), which inputs wait (`zsched.worker.debts`).
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from typing import Any

import zenoh
from zenoh import CongestionControl, Session

from zsched.clock import monotonic_s
from zsched.core.hop.kept import Owed
from zsched.core.hop.shared import MAX_RECEIVERS, SharedSender
from zsched.core.relay_protocol import EndMarker, StreamAck
from zsched.core.values.struct import Struct, field
from zsched.wire.keyspace import AGAIN_CHUNK

_log = logging.getLogger("zsched.worker")

Answer = tuple[Any, Any, Any]
"""(payload, attachment, encoding)."""


class KeptLane(Struct, kw_only=True, eq=False):
    """One publisher's answers; its lock guards `state`.

    `keep`, `note_end` and `settled` may be called from any thread, the rest is the keeper's.
    """

    key: str
    source_id: zenoh.EntityGlobalId
    wake: threading.Event
    state: SharedSender
    lock: threading.Lock = field(default_factory=threading.Lock)
    ways: dict[str, zenoh.Publisher] = field(default_factory=dict)
    """{relay: the publisher of what it alone is sent again}; there while that is owed, or a relay is looked for."""
    is_closed: bool = False
    """Nothing more is put."""

    def keep(self, answer: Answer, stamp: Any, size: int) -> int:
        """Keep what is about to be put; answers its number."""
        with self.lock:
            number = self.state.note_put(answer, stamp, size, monotonic_s())
        if not self.wake.is_set():
            self.wake.set()
        return number

    def note_end(self, marker: EndMarker) -> None:
        """The end marker was put behind the last answer."""
        with self.lock:
            self.state.note_end(marker, monotonic_s())
        self.wake.set()

    def settled(self, name: str, now: float, /) -> int:
        """`SharedSender.settled`."""
        with self.lock:
            return self.state.settled(name, now)

    # --- the keeper's thread -----------------------------------------------------------------------------------------

    def hear(self, relay: str, node: str, ack: StreamAck, now: float) -> None:
        """Take a relay's word."""
        with self.lock:
            before = self.state.crowded_out
            self.state.hear(relay, node, ack, now)
            is_first = before < self.state.crowded_out == 1
        if is_first:
            _log.warning("%s: more than %d relays acknowledge answers: some are strangers", self.key, MAX_RECEIVERS)

    def take_owed(self, session: Session) -> Iterator[tuple[zenoh.Publisher, Owed, EndMarker | None]]:
        """What single relays are to be put now: (the way to one, what is owed to it, the marker of its skip)."""
        with self.lock:
            relays = self.state.owing()
        for relay in relays:
            is_reached, now = _matches(self._way(session, relay)), monotonic_s()
            with self.lock:
                owed = self.state.take_owed(relay, now, is_reached=is_reached)
                skip = None if owed.skip is None else self.state.skip_marker(relay, owed.skip, now)
            yield self.ways[relay], owed, skip

    def look_after(self, session: Session, now: float) -> None:
        """Note what is late; find out which relays that have said nothing subscribe to the answers."""
        with self.lock:
            self.state.look_after(now)
            in_doubt = self.state.in_doubt(now)
        for relay in in_doubt:
            if relay not in self.ways:
                self._way(session, relay)  # it is known at the next tick whether it matches
                continue
            is_there = _matches(self.ways[relay])
            with self.lock:
                self.state.decide(relay, now, is_there=is_there)

    def next_deadline(self, now: float) -> float | None:
        """When to look after it again; ``None``: there is nothing left to do."""
        with self.lock:
            return self.state.next_deadline(now)

    def give_up(self) -> None:
        """Nobody looks after it any more."""
        with self.lock:
            self.state.give_up()
        for relay in tuple(self.ways):
            self._close_way(relay)

    def close_ways(self) -> None:
        """Give back the publishers to relays that nothing is owed any more."""
        if self.ways:
            with self.lock:
                unused = [relay for relay in self.ways if not self.state.needs_way(relay)]
            for relay in unused:
                self._close_way(relay)

    def _way(self, session: Session, relay: str) -> zenoh.Publisher:
        way = self.ways.get(relay)
        if way is None:
            key = f"{self.key}/{AGAIN_CHUNK}/{relay}"
            way = self.ways[relay] = session.declare_publisher(key, congestion_control=CongestionControl.BLOCK)
        return way

    def _close_way(self, relay: str) -> None:
        self.ways.pop(relay).undeclare()


def _matches(publisher: Any) -> bool:
    return bool(publisher.matching_status.matching)  # the status itself is always true
