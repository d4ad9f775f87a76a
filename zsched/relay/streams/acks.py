"""Acknowledgements in both directions: what workers have processed of our samples, what we have of their answers.

Knows: the keys they go on, who waits for which publisher's, which worker may speak. Does not know: what is sent again.

Anybody can put under these keys. So what a worker says counts for the streams that go to its node and task, and a life
of it that is new counts once its token has been seen.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Final
from weakref import WeakSet

from zenoh import CongestionControl, Priority, Sample, Session

from zsched.core.values import codec as wire
from zsched.core.values.errors import WireError
from zsched.core.values.fleet import Timing
from zsched.core.values.model import NodeId, TaskId
from zsched.core.values.relay_protocol import StreamAck, StreamAcks
from zsched.core.values.struct import Struct
from zsched.host.clock import monotonic_s
from zsched.host.guard import tolerant
from zsched.link.acknowledger import Acknowledger
from zsched.link.keyspace import Keyspace, parse
from zsched.link.sessions.stalled_links import StalledLinks

DEFAULT_LEASE_S: Final = Timing().zenoh_lease_s

_log = logging.getLogger("zsched.relay")

Listener = Callable[[StreamAck, str], None]
"""Takes (acknowledgement, incarnation of the worker)."""


class Acks:
    """What workers say: one subscription and one thread per relay process, in which listeners are called.

    What we say goes stream by stream: two outputs may take the answers of one key, and each has its own count.
    """

    def __init__(
        self,
        session: Session,
        keyspace: Keyspace,
        node: NodeId,
        has_token: Callable[[NodeId, TaskId, str], bool],
        lease_s: float = DEFAULT_LEASE_S,
    ) -> None:
        """Subscribe and start. ``has_token`` (node, task, incarnation) says whether such a worker is there."""
        self._has_token = has_token
        self._keyspace, self._node, self._lease_s = keyspace, node, lease_s
        self._born_at = monotonic_s()
        self._answers: WeakSet[Acknowledger] = WeakSet()
        self._lock = threading.Lock()
        self._listeners: dict[int, tuple[NodeId, TaskId, Listener]] = {}
        self.strangers = 0
        """Acknowledgements of workers that the stream does not go to."""
        self._join(session)

    def _join(self, session: Session) -> None:
        self.stalled = StalledLinks(session, self._lease_s)
        self._session, self._own_id = session, str(session.zid())
        key = self._keyspace.ack("*", "*", "*", self._own_id)
        self._subscriber = session.declare_subscriber(key, tolerant(self._hear, "acks"))

    def rejoin(self, session: Session, lease_s: float) -> None:
        """Go on by another session; the one before may be closed. What we have of answers is said there, too."""
        self.stalled.close()
        self._lease_s = lease_s
        self._join(session)

    def answers(self) -> Acknowledger:
        """How far one output stream is with the answers that come numbered; two may be given the same ones."""
        made = Acknowledger(self._send, born_at=self._born_at)
        with self._lock:
            self._answers.add(made)
        return made

    def flush(self) -> None:
        """Tell the workers at once how far we are with their answers."""
        with self._lock:
            made = tuple(self._answers)
        for one in made:
            one.flush()

    def of(self, node: NodeId, task: TaskId) -> WorkerAcks:
        """What the workers of one node for one task say."""
        return WorkerAcks(self, node, task)

    def expect(self, eid: int, node: NodeId, task: TaskId, listener: Listener) -> None:
        """Hand the acknowledgements of a node's worker for our publisher ``eid`` to ``listener``."""
        self._listeners[eid] = node, task, listener

    def forget(self, eid: int) -> None:
        """The publisher is given back."""
        self._listeners.pop(eid, None)

    def has_token(self, node: NodeId, task: TaskId, incarnation: str) -> bool:
        """Whether this life of a worker is there, as far as tokens say."""
        return self._has_token(node, task, incarnation)

    def _send(self, worker: str, frame: StreamAcks) -> None:
        """Tell a worker how far its answers are; what is dropped here is mended by the next one."""
        self._session.put(
            self._keyspace.received(self._node, self._own_id, worker),
            wire.encode(frame),
            priority=Priority.INTERACTIVE_HIGH,
            congestion_control=CongestionControl.DROP,
        )

    def _hear(self, sample: Sample) -> None:
        try:
            acks = wire.decode(sample.payload.to_bytes(), StreamAcks)
        except WireError as error:
            _log.warning("an unreadable acknowledgement was ignored (%s)", error)
            return
        key = parse(str(sample.key_expr))
        if key is None or len(key.rest) != 3:
            _log.warning("an acknowledgement under a malformed key was ignored")
            return
        task, incarnation, _ = key.rest
        for ack in acks.acks:
            self._tell(key.owner, task, incarnation, ack)

    def _tell(self, node: NodeId, task: TaskId, incarnation: str, ack: StreamAck) -> None:
        found = self._listeners.get(ack.eid)
        if found is None:
            return
        if found[:2] != (node, task):
            self.strangers += 1
            return
        try:
            found[2](ack, incarnation)
        except Exception:  # noqa: BLE001 - one stream's trouble must not stop the others' acknowledgements
            _log.exception("an acknowledgement failed")


class WorkerAcks(Struct, frozen=True):
    """`Acks` for the streams of one slot: of its owner's worker alone."""

    acks: Acks
    node: NodeId
    task: TaskId

    @property
    def stalled(self) -> StalledLinks:
        """Watches over the puts to it."""
        return self.acks.stalled

    def answers(self) -> Acknowledger:
        """See `Acks.answers`."""
        return self.acks.answers()

    def expect(self, eid: int, listener: Listener) -> None:
        """Hand what it acknowledges of our publisher ``eid`` to ``listener``."""
        self.acks.expect(eid, self.node, self.task, listener)

    def forget(self, eid: int) -> None:
        """The publisher is given back."""
        self.acks.forget(eid)

    def has_token(self, incarnation: str) -> bool:
        """Whether this life of it is there."""
        return self.acks.has_token(self.node, self.task, incarnation)
