"""Hears from this node's workers that their callbacks raise, and lets the daemon know.

Knows: the keys it comes on, how much of it is handed on. Does not know: what a callback does, what follows.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from zenoh import Sample, Session

from zsched.clock import monotonic_s
from zsched.core.model import NodeId
from zsched.core.relay_protocol import WorkerTrouble
from zsched.guard import tolerant
from zsched.keyspace import Keyspace, parse
from zsched.relay_pipe import decode_trouble

PAUSE_S: Final = 0.1
"""A worker says something once a second; more than this is no worker of ours, and is left out."""


class Troubles:
    """One subscription. ``report`` is called in zenoh's thread and must only enqueue."""

    def __init__(
        self, session: Session, keyspace: Keyspace, node: NodeId, report: Callable[[WorkerTrouble], None]
    ) -> None:
        self._report = report
        self._reported_at = -PAUSE_S
        self._subscriber = session.declare_subscriber(keyspace.trouble(node, "*", "*"), tolerant(self._hear, "trouble"))

    def _hear(self, sample: Sample) -> None:
        now, parsed = monotonic_s(), parse(str(sample.key_expr))
        if parsed is None or now - self._reported_at < PAUSE_S:
            return
        trouble = decode_trouble(sample.payload.to_bytes())
        if trouble is not None and parsed.rest == (trouble.task, trouble.incarnation):
            self._reported_at = now
            self._report(trouble)
