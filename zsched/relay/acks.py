"""Acknowledgements in both directions: what workers have processed of our samples, what we have of their answers.

Knows: the keys they go on, who waits for which publisher's. Does not know: what is sent again.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from weakref import WeakSet

import zenoh
from zenoh import Sample, Session

from zsched import wire
from zsched.clock import monotonic_s
from zsched.core.model import NodeId
from zsched.core.relay_protocol import StreamAck, StreamAcks
from zsched.errors import WireError
from zsched.guard import guarded
from zsched.hop_acks import Acknowledger
from zsched.keyspace import Keyspace

_log = logging.getLogger("zsched.relay")

Listener = Callable[[StreamAck, str], None]
"""Takes (acknowledgement, incarnation of the worker)."""


class Acks:
    """What workers say: one subscription and one thread per relay process, in which listeners are called.

    What we say goes stream by stream: two outputs may take the answers of one key, and each has its own count.
    """

    def __init__(self, session: Session, keyspace: Keyspace, node: NodeId) -> None:
        """Subscribe and start."""
        self._session = session
        self._keyspace, self._node, self._own_id = keyspace, node, str(session.zid())
        self._born_at = monotonic_s()
        self._answers: WeakSet[Acknowledger] = WeakSet()
        self._lock = threading.Lock()
        self._listeners: dict[int, Listener] = {}
        key = keyspace.ack("*", "*", "*", str(session.zid()))
        self._subscriber = session.declare_subscriber(key, zenoh.handlers.FifoChannel(1024))
        guarded(self._run, self._subscriber.handler, name="acks").start()

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

    def expect(self, eid: int, listener: Listener) -> None:
        """Hand the acknowledgements for our publisher ``eid`` to ``listener``."""
        self._listeners[eid] = listener

    def forget(self, eid: int) -> None:
        """The publisher is given back."""
        self._listeners.pop(eid, None)

    def _send(self, worker: str, frame: StreamAcks) -> None:
        """Tell a worker how far its answers are; what is dropped here is mended by the next one."""
        self._session.put(
            self._keyspace.received(self._node, self._own_id, worker),
            wire.encode(frame),
            priority=zenoh.Priority.INTERACTIVE_HIGH,
            congestion_control=zenoh.CongestionControl.DROP,
        )

    def _run(self, handler: zenoh.handlers.Handler[Sample]) -> None:
        for sample in handler:
            try:
                acks = wire.decode(sample.payload.to_bytes(), StreamAcks)
            except WireError as error:
                _log.warning("an unreadable acknowledgement was ignored (%s)", error)
                continue
            incarnation = str(sample.key_expr).split("/")[-2]
            for ack in acks.acks:
                self._tell(ack, incarnation)

    def _tell(self, ack: StreamAck, incarnation: str) -> None:
        listener = self._listeners.get(ack.eid)
        if listener is None:
            return
        try:
            listener(ack, incarnation)
        except Exception:  # noqa: BLE001 - one stream's trouble must not stop the others' acknowledgements
            _log.exception("an acknowledgement failed")
