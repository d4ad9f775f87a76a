"""Watches the relays' liveliness tokens on the data network: of which life of a relay nothing more will come.

Knows: token keys, which session is whose relay's. Does not know: sources, epochs, what follows from an end.

A token that goes shows no end: a link may be cut, and come again with all that is under way. But a node has one relay
at a time. So a life is over when its token has gone and another one of the same node's relay is there.
"""

from __future__ import annotations

import threading
from typing import Final

from zenoh import Sample, SampleKind, Session

from zsched.core.values.model import NodeId
from zsched.host.guard import tolerant
from zsched.link.keyspace import Keyspace, parse

MAX_LIVES: Final = 4096
"""Lives that are remembered: a node has one at a time, and those before it count only until the next move."""


class RelayLives:
    """The lives of all nodes' relays, by their zenoh ids. Any thread may ask."""

    def __init__(self, session: Session, keyspace: Keyspace) -> None:
        self._lock = threading.Lock()
        self._there: dict[str, NodeId] = {}
        self._gone: dict[str, NodeId] = {}
        hear = tolerant(self._hear, "relays")
        self._watch = session.liveliness().declare_subscriber(keyspace.relay("*", "*"), hear, history=True)

    def undeclare(self) -> None:
        """Hear nothing any more."""
        self._watch.undeclare()

    def is_over(self, session_id: str) -> bool:
        """Whether a relay with this zenoh id has ended, and another life of the same node's relay has followed."""
        if session_id not in self._gone:  # asked with every sample
            return False
        with self._lock:
            node = self._gone.get(session_id)
            return node is not None and node in self._there.values()

    def _hear(self, sample: Sample) -> None:
        key = parse(str(sample.key_expr))
        if key is None or len(key.rest) != 1:
            return
        came, went = self._there, self._gone
        if sample.kind != SampleKind.PUT:
            came, went = went, came
        with self._lock:
            went.pop(key.rest[0], None)
            came[key.rest[0]] = key.owner
            if len(came) > MAX_LIVES:
                came.pop(next(iter(came)))
